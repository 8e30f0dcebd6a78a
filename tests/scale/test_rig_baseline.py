"""The scale by the baseline of a rig: exact, with its uncertainty, and wrong input by name."""

from dataclasses import replace

import pytest
import torch
from tests.rig_scene import BASELINE, RIGHT, UNIT, reconstruction, stereo

from swimm3r.errors import InputError
from swimm3r.geometry import invert_poses
from swimm3r.scale.estimate import estimate_scale
from swimm3r.scale.rig import has_known_baseline
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scene.rig import PlacedCamera, RigFit, pose_of


@pytest.fixture
def run():
    """A reconstruction as a rig, and its frames."""
    poses, frames = stereo()
    pose = torch.from_numpy(RIGHT.copy())
    pose[:3, 3] /= UNIT
    eye = torch.eye(4).double().numpy()
    cameras = (
        PlacedCamera("left", pose_of(eye), 14, 0.0, 0.0),
        PlacedCamera("right", pose_of(invert_poses(pose).numpy()), 14, BASELINE / UNIT, 0.001),
    )
    return replace(reconstruction(poses, frames), rig=RigFit(cameras, True, 0.3, 0.3)), frames


def solved(run, **options):
    rec, frames = run
    return estimate_scale(rec, frames, ScaleSettings(**options))


def with_known(run, length):
    rec, frames = run
    first, second = rec.rig.cameras
    known = replace(second, known_baseline=length)
    return replace(rec, rig=replace(rec.rig, cameras=(first, known))), frames


def test_a_baseline_gives_the_scale_with_the_errors_of_both_lengths(run):
    solution = solved(run, baseline=BASELINE, baseline_std=0.0003).solution
    assert solution.scale == pytest.approx(UNIT, rel=1e-9)
    assert solution.std == pytest.approx((0.001**2 + 0.003**2 + 0.0005**2) ** 0.5, rel=1e-6)
    assert solution.sources[0].estimate.source == "baseline left to right"


def test_a_calibrated_baseline_needs_no_option(run):
    assert not has_known_baseline(run[0])
    known = with_known(run, BASELINE)
    assert has_known_baseline(known[0])
    assert solved(known).solution.scale == pytest.approx(UNIT, rel=1e-9)


def test_a_given_and_a_calibrated_baseline_that_differ_contradict_each_other(run):
    with pytest.raises(InputError, match="contradict each other"):
        solved(with_known(run, 0.12), baseline=BASELINE)


def test_centimetres_for_metres_are_doubted(run):
    assert solved(run, baseline=BASELINE).notes == ()
    (note,) = solved(run, baseline=10.0).notes
    assert "puts the scene 1" in note
    assert "check that it is in metres" in note


def test_a_baseline_without_a_rig_is_refused(run):
    rec, frames = run
    with pytest.raises(InputError, match="no rigid rig"):
        estimate_scale(replace(rec, rig=None), frames, ScaleSettings(baseline=0.1))


def test_a_rig_that_is_not_rigid_gives_no_scale(run):
    rec, frames = with_known(run, BASELINE)
    apart = replace(rec, rig=replace(rec.rig, rigid=False))
    assert not has_known_baseline(apart)
    with pytest.raises(InputError, match="moved apart"):
        estimate_scale(apart, frames, ScaleSettings(baseline=0.1))
