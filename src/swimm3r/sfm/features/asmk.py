"""Image retrieval by ASMK: similarity of frames before any of them is matched.

From local features x of a frame (MASt3R's encoder tokens, or anything else):

    whitening     x <- (x - m) P,   P = E diag(l)^(-1/2) of the covariance's eigenvectors E and eigenvalues l
    global        g = sum_k |x_k| x_k / |...|,   similarity = cosine                          (weights-free choice)
    ASMK          per visual word the sign of the summed residuals; similarity of two signatures
                  s = 1 - 2 hamming / bits, kept as s^3 where s >= 0; summed over common words, divided by the square
                  roots of both frames' numbers of words (Tolias et al. 2013)

A frame is described by one word per feature where it is found and by several where it asks, so the ASMK matrix is not
symmetric: row q holds what frame q finds.
"""

import argparse
import pickle
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from swimm3r.errors import WeightsError
from swimm3r.progress import Progress, silent
from swimm3r.settings import Count, Positive, Settings

_POPCOUNT = np.array([bin(byte).count("1") for byte in range(256)], dtype=np.uint8)
_HINT = "get the file again: swimm3r weights get mast3r-retrieval, mast3r-codebook"


@dataclass(frozen=True)
class Whitening:
    """A linear map after which features have mean 0 and covariance 1 on the data it was learned from."""

    mean: Float[Tensor, " c"]  # float64
    matrix: Float[Tensor, "c k"]  # float64


@dataclass(frozen=True)
class AsmkSettings(Settings):
    """Aggregated selective match kernel."""

    features: Count = 300
    """Number of strongest features of a frame that are kept."""
    words_when_found: Count = 1
    """Number of visual words per feature of a stored frame."""
    words_when_asking: Count = 5
    """Number of visual words per feature of a query frame."""
    power: Positive = 3.0
    """Exponent of a signature's similarity; larger values favor few good words over many mediocre ones."""


@dataclass(frozen=True)
class Signatures:
    """A frame's visual words and, for each, the signs of its summed residuals."""

    words: Int64[np.ndarray, " w"]  # ascending
    bits: UInt8[np.ndarray, "w bytes"]  # packed


def learn_whitening(features: Float[Tensor, "n c"]) -> Whitening:
    """The whitening of a sample of features. Raises ValueError for fewer features than channels."""
    n, channels = features.shape
    if n <= channels:
        raise ValueError(f"whitening {channels} channels needs more than {channels} features, got {n}")
    x = features.double()
    mean = x.mean(0)
    covariance = (x - mean).T @ (x - mean) / n
    eigenvalues, vectors = torch.linalg.eigh(covariance)
    # directions without any spread would be blown up to noise
    return Whitening(mean, vectors / eigenvalues.clamp(min=1e-12 * eigenvalues[-1]).sqrt())


def whiten(features: Float[Tensor, "*n c"], whitening: Whitening) -> Float[Tensor, "*n k"]:
    """Features with the whitening applied, in float64 and back."""
    mean, matrix = whitening.mean.to(features.device), whitening.matrix.to(features.device)
    return ((features.double() - mean) @ matrix).to(features.dtype)


def strongest(features: Float[Tensor, "n c"], count: int) -> Float[Tensor, "k c"]:
    """The `count` longest features, longest first: length is attention."""
    return features[features.norm(dim=1).topk(min(count, len(features))).indices]


def global_descriptor(features: Float[Tensor, "n c"]) -> Float[Tensor, " c"]:
    """A frame as one unit vector: its features summed, each with its length as weight; zero for a blank frame."""
    return torch.nn.functional.normalize((features.norm(dim=1, keepdim=True) * features).sum(0), dim=0)


def cosine_similarity(
    queries: Float[Tensor, "q c"], database: Float[Tensor, "n c"] | None = None
) -> Float[Tensor, "q n"]:
    """Cosines between global descriptors, of one set among itself by default."""
    unit = torch.nn.functional.normalize
    return unit(queries, dim=1) @ unit(queries if database is None else database, dim=1).T


def asmk_similarity(
    features: Sequence[Float[Tensor, "_ c"]],
    codebook: Float[Tensor, "words c"],
    settings: AsmkSettings = AsmkSettings(),
    progress: Progress = silent,
) -> Float[Tensor, "n n"]:
    """Similarity of every frame to all frames: row = the query; larger is more similar, below 1 even for itself."""
    kept = [strongest(f, settings.features) for f in features]
    found = [aggregate(f, codebook, settings.words_when_found) for f in kept]
    index = _InvertedIndex.of(found)
    bits = 32 * -(-codebook.shape[1] // 32)
    scores = np.zeros((len(features), len(features)))
    for q, f in enumerate(kept):
        progress("retrieval", q, len(kept))
        asking = aggregate(f, codebook, settings.words_when_asking)
        scores[q] = index.ask(asking, bits, settings.power)
    progress("retrieval", len(kept), len(kept))
    return torch.from_numpy(scores)


def aggregate(features: Float[Tensor, "n c"], codebook: Float[Tensor, "words c"], words: int) -> Signatures:
    """A frame's signatures, each feature counted at its `words` nearest visual words."""
    if len(features) == 0:
        return Signatures(np.zeros(0, np.int64), np.zeros((0, -(-codebook.shape[1] // 8)), np.uint8))
    # the nearest centroid maximizes x.c - |c|^2 / 2
    closeness = features @ codebook.T - (codebook * codebook).sum(1) / 2
    nearest = closeness.topk(min(words, len(codebook)), dim=1).indices
    present, slot = nearest.flatten().unique(return_inverse=True)
    residuals = (features[:, None] - codebook[nearest]).flatten(0, 1)
    sums = torch.zeros(len(present), features.shape[1], dtype=features.dtype, device=features.device)
    sums.index_add_(0, slot, residuals)
    return Signatures(present.cpu().numpy(), np.packbits((sums > 0).cpu().numpy(), axis=1))


@dataclass(frozen=True)
class _InvertedIndex:
    """The signatures of all frames, sorted by word."""

    words: Int64[np.ndarray, " e"]
    frames: Int64[np.ndarray, " e"]
    bits: UInt8[np.ndarray, "e bytes"]
    counts: Int64[np.ndarray, " n"]  # words per frame

    @staticmethod
    def of(found: Sequence[Signatures]) -> "_InvertedIndex":
        words = np.concatenate([s.words for s in found])
        counts = np.array([len(s.words) for s in found])
        frames = np.repeat(np.arange(len(found)), counts)
        order = np.argsort(words, kind="stable")
        return _InvertedIndex(words[order], frames[order], np.concatenate([s.bits for s in found])[order], counts)

    def ask(self, asking: Signatures, bits: int, power: float) -> Float[np.ndarray, " n"]:
        """The score of every frame for one asking frame."""
        scores = np.zeros(len(self.counts))
        if len(asking.words) == 0:
            return scores
        begin = np.searchsorted(self.words, asking.words, "left")
        length = np.searchsorted(self.words, asking.words, "right") - begin
        mine = np.repeat(np.arange(len(asking.words)), length)
        theirs = np.arange(length.sum()) + np.repeat(begin - np.cumsum(length) + length, length)
        hamming = _POPCOUNT[asking.bits[mine] ^ self.bits[theirs]].sum(axis=1, dtype=np.int64)
        similarity = np.maximum(1 - 2 * hamming / bits, 0) ** power
        np.add.at(scores, self.frames[theirs], similarity)
        return scores / np.sqrt(np.maximum(self.counts, 1) * len(asking.words))


def load_whitening(path: Path) -> Whitening:
    """The whitening of a published retrieval checkpoint. Raises WeightsError for another or damaged file."""
    _require_file(path)
    if not zipfile.is_zipfile(path):
        raise _refused(path, "it is not a complete torch archive")
    try:
        with torch.serialization.safe_globals([argparse.Namespace]):
            content = torch.load(str(path), map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError) as error:
        raise _refused(path, str(error).splitlines()[0]) from error
    state = content.get("model") if isinstance(content, dict) else None
    if not isinstance(state, dict) or not {"prewhiten.m", "prewhiten.p"} <= state.keys():
        raise _refused(path, "it holds no whitening")
    if trained := sorted(key for key in state if not key.startswith("prewhiten.")):
        raise _refused(path, f"only the training-free variant is supported, and this one also has {trained[0]}")
    mean, matrix = state["prewhiten.m"].flatten().double(), state["prewhiten.p"].double()
    if matrix.ndim != 2 or len(mean) != len(matrix):
        raise _refused(path, f"its mean has {len(mean)} channels, its matrix is {tuple(matrix.shape)}")
    return Whitening(mean, matrix)


def load_codebook(path: Path) -> Float[Tensor, "words c"]:
    """The visual words of a published codebook, read as data: nothing but arrays is unpickled.

    Raises WeightsError for another, damaged or unsafe file.
    """
    _require_file(path)
    with path.open("rb") as file:
        try:
            content = _ArraysOnly(file).load()
        except (pickle.UnpicklingError, EOFError, ValueError, TypeError, AttributeError, IndexError, KeyError) as error:
            raise _refused(path, str(error) or type(error).__name__) from error
    centroids = content.get("state", {}).get("centroids") if isinstance(content, dict) else None
    if not isinstance(centroids, np.ndarray) or centroids.ndim != 2 or centroids.dtype.kind != "f":
        raise _refused(path, "it holds no table of centroids")
    return torch.from_numpy(centroids.astype(np.float32))


class _ArraysOnly(pickle.Unpickler):
    """Unpickles plain values and NumPy arrays; every other name in the file is refused."""

    _ALLOWED = frozenset(
        [("numpy", "dtype"), ("numpy", "ndarray"), ("_codecs", "encode")]  # old protocols spell bytes as encoded text
        + [(f"numpy.{core}.multiarray", "_reconstruct") for core in ("core", "_core")]
        + [(f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")]
    )

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._ALLOWED:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which is no array")
        if module.startswith("numpy.core"):  # the old name of numpy._core, deprecated where both exist
            try:
                return super().find_class(module.replace("numpy.core", "numpy._core"), name)
            except ModuleNotFoundError:  # NumPy 1
                return super().find_class(module, name)
        return super().find_class(module, name)


def _require_file(path: Path) -> None:
    if not path.is_file():
        raise WeightsError(f"there is no file {path}", cause="it was never downloaded, or has moved", hint=_HINT)


def _refused(path: Path, why: str) -> WeightsError:
    return WeightsError(
        f"{path} cannot be used for retrieval: {why[:200]}", cause="a damaged file, or one of another model", hint=_HINT
    )
