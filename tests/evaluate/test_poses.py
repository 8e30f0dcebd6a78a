"""Published numbers, invariance to the world's similarity, and what counts as a failure."""

import json

import pytest
import torch

from swimm3r.evaluate import NotComputed, summary_entries
from swimm3r.evaluate import poses as evaluated
from swimm3r.evaluate.poses import (
    RelativePoseErrors,
    absolute_pose_errors,
    maa,
    mean_translation_error,
    pose_scores,
    relative_pose_errors,
    rra,
    rta,
)
from swimm3r.geometry import Similarity, invert_poses, pose_from, so3_exp


def some_poses(n: int = 8, seed: int = 0) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    turns, centers = torch.randn(2, n, 3, generator=g, dtype=torch.float64)
    return pose_from(so3_exp(turns), centers)


def some_similarity() -> Similarity:
    R = so3_exp(torch.tensor([0.3, -1.2, 0.7], dtype=torch.float64))
    return Similarity(torch.tensor(2.7, dtype=torch.float64), R, torch.tensor([4.0, -2.0, 11.0], dtype=torch.float64))


def disturbed(poses: torch.Tensor, degrees: float, shift: float, seed: int = 9) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    turns, shifts = torch.randn(2, len(poses), 3, generator=g, dtype=torch.float64)
    axes = turns / turns.norm(dim=-1, keepdim=True)
    return pose_from(
        poses[:, :3, :3] @ so3_exp(axes * torch.deg2rad(torch.tensor(degrees))), poses[:, :3, 3] + shift * shifts
    )


def errors_of(rotation: list[float], translation: list[float]) -> RelativePoseErrors:
    n = len(rotation)
    return RelativePoseErrors(
        pairs=torch.zeros(n, 2, dtype=torch.int64),
        rotation=torch.tensor(rotation, dtype=torch.float64),
        translation=torch.tensor(translation, dtype=torch.float64),
        baseline=torch.ones(n, dtype=torch.float64),
        registered=torch.ones(n, dtype=torch.bool),
    )


@pytest.fixture(scope="module")
def vectors(shared):
    stored = json.loads((shared / "vectors/metrics/pose_metrics.json").read_text())
    for key in ("gt_world2cam", "pred_world2cam"):
        stored[key] = invert_poses(torch.tensor(stored[key], dtype=torch.float64))
    return stored


@pytest.mark.shared
def test_pair_errors_are_those_of_the_vectors(vectors):
    errors = relative_pose_errors(vectors["pred_world2cam"], vectors["gt_world2cam"])
    assert errors.pairs.tolist() == vectors["pairs"]
    for found, key in (
        (errors.rotation, "rotation_deg"),
        (errors.translation, "translation_deg_signed"),
        (errors.sign_blind_translation, "translation_deg_sign_invariant"),
    ):
        torch.testing.assert_close(found, torch.tensor(vectors[key]).double(), rtol=1e-5, atol=1e-5)


@pytest.mark.shared
def test_accuracies_are_those_of_the_vectors(vectors):
    scores = pose_scores(vectors["pred_world2cam"], vectors["gt_world2cam"])
    assert scores.rra15 == pytest.approx(vectors["RRA15"], abs=1e-5)
    assert scores.rta15 == pytest.approx(vectors["RTA15"], abs=1e-5)
    assert scores.maa30 == pytest.approx(vectors["mAA30_histogram"], abs=1e-5)
    errors = relative_pose_errors(vectors["pred_world2cam"], vectors["gt_world2cam"])
    assert maa(errors, 30, "trapezoid") == pytest.approx(vectors["colmap_auc30_trapezoid"], abs=1e-5)


@pytest.mark.shared
def test_baselines_seen_from_the_other_camera_give_the_other_published_number(vectors):
    errors = relative_pose_errors(vectors["pred_world2cam"], vectors["gt_world2cam"], seen_from="j")
    assert rra(errors, 15.0) == pytest.approx(vectors["posediffusion"]["RRA15"], abs=1e-5)
    assert rta(errors, 15.0) == pytest.approx(vectors["posediffusion"]["RTA15"], abs=1e-5)
    assert maa(errors, 30) == pytest.approx(vectors["posediffusion"]["mAA30"], abs=1e-5)


def test_pairs_of_a_long_dive_are_scored_a_part_at_a_time(monkeypatch: pytest.MonkeyPatch):
    """All pairs of 10,000 frames at once would take 36 GB."""
    true, held, taken = some_poses(500), [], evaluated.relative_poses
    monkeypatch.setattr(evaluated, "relative_poses", lambda i, j: held.append(len(i)) or taken(i, j))
    estimate, registered = disturbed(true, degrees=9, shift=0.3), torch.arange(500) % 7 > 0
    scores = pose_scores(estimate, true, registered)
    assert sum(held) == 2 * 500 * 499 / 2
    assert max(held) < 70_000
    together = relative_pose_errors(estimate, true, registered)
    assert together.pairs.tolist() == torch.triu_indices(500, 500, 1).mT.tolist()
    assert (scores.rra15, scores.rta15) == pytest.approx((rra(together, 15.0), rta(together, 15.0)))
    assert scores.maa30 == pytest.approx(maa(together, 30))
    assert scores.translation_deg == pytest.approx(mean_translation_error(together))


def test_perfect_poses_score_full_marks_in_any_world():
    poses = some_poses()
    scores = pose_scores(some_similarity().poses(poses), poses)
    assert (scores.rra15, scores.rta15, scores.maa30) == (100, 100, 100)
    for error in (scores.rotation_deg, scores.translation_deg, scores.ate):
        assert error == pytest.approx(0, abs=1e-6)


def test_scores_do_not_depend_on_the_world_the_estimate_lives_in():
    poses = some_poses()
    estimate = disturbed(poses, degrees=4, shift=0.2)
    here, there = pose_scores(estimate, poses), pose_scores(some_similarity().poses(estimate), poses)
    assert here.rotation_deg == pytest.approx(there.rotation_deg)
    assert here.translation_deg == pytest.approx(there.translation_deg)
    assert here.ate == pytest.approx(there.ate)
    assert here.maa30 == pytest.approx(there.maa30)


def test_one_turned_frame_spoils_its_pairs_only():
    poses = some_poses(5)
    estimate = poses.clone()
    estimate[2, :3, :3] = estimate[2, :3, :3] @ so3_exp(torch.tensor([0.0, 0.0, 1.0]).double())
    errors = relative_pose_errors(estimate, poses)
    touched = (errors.pairs == 2).any(-1)
    torch.testing.assert_close(errors.rotation[touched], torch.full((4,), 180 / torch.pi).double())
    assert errors.rotation[~touched].max() < 1e-6
    assert rra(errors, 15.0) == pytest.approx(60)


def test_unregistered_frames_count_as_failures_and_are_not_looked_at():
    poses = some_poses(5)
    registered = torch.tensor([True, True, True, True, False])
    estimate = poses.clone()
    estimate[4] = torch.nan
    scores = pose_scores(estimate, poses, registered)
    assert scores.rra15 == scores.rta15 == scores.maa30 == pytest.approx(60)
    assert scores.translation_deg == pytest.approx(0, abs=1e-6)
    assert (scores.registered, scores.frames) == (4, 5)


def test_poses_that_are_not_finite_are_refused():
    poses = some_poses(3)
    with pytest.raises(ValueError, match="not all finite"):
        pose_scores(poses * torch.nan, poses)


def test_thresholds_are_strict_and_the_last_bin_of_maa_is_closed():
    errors = errors_of([15.0, 14.999, 30.0, 0.0], [0.0, 0.0, 0.0, 15.0])
    assert rra(errors, 15.0) == 50
    assert rta(errors, 15.0) == 75
    assert maa(errors_of([30.0], [0.0])) == pytest.approx(100 / 30)
    assert maa(errors_of([0.0], [0.0])) == 100
    assert maa(errors_of([30.01], [0.0])) == 0


def test_a_flipped_baseline_is_right_as_a_line_and_wrong_as_a_direction():
    errors = errors_of([0.0], [180.0])
    assert rta(errors, 5.0) == 100
    assert mean_translation_error(errors) == 180


def test_a_baseline_of_no_length_fails_and_a_pair_without_a_true_one_is_left_out_of_the_mean():
    poses = some_poses(3)
    estimate = poses.clone()
    estimate[:, :3, 3] = 1.0
    assert rta(relative_pose_errors(estimate, poses), 89.0) == 0
    standing = poses.clone()
    standing[1, :3, 3] = standing[0, :3, 3]
    errors = relative_pose_errors(standing, standing)
    assert mean_translation_error(errors) == pytest.approx(0, abs=1e-6)
    assert errors.translation[0] == 90


def test_ate_is_the_scatter_that_no_similarity_explains():
    poses = some_poses(400)
    estimate = disturbed(poses, degrees=0.0, shift=0.01)
    errors = absolute_pose_errors(some_similarity().poses(estimate), poses)
    assert errors.ate == pytest.approx(0.01 * 3**0.5, rel=0.05)
    assert errors.alignment == "centers"


def test_absolute_rotation_error_is_how_far_each_frame_is_turned():
    poses = some_poses(2000)
    errors = absolute_pose_errors(disturbed(poses, degrees=3, shift=0.1), poses)
    assert errors.rotation_deg == pytest.approx(3, rel=0.02)
    assert errors.rotation_median_deg == pytest.approx(3, rel=0.02)


def test_a_straight_track_has_an_ate_and_its_rotation_error_does_not_explode():
    poses = some_poses(10)
    poses[:, :3, 3] = torch.arange(10)[:, None] * torch.tensor([1.0, 0.0, 0.0]).double()
    on_the_line = absolute_pose_errors(some_similarity().poses(poses), poses)
    assert on_the_line.alignment == "poses"
    assert on_the_line.ate == pytest.approx(0, abs=1e-9)
    wavering = disturbed(poses, degrees=0.0, shift=0.02, seed=1)
    nearly = absolute_pose_errors(disturbed(wavering, degrees=0.1, shift=0.02), wavering)
    assert nearly.alignment == "centers"
    assert nearly.rotation_deg < 0.15


def test_what_cannot_be_scored_says_why():
    poses = some_poses(4)
    nobody = pose_scores(poses, poses, torch.zeros(4, dtype=torch.bool))
    assert nobody.maa30 == 0
    assert isinstance(nobody.ate, NotComputed)
    entries = summary_entries({"ate": nobody.ate, "registered": nobody.registered})
    assert entries == {"ate": None, "ate_reason": "0 of 4 frames registered, at least 2 are needed", "registered": 0}
    turning = poses.clone()
    turning[:, :3, 3] = 2.0
    standing = pose_scores(turning, turning)
    assert isinstance(standing.ate, NotComputed)
    assert "one spot" in standing.ate.reason
    assert isinstance(standing.translation_deg, NotComputed)
    assert standing.rotation_deg == pytest.approx(0, abs=1e-6)
