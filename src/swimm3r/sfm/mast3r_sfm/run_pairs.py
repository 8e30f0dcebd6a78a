"""The network over a pair graph, as the back end runs it: what it says goes to disk, and a killed run goes on.

A pair is done when its matches are written and both pointmaps are in their frames' sums (`pair_store`).
"""

import logging
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor

from swimm3r import devices, weights
from swimm3r.progress import Progress, silent
from swimm3r.sfm.alignment.problem import Predicted
from swimm3r.sfm.features.pair_graph import Pairs, make_pairs
from swimm3r.sfm.mast3r import checkpoint
from swimm3r.sfm.mast3r.inference import EncodingCache, PairPrediction, ViewPrediction, predict_pair
from swimm3r.sfm.mast3r.matching import DescriptorMap, match_views
from swimm3r.sfm.mast3r.network import Mast3r
from swimm3r.sfm.mast3r.settings import AlignmentSettings, PairGraph, Retrieval, VideoPairs
from swimm3r.sfm.mast3r_sfm.cost_estimate import make_plan
from swimm3r.sfm.mast3r_sfm.encodings import EncodingStore, frame_similarity
from swimm3r.sfm.mast3r_sfm.network_frames import NetworkImages
from swimm3r.sfm.mast3r_sfm.pair_store import FrameStore, PairRecord, PairStore
from swimm3r.sfm.settings import Mast3rSettings
from swimm3r.sfm.student import adapter_file
from swimm3r.sfm.student.physics_head import PhysicsHead

log = logging.getLogger(__name__)

_PAIR = "one pair of images"
_SMALLER = "--precision bfloat16, a smaller --size (384), less --memory-mb, or --device cpu"


def load_network(settings: Mast3rSettings) -> Mast3r:
    """The network of the settings' checkpoint on their device."""
    path = weights.require("mast3r", settings.weights)
    return checkpoint.load(path, devices.chosen(settings.device), getattr(torch, settings.precision))


def apply_adapter(network: Mast3r, adapter: Path, settings: Mast3rSettings) -> PhysicsHead | None:
    """Makes the network the student of an adapter file, for good, and returns its physics head, if it has one.

    Raises WeightsError for a file that is missing or damaged, or that was trained on other weights.
    """
    state, _ = checkpoint.read(weights.require("mast3r", settings.weights))
    student = adapter_file.load(adapter, network, adapter_file.fingerprint(state))
    student.adapters.merge()
    return student.head


@dataclass(frozen=True)
class PairResults:
    """The network's results for frames, on disk: names and the stores to read them with."""

    pairs: Pairs
    names: tuple[str, ...]  # hashes of the frames
    pair_store: PairStore
    frame_store: FrameStore


def run_pairs(
    network: Mast3r,
    images: NetworkImages,
    graph: PairGraph,
    settings: Mast3rSettings,
    cache: Path,
    progress: Progress = silent,
) -> PairResults:
    """The network over all pairs of a graph; goes on from what `cache` holds."""
    n = len(images.frames)
    encodings = EncodingStore(network, images, cache / "encodings")
    with devices.memory_for(_PAIR, _SMALLER):
        log.info("%s", make_plan(network, images, graph, settings))
        encodings.fill(progress)
    similarity = None
    if isinstance(graph, Retrieval) or (isinstance(graph, VideoPairs) and graph.closures):
        similarity = frame_similarity(encodings, settings.similarity, progress)
    pairs = make_pairs(n, graph, similarity)
    partners: list[set[int]] = [set() for _ in range(n)]
    for i, j in pairs:
        partners[i].add(j)
        partners[j].add(i)
    # two frames with the same image are still two frames
    names = tuple(f"{encodings.key(i)} {name}" for i, name in enumerate(images.frames.names))
    alignment = settings.alignment
    half = settings.memory_mb << 19
    said = PairResults(
        pairs,
        names,
        PairStore(cache / "pairs", f"{settings.matching} {alignment.confidence_threshold} {alignment.parity}"),
        FrameStore(cache / "views", names, partners, half, alignment.subsample, 0.0 if alignment.parity else 0.5),
    )
    cached = EncodingCache(encodings.__getitem__, half)
    mask_of = lru_cache(maxsize=64)(images.mask)  # of a distorted lens it is as dear as an image
    todo = [pair for pair in pairs if not _is_done(said, *pair)]
    for done, (i, j) in enumerate(todo):
        progress("two-view network", done, len(todo))
        with torch.no_grad(), devices.memory_for(_PAIR, _SMALLER):
            prediction = predict_pair(network, (i, cached[i]), (j, cached[j]))
        _keep(prediction, [mask_of(f) for f in (i, j)], said, settings)
    progress("two-view network", len(todo), len(todo))
    said.frame_store.flush()
    return said


def _is_done(said: PairResults, i: int, j: int) -> bool:
    added = said.frame_store.has(i, j) and said.frame_store.has(j, i)
    return added and said.pair_store.has(said.names[i], said.names[j])


def _keep(p: PairPrediction, masks: list[Tensor | None], said: PairResults, settings: Mast3rSettings) -> None:
    assert p.view_ii.points is not None
    assert p.view_jj.points is not None
    assert p.view_ii.confidence is not None
    assert p.view_jj.confidence is not None
    said.frame_store.add(p.i, p.j, p.view_ii.points, p.view_ii.confidence)
    said.frame_store.add(p.j, p.i, p.view_jj.points, p.view_jj.confidence)

    def described(view: ViewPrediction, side: int) -> DescriptorMap:
        assert view.descriptors is not None
        assert view.descriptor_confidence is not None
        mask = masks[side]
        return DescriptorMap(
            view.descriptors, view.descriptor_confidence, None if mask is None else mask.to(view.descriptors.device)
        )

    matches = match_views(
        described(p.view_ii, 0),
        described(p.view_ji, 1),
        described(p.view_ij, 0),
        described(p.view_jj, 1),
        settings.matching,
    )
    predicted: tuple[Predicted | None, Predicted | None] = (None, None)
    if not (matches.confidence > settings.alignment.confidence_threshold).any():
        predicted = (_anchors(p.view_ij, settings.alignment), _anchors(p.view_ji, settings.alignment))
    said.pair_store.write(said.names[p.i], said.names[p.j], PairRecord(matches, *predicted))


def _anchors(view: ViewPrediction, settings: AlignmentSettings) -> Predicted:
    """A view's anchors in the other camera; the reference reads them at the corners of their blocks."""
    assert view.points is not None
    assert view.confidence is not None
    s = settings.subsample
    first = 0 if settings.parity else s // 2
    return Predicted(
        view.points[first::s, first::s].flatten(0, 1).cpu(), view.confidence[first::s, first::s].flatten().cpu()
    )
