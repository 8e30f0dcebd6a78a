"""Pairs by what two shots share: on a plane with known poses, by time, and by order."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from swimm3r.datasets import PairSettings, make_pairs
from swimm3r.datasets.sequences import Lens, Sequence, Shot

WIDTH, HEIGHT, FOCAL, Z = 40, 30, 30.0, 3.0
VIEW = WIDTH / FOCAL * Z  # metres of the plane in view


@pytest.fixture
def strip(tmp_path: Path) -> Sequence:
    """A camera that looks straight down on a plane and moves a fifth of its view per shot."""
    shots, poses = [], {}
    for i in range(8):
        np.savez(tmp_path / f"{i}.npz", z_depth=np.full((HEIGHT, WIDTH), Z, np.float32))
        shots.append(Shot(str(i), tmp_path / f"{i}.png", depth=tmp_path / f"{i}.npz"))
        poses[str(i)] = np.eye(4)
        poses[str(i)][0, 3] = 0.2 * VIEW * i
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return Sequence("strip", "made", tuple(shots), lens=Lens(WIDTH, HEIGHT, K), cam2world=poses)


def test_overlap_is_the_share_of_the_view_that_both_see(strip: Sequence):
    pairs = make_pairs(strip, PairSettings(min_overlap=0.1, max_overlap=1.0, per_shot=8))
    shared = {p.j - p.i: p.overlap for p in pairs}
    assert set(shared) == {1, 2, 3, 4}
    for step, share in shared.items():
        assert share == pytest.approx(1 - 0.2 * step, abs=0.06)


def test_pairs_that_share_too_little_or_too_much_are_left_out(strip: Sequence):
    steps = {p.j - p.i for p in make_pairs(strip, PairSettings(min_overlap=0.3, max_overlap=0.7))}
    assert steps == {2, 3}


def test_a_surface_hidden_behind_another_is_not_shared(strip: Sequence, tmp_path: Path):
    np.savez(tmp_path / "1.npz", z_depth=np.full((HEIGHT, WIDTH), 1.0, np.float32))  # something before the lens
    assert not [p for p in make_pairs(strip, PairSettings()) if 1 in (p.i, p.j)]


def test_partners_are_spread_over_easy_and_hard_ones(strip: Sequence):
    of_first = [p.j for p in make_pairs(strip, PairSettings(min_overlap=0.1, per_shot=2)) if p.i == 0]
    assert of_first == [1, 4]


def test_without_poses_time_decides(strip: Sequence):
    shots = tuple(replace(s, time=0.25 * i, depth=None) for i, s in enumerate(strip.shots))
    pairs = make_pairs(replace(strip, shots=shots, cam2world={}), PairSettings(gaps_s=(0.5, 1.0)))
    assert {p.j - p.i for p in pairs} == {2, 4}
    assert all(p.overlap is None for p in pairs)


def test_a_pause_of_the_camera_pairs_nothing(strip: Sequence):
    seconds = [0.0, 0.5, 1.0, 1.5, 60.0, 60.5, 61.0, 61.5]
    shots = tuple(replace(s, time=t) for s, t in zip(strip.shots, seconds, strict=True))
    pairs = make_pairs(replace(strip, shots=shots, cam2world={}), PairSettings())
    assert pairs
    assert all((p.i < 4) == (p.j < 4) for p in pairs)


def test_without_times_order_decides(strip: Sequence):
    pairs = make_pairs(replace(strip, cam2world={}), PairSettings(steps=(1, 3)))
    assert [(p.i, p.j) for p in pairs if p.i in (0, 6)] == [(0, 1), (0, 3), (6, 7)]


def test_test_shots_never_meet_training_shots(strip: Sequence):
    shots = tuple(replace(s, split="test" if i % 2 else "train") for i, s in enumerate(strip.shots))
    pairs = make_pairs(replace(strip, shots=shots), PairSettings(max_overlap=1.0))
    assert pairs
    assert all((p.j - p.i) % 2 == 0 for p in pairs)


def test_unscaled_poses_are_not_compared_with_metric_depth(strip: Sequence):
    assert all(p.overlap is None for p in make_pairs(replace(strip, metric=False), PairSettings()))
