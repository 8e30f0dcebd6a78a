"""Every frame encoded once, whatever number of pairs it is in: on disk keyed by content, and which frames look alike.

A file is named by a hash of the image as the network sees it and of the network's own weights, so that no file can be
stale: another image or another checkpoint is another name.
"""

from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r import weights
from swimm3r.io.files.cache_key import cache_key
from swimm3r.io.files.damage import guard, remake
from swimm3r.io.files.tensor_file import read_tensors, tensors_digest, write_tensors
from swimm3r.progress import Progress, silent
from swimm3r.sfm.features import asmk
from swimm3r.sfm.mast3r.network import Encoded, Mast3r
from swimm3r.sfm.mast3r_sfm.network_frames import NetworkImages

_SAMPLED_FRAMES = 64  # for the mean token
_USABLE = 0.5  # share of a patch


class EncodingStore:
    """Encodings of frames, made on first use and read from disk from then on."""

    def __init__(self, network: Mast3r, images: NetworkImages, folder: Path) -> None:
        self.network = network
        self.images = images
        self.folder = folder
        self.network_key = fingerprint(network)
        self._keys: dict[int, str] = {}

    def key(self, i: int) -> str:
        """The name of frame i: its image and the network."""
        if i not in self._keys:
            self._keys[i] = cache_key(self.images.digest(i), self.network_key)
        return self._keys[i]

    def path(self, i: int) -> Path:
        """File of the encoding of frame i."""
        return self.folder / f"{self.key(i)}.safetensors"

    def __getitem__(self, i: int) -> Encoded:
        """The encoding of frame i on the network's device."""
        path, frame = self.path(i), self.images.framing
        if path.is_file():
            with guard(path, remake(path)):
                stored = read_tensors(path, dict[str, str], remake(path), None, finite=False).tensors
                tokens, positions = (stored[name].to(self.network.device) for name in ("tokens", "positions"))
            return Encoded(tokens, positions, frame.network_height, frame.network_width)
        with torch.no_grad():  # not inference_mode: its tensors could never meet a gradient
            encoded = self.network.encode(self.images.image(i)[None].to(self.network.device))
        write_tensors(path, {"tokens": encoded.tokens, "positions": encoded.positions}, {})
        return encoded

    def fill(self, progress: Progress = silent) -> None:
        """Encode every frame that is not on disk yet."""
        missing = [i for i in range(len(self.images.frames)) if not self.path(i).is_file()]
        for done, i in enumerate(missing):
            progress("encoding frames", done, len(missing))
            self[i]
        progress("encoding frames", len(missing), len(missing))


def fingerprint(network: Mast3r) -> str:
    """Of all weights and of the precision they run in."""
    weights_by_name = dict(network.named_parameters())
    return cache_key(tensors_digest(weights_by_name), [str(value.dtype) for value in weights_by_name.values()])


def frame_similarity(store: EncodingStore, method: str = "cosine", progress: Progress = silent) -> Float[Tensor, "n n"]:
    """Similarity of frames to the encoder; rows are queries. Frames are read one at a time.

    `cosine` compares sums of the tokens' deviations from the dive's mean token, each weighted by its length; `asmk`
    (with the published whitening and codebook, else WeightsError) aggregates them by visual words.
    """
    n = len(store.images.frames)
    if method == "asmk":
        whitening = asmk.load_whitening(weights.require("mast3r-retrieval"))
        codebook = asmk.load_codebook(weights.require("mast3r-codebook"))
        settings = asmk.AsmkSettings()
        features = []
        for i in range(n):
            progress("describing frames", i, n)
            features.append(asmk.strongest(asmk.whiten(_tokens(store, i), whitening), settings.features))
        return asmk.asmk_similarity(features, codebook, settings, progress).float()
    sampled = range(0, n, -(-n // _SAMPLED_FRAMES))
    mean = torch.stack([_tokens(store, i).mean(0) for i in sampled]).nanmean(0)
    described = []
    for i in range(n):
        progress("describing frames", i, n)
        described.append(asmk.global_descriptor(_tokens(store, i) - mean))
    progress("describing frames", n, n)
    return asmk.cosine_similarity(torch.stack(described))


def _tokens(store: EncodingStore, i: int) -> Float[Tensor, "k c"]:
    """The tokens of the patches of frame i that are not masked, float32, on the CPU."""
    tokens = store[i].tokens[0].float().cpu()
    mask = store.images.mask(i)
    return tokens if mask is None else tokens[_usable_patches(mask, len(tokens))]


def _usable_patches(mask: Bool[Tensor, "h w"], count: int) -> Bool[Tensor, " count"]:
    patch = round((mask.numel() / count) ** 0.5)
    share = torch.nn.functional.avg_pool2d(mask.float()[None, None], patch)
    return share.flatten() >= _USABLE
