"""The pairs of frames of a clip that are matched: all, or neighbors, those that look alike, and those beside them.

Retrieval finds that a path returns to ground that it left, but for some of its frames only: of the 170 pairs of frames
of skerki_survey on parallel lines that match, it has 78. The others are beside them. So where two frames match that
see common ground again, the frames before and after each are matched with the other one's, until no more match.
"""

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import pairwise

import torch

from swimm3r.errors import UsageError
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.rig import first_of_instants
from swimm3r.sfm.features import vlad
from swimm3r.sfm.features.database import FeatureDatabase, match_counts, match_pairs
from swimm3r.sfm.features.sift import unit_descriptors
from swimm3r.sfm.settings import ColmapSettings

Pair = tuple[int, int]
"""Two frames, the earlier one first."""


def match_frames(
    store: FeatureDatabase, frames: Frames, settings: ColmapSettings, threads: int, progress: Progress = silent
) -> list[Pair]:
    """Match and verify the pairs of frames worth it; return them, sorted.

    Of an ordered clip at most as many pairs are added beside returns as retrieval has proposed.
    """
    pairs = choose_pairs(store, frames, settings)
    match_pairs(store, pairs, settings.features, threads, progress)
    left = settings.loops * len(frames) if frames.ordered else 0
    cameras = [frame.camera for frame in frames]
    while more := beside_returns(pairs, match_counts(store), cameras)[:left]:
        match_pairs(store, sorted(more), settings.features, threads, progress)
        pairs = sorted([*pairs, *more])
        left -= len(more)
    return pairs


def check_pairs(frames: Frames, settings: ColmapSettings) -> None:
    """Raise UsageError where the settings leave a folder of images without any pair to match."""
    if settings.loops == 0 and not _matches_all(frames, settings) and _matches_alike_alone(frames, settings):
        raise UsageError(
            f"--loops 0 leaves the {len(frames)} images of a folder without a pair to match",
            cause=f"more than {settings.exhaustive_to} images without an order are matched with similar ones alone",
            hint="leave out --loops, or match all pairs (--pairs exhaustive) or neighbors by name (--pairs sequential)",
        )


def _matches_all(frames: Frames, settings: ColmapSettings) -> bool:
    return settings.pairs == "exhaustive" or (settings.pairs == "auto" and len(frames) <= settings.exhaustive_to)


def _matches_alike_alone(frames: Frames, settings: ColmapSettings) -> bool:
    return not frames.ordered and settings.pairs == "auto"


def beside_returns(tried: Sequence[Pair], matches: Mapping[Pair, int], cameras: Sequence[str | None]) -> list[Pair]:
    """The pairs beside those that match after a return and have not been tried, beside most matches first.

    `matches` are the numbers of verified matches of the pairs that have enough of them, and `cameras` tells of each
    frame which camera of a rig took it, if any. Two frames match after a return if one of them was tried in vain with
    a frame of its camera between the two.
    """
    known = set(tried)
    lost_after: dict[int, int] = {}
    lost_before: dict[int, int] = {}
    for i, j in known - matches.keys():
        if cameras[i] == cameras[j]:
            lost_after[i] = min(j, lost_after.get(i, j))
            lost_before[j] = max(i, lost_before.get(j, i))
    near = _with_neighbors(cameras)
    found: dict[Pair, int] = {}
    for i, j in sorted(known & matches.keys(), key=lambda pair: -matches[pair]):
        if lost_after.get(i, j) < j or lost_before.get(j, i) > i:
            around = {(min(a, b), max(a, b)) for a, b in itertools.product(near[i], near[j]) if a != b}
            for pair in around - known:
                found.setdefault(pair, matches[i, j])
    return sorted(found, key=lambda pair: (-found[pair], pair))


def _with_neighbors(cameras: Sequence[str | None]) -> list[list[int]]:
    """Each frame with those of its camera before and after it."""
    of_camera: defaultdict[str | None, list[int]] = defaultdict(list)
    for i, camera in enumerate(cameras):
        of_camera[camera].append(i)
    place = {i: k for own in of_camera.values() for k, i in enumerate(own)}
    return [of_camera[camera][max(0, place[i] - 1) : place[i] + 2] for i, camera in enumerate(cameras)]


def choose_pairs(store: FeatureDatabase, frames: Frames, settings: ColmapSettings) -> list[Pair]:
    """The pairs of frames that are matched first, sorted."""
    n = len(frames)
    if _matches_all(frames, settings):
        return list(itertools.combinations(range(n), 2))
    with store.open() as database:
        described = vlad.describe_frames(
            n, lambda i: unit_descriptors(database.read_descriptors(i + 1).data), torch.Generator().manual_seed(0)
        )
    if _matches_alike_alone(frames, settings):
        return vlad.alike_pairs(described, 5 * settings.loops)
    steps = {*range(1, settings.overlap + 1), *(2**k for k in range(settings.overlap.bit_length(), 8))}
    cameras = 1 if frames.rig is None else len(frames.rig.cameras)
    near = _near(frames, steps)
    return sorted(near | set(vlad.alike_pairs(described, settings.loops, apart=settings.overlap * cameras)))


def _near(frames: Frames, steps: set[int]) -> set[Pair]:
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
