"""Cost estimate of the MASt3R front end before it starts: pairs, minutes, memory, disk.

The network's share follows from its sizes (multiplications per token) and the time one encoding was measured to take;
matching and alignment from constants measured on two x86 cores. It is an estimate: the progress that follows is exact.
"""

import time
from dataclasses import dataclass

import torch

from swimm3r.sfm.mast3r.network import Architecture, Mast3r
from swimm3r.sfm.mast3r.settings import (
    Complete,
    LogWindow,
    OneReference,
    PairGraph,
    Retrieval,
    SlidingWindow,
    VideoPairs,
)
from swimm3r.sfm.mast3r_sfm.network_frames import NetworkImages
from swimm3r.sfm.settings import Mast3rSettings

_SEARCHES = 10  # nearest-neighbor searches over all seeds that the walks of one pair amount to
_MATCHING_FLOPS = 2.4e10  # per second of one core: thin products, then a maximum
_POINT_BYTES = 400  # of the alignment's graph, per matched pixel of a frame (benchmarks/mast3r_scale.py)
_POINT_SECONDS = 4e-7  # of one alignment step, per matched pixel of a frame (benchmarks/mast3r_scale.py)
_MATCHES_PER_SEED = 1.2  # what two exact views of 60 % overlap yield


@dataclass(frozen=True)
class Plan:
    """Estimates; pairs are an upper bound where loop closures are still to be found."""

    frames: int
    pairs: int
    minutes: float
    memory_mb: float
    disk_mb: float

    def __str__(self) -> str:
        return (
            f"Plan: {self.frames} frames, up to {self.pairs:,} pairs, about {self.minutes:.0f} min, "
            f"{self.memory_mb:,.0f} MB of memory, {self.disk_mb:,.0f} MB of disk while it runs"
        )


def make_plan(network: Mast3r, images: NetworkImages, graph: PairGraph, settings: Mast3rSettings) -> Plan:
    """Encodes one frame to see how fast this machine is."""
    n, frame = len(images.frames), images.framing
    pixels = frame.network_width * frame.network_height
    a = network.architecture
    image = images.image(0)[None].to(network.device)
    began = time.perf_counter()
    with torch.no_grad():
        float(network.encode(image).tokens.float().sum())  # waits for an accelerator
    encode_seconds = time.perf_counter() - began
    encode, pair = multiplications(a, pixels)
    pairs = most_pairs(n, graph)
    seeds = pixels / settings.matching.subsample**2
    matching = _SEARCHES * seeds * pixels * a.descriptor_dim * 2 / _MATCHING_FLOPS
    if network.device.type != "cpu":
        matching *= encode * 2e-12 / encode_seconds  # scaled like the network against one slow core
    matched = 2 * min(settings.max_matches, pairs * seeds * _MATCHES_PER_SEED)
    steps = settings.alignment.coarse_iterations + settings.alignment.fine_iterations
    seconds = encode_seconds * (n + pairs * pair / encode) + pairs * matching + steps * matched * _POINT_SECONDS
    weights = sum(p.numel() * p.element_size() for p in network.parameters())
    token_bytes = pixels / a.patch**2 * a.encoder_dim * network.enc_norm.weight.element_size()
    sums = 7 * 8 * pixels  # float64, `alignment.canonical.CanonicalSums`
    held = min(settings.memory_mb * 2.0**20, n * (token_bytes + sums))
    maps = 4 * pixels * (a.descriptor_dim + 5) * 4 * 2  # of one pair, and as much again on the way
    return Plan(
        frames=n,
        pairs=pairs,
        minutes=seconds / 60,
        memory_mb=(weights + held + max(maps, matched * _POINT_BYTES)) / 2**20,
        disk_mb=(n * (token_bytes + 8 * pixels) + pairs * 20 * seeds) / 2**20,
    )


def most_pairs(n: int, graph: PairGraph) -> int:
    """Largest number of pairs of a graph over n frames."""
    match graph:
        case Complete():
            found = n * (n - 1) // 2
        case SlidingWindow(size) | LogWindow(size):
            found = n * size
        case OneReference():
            found = n - 1
        case Retrieval(keys, neighbors):
            keys = min(keys, n)
            found = keys * (keys - 1) // 2 + n - keys + n * neighbors
        case VideoPairs(window, closures):
            found = n * (window + closures)
    return min(found, n * (n - 1) // 2)


def multiplications(a: Architecture, pixels: int) -> tuple[float, float]:
    """Of one encoding, and of one pair: two passes of both decoders and four times both heads."""
    t = pixels / a.patch**2

    def block(dim: int, crosses: int) -> float:
        return t * dim * dim * (4 * (1 + crosses) + 2 * a.mlp_ratio) + 2 * (1 + crosses) * t * t * dim

    encode = t * 3 * a.patch**2 * a.encoder_dim + a.encoder_depth * block(a.encoder_dim, 0)
    decode = 2 * (t * a.encoder_dim * a.decoder_dim + a.decoder_depth * block(a.decoder_dim, 1))
    joined = a.encoder_dim + a.decoder_dim
    local = t * a.local_hidden_dim * (joined + (a.descriptor_dim + 1) * a.patch**2)
    return encode, 2 * decode + 4 * (local + _dpt(a, t))


def _dpt(a: Architecture, t: float) -> float:
    """Convolutions of a DPT head, t tokens; maps have 16, 4, 1 and 1/4 cells per token, outputs 64 and 256."""
    f, (first, second) = a.dpt_feature_dim, a.dpt_last_dims
    cells = (16, 4, 1, 0.25)
    levels = (a.encoder_dim, a.decoder_dim, a.decoder_dim, a.decoder_dim)
    total = 0.0
    for number, (cell, inside, dim) in enumerate(zip(cells, levels, a.dpt_layer_dims, strict=True)):
        total += t * inside * dim + t * dim * dim * (cell if number < 2 else 9 * cell if number == 3 else 0)
        total += cell * t * 9 * dim * f + cell * t * 9 * f * f * (2 if number == 3 else 4) + 4 * cell * t * f * f
    return total + 64 * t * 9 * f * first + 256 * t * (9 * first * second + second * 4)
