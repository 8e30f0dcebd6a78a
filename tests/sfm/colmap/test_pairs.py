"""Pairs of frames that are matched: beside returns to ground that a path left, on paths of known overlap and images."""

import itertools
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.sfm.colmap.two_planes import SETTINGS, texture

from swimm3r.scene.frames import Frame, Frames
from swimm3r.sfm.colmap.calibration.start import first_camera
from swimm3r.sfm.colmap.pairs import Pair, beside_returns, choose_pairs, match_frames
from swimm3r.sfm.features.database import FeatureDatabase, fill_features, match_counts, start_database

_LINE = 20  # frames of a line


def lawnmower(lines: int) -> np.ndarray:
    """Places of frames on parallel lines, flown there and back, in lengths of an image."""
    along = np.arange(_LINE) * 0.3
    ways = [along[::-1] if k % 2 else along for k in range(lines)]
    return np.concatenate([np.stack([way, np.full(_LINE, 0.5 * k)], 1) for k, way in enumerate(ways)])


def overlapping(places: np.ndarray) -> dict[Pair, int]:
    """The pairs of frames that share more than a quarter of an image, with the percentage."""
    shared = {}
    for i, j in itertools.combinations(range(len(places)), 2):
        area = np.prod(np.clip(1 - np.abs(places[i] - places[j]), 0, None))
        if area > 0.25:
            shared[i, j] = round(100 * float(area))
    return shared


def window(count: int, reach: int) -> list[Pair]:
    return [(i, j) for i, j in itertools.combinations(range(count), 2) if j - i <= reach]


def followed(tried: list[Pair], truth: dict[Pair, int], cameras: list[str | None]) -> set[Pair]:
    """All pairs that are tried until no more match."""
    known = list(tried)
    while more := beside_returns(known, {p: truth[p] for p in known if p in truth}, cameras):
        assert not set(more) & set(known)
        known += more
    return set(known)


def test_one_pair_of_two_lines_leads_to_all_others() -> None:
    places = lawnmower(3)
    truth, near = overlapping(places), window(len(places), 5)
    one_each = [(_LINE - 10, _LINE + 9), (2 * _LINE - 5, 2 * _LINE + 4)]  # what retrieval finds of either two lines
    assert set(one_each) <= truth.keys()
    found = followed(near + one_each, truth, [None] * len(places))
    between_lines = {(i, j) for i, j in truth if i // _LINE != j // _LINE}
    assert between_lines <= found
    assert len(found) < 0.45 * len(places) * (len(places) - 1) / 2


def test_a_path_that_returns_nowhere_gets_no_more_pairs() -> None:
    places = lawnmower(1) / 4  # slowly: frames overlap far beyond the window
    truth = overlapping(places)
    tried = [*window(_LINE, 3), (2, 8), (5, 12)]
    assert {(2, 8), (5, 12)} <= truth.keys()
    assert beside_returns(tried, truth, [None] * _LINE) == []


def test_pairs_beside_the_most_matches_come_first_and_none_twice() -> None:
    truth = {(3, 30): 40, (10, 22): 90}
    tried = [*window(40, 2), *truth]
    found = beside_returns(tried, truth, [None] * 40)
    assert len(found) == len(set(found)) == 16
    assert set(found[:8]) == {(a, b) for a in (9, 10, 11) for b in (21, 22, 23)} - {(10, 22)}
    assert beside_returns(tried, {(3, 30): 90, (10, 22): 40}, [None] * 40)[:8] == sorted(found[8:])


def test_ends_of_a_clip_have_one_neighbor() -> None:
    tried = [*window(30, 2), (0, 29)]
    assert beside_returns(tried, {(0, 29): 50}, [None] * 30) == [(0, 28), (1, 28), (1, 29)]


def test_frames_of_a_rig_have_neighbors_of_their_own_camera() -> None:
    cameras = ["left", "right"] * 20
    tried = [*window(40, 4), (6, 31)]
    found = beside_returns(tried, {(6, 31): 50}, cameras)
    assert {i for i, _ in found} == {4, 6, 8}
    assert {j for _, j in found} == {29, 31, 33}


def survey(folder: Path, ordered: bool) -> Frames:
    """Two lines over one texture, there and back, 40 % of their width in common."""
    ground, size = texture(5, 1536), (240, 180)
    folder.mkdir()
    frames = []
    for i in range(18):
        x = 96 * (i if i < 9 else 17 - i)
        y = 40 if i < 9 else 148
        path = folder / f"{i:02d}.png"
        cv2.imwrite(str(path), ground[y : y + size[1], x : x + size[0]])
        frames.append(Frame(path.name, path, float(i), 0.0, "train"))
    return Frames(tuple(frames), *size, ordered=ordered)


def features_of(frames: Frames, folder: Path) -> FeatureDatabase:
    store = start_database(folder, frames, first_camera(frames.width, frames.height, SETTINGS), SETTINGS.features)
    fill_features(store, frames, SETTINGS.features, 2)
    return store


def test_lines_of_a_survey_are_connected_wherever_they_overlap(tmp_path: Path) -> None:
    frames = survey(tmp_path / "images", ordered=True)
    everything = features_of(frames, tmp_path / "all")
    count = len(match_frames(everything, frames, replace(SETTINGS, pairs="exhaustive"), 2))
    truth = match_counts(everything)
    store = features_of(frames, tmp_path / "sfm")
    sparse = replace(SETTINGS, pairs="sequential", overlap=4, loops=2)
    tried = match_frames(store, frames, sparse, 2)
    assert tried == sorted(set(tried))
    assert match_counts(store).keys() == truth.keys() & set(tried)
    across = {(i, j) for i, j in truth if i < 9 <= j}
    assert len(across) > 12
    assert across <= set(tried)
    assert len(tried) < count


@pytest.mark.parametrize(("ordered", "loops"), [(True, 0), (False, 1)])
def test_no_pairs_are_added_without_retrieval_or_order(tmp_path: Path, ordered: bool, loops: int) -> None:
    frames = survey(tmp_path / "images", ordered)
    store = features_of(frames, tmp_path / "sfm")
    settings = replace(SETTINGS, pairs="sequential", overlap=4, loops=loops)
    assert match_frames(store, frames, settings, 2) == choose_pairs(store, frames, settings)
