"""From a folder of data sets and a base checkpoint to a trained adapter: what surrounds the loop of `loop.py`."""

import os
from collections.abc import Callable
from pathlib import Path

import torch

from swimm3r import devices
from swimm3r import weights as published
from swimm3r.datasets import PairSettings, load, make_pairs, read_tree
from swimm3r.datasets.pairs import Pair
from swimm3r.datasets.sequences import Sequence
from swimm3r.progress import Progress, silent
from swimm3r.sfm.distillation import loop
from swimm3r.sfm.distillation.pairs import split_data
from swimm3r.sfm.distillation.seathru_targets import with_made_targets
from swimm3r.sfm.distillation.settings import TrainSettings
from swimm3r.sfm.distillation.validation import score
from swimm3r.sfm.features.asmk import cosine_similarity, global_descriptor
from swimm3r.sfm.features.pair_graph import video_pairs
from swimm3r.sfm.mast3r import checkpoint
from swimm3r.sfm.mast3r.network import Mast3r
from swimm3r.sfm.mast3r.preprocess import framing, to_network
from swimm3r.sfm.mast3r.settings import VideoPairs
from swimm3r.sfm.student.adapter_file import Base, fingerprint


def train_sfm(
    data: Path,
    folder: Path,
    settings: TrainSettings,
    weights: Path | None = None,
    base_license: str | None = None,
    device: str = "auto",
    announce: Callable[[loop.Estimate], None] = lambda estimate: None,
    progress: Progress = silent,
) -> Path:
    """Trains on every trainable pair below `data` and returns the adapter's path; Sea-Thru's targets are made first.

    Raises InputError for a folder without trainable pairs, WeightsError for a missing or damaged checkpoint, and
    DeviceError for an accelerator that is not there.
    """
    place = _device(device)
    low = settings.precision == "bfloat16" or (settings.precision == "auto" and place.type == "cuda")
    path = published.require("mast3r", weights)
    state, _ = checkpoint.read(path)
    base = Base(path.name, fingerprint(state), base_license or _license(path))
    del state
    network = checkpoint.load(path, place, torch.bfloat16 if low else torch.float32)
    sequences = with_made_targets(read_tree(data).sequences, folder / "made", progress)
    patch = network.architecture.patch
    pairs = [make_pairs(sequence, settings.pairs) for sequence in sequences]
    if settings.pairs.retrieved:
        found = [
            retrieved_pairs(network, s, own, settings.pairs, settings.size, progress)
            for s, own in zip(sequences, pairs, strict=True)
        ]
        pairs = [[*own, *more] for own, more in zip(pairs, found, strict=True)]
    train, validation = split_data(
        sequences,
        pairs,
        settings.size,
        settings.validation,
        settings.max_pairs,
        patch,
        augmented=settings.water_probability > 0,
    )
    return loop.train(network, base, train, validation, settings, folder, score, announce, progress)


def retrieved_pairs(
    network: Mast3r,
    sequence: Sequence,
    known: list[Pair],
    settings: PairSettings,
    size: int,
    progress: Progress = silent,
) -> list[Pair]:
    """Pairs beyond `settings.reach` whose shots look alike to the frozen network; none where poses told the overlap.

    Shots of different splits are never paired.
    """
    n = len(sequence)
    if n <= settings.reach or any(pair.overlap is not None for pair in known):
        return []
    described = []
    for i in range(n):
        progress(f"describing {sequence.name}", i, n)
        view = load(sequence, i)
        image = view.clean if view.clean is not None else view.raw
        assert image is not None  # every reader gives a shot at least one
        frame = framing(image.shape[1], image.shape[0], size, patch=network.architecture.patch)
        with torch.no_grad():
            tokens = network.encode(to_network(image, frame)[None].to(network.decoder_embed.weight.device)).tokens[0]
        described.append(tokens.float().cpu())
    progress(f"describing {sequence.name}", n, n)
    mean = torch.stack([tokens.mean(0) for tokens in described]).mean(0)
    similarity = cosine_similarity(torch.stack([global_descriptor(tokens - mean) for tokens in described]))
    found = video_pairs(n, VideoPairs(window=0, closures=settings.retrieved, gap=settings.reach), similarity)
    shots = sequence.shots
    chosen = {(min(pair), max(pair)) for pair in found}
    return [Pair(i, j) for i, j in sorted(chosen) if shots[i].split == shots[j].split]


def _device(name: str) -> torch.device:
    """Each process of torchrun has a GPU of its own."""
    device = devices.chosen(name, ("cuda",))
    return torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0"))) if device.type == "cuda" else device


def _license(path: Path) -> str:
    known = (w.license for w in published.MANIFEST if w.filename == path.name)
    return next(known, f"not stated: {path.name} is no published checkpoint that Swimm3R knows")
