"""The pairs of frames of a clip that are worth matching: all, neighbors, or those that look alike."""

import itertools
from itertools import pairwise

import torch

from swimm3r.scene.frames import Frames
from swimm3r.scene.rig import first_of_instants
from swimm3r.sfm.features import vlad
from swimm3r.sfm.features.database import FeatureDatabase
from swimm3r.sfm.features.sift import unit_descriptors
from swimm3r.sfm.settings import ColmapSettings


def choose_pairs(store: FeatureDatabase, frames: Frames, settings: ColmapSettings) -> list[tuple[int, int]]:
    """The pairs of frames worth matching, (i < j), sorted."""
    n = len(frames)
    if settings.pairs == "exhaustive" or (settings.pairs == "auto" and n <= settings.exhaustive_to):
        return list(itertools.combinations(range(n), 2))
    with store.open() as database:
        described = vlad.describe_frames(
            n, lambda i: unit_descriptors(database.read_descriptors(i + 1).data), torch.Generator().manual_seed(0)
        )
    if not frames.ordered and settings.pairs == "auto":
        return vlad.alike_pairs(described, 5 * settings.loops)
    steps = {*range(1, settings.overlap + 1), *(2**k for k in range(settings.overlap.bit_length(), 8))}
    cameras = 1 if frames.rig is None else len(frames.rig.cameras)
    near = _near(frames, steps)
    return sorted(near | set(vlad.alike_pairs(described, settings.loops, apart=settings.overlap * cameras)))


def _near(frames: Frames, steps: set[int]) -> set[tuple[int, int]]:
    """Pairs of frames that lie so many steps apart.

    Of a rig each camera is paired with itself so many instants later, and all of them at an instant and with the next.
    """
    starts = first_of_instants([frame.instant for frame in frames])
    groups = [range(first, last) for first, last in pairwise([*starts, len(frames)])]
    camera = [frame.camera for frame in frames]
    found = {pair for group in groups for pair in itertools.combinations(group, 2)}
    for k, step in itertools.product(range(len(groups)), steps):
        if k + step < len(groups):
            both = itertools.product(groups[k], groups[k + step])
            found |= {(i, j) for i, j in both if step == 1 or camera[i] == camera[j]}
    return found
