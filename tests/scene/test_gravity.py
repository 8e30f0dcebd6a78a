"""Up by the gravity that a camera measured: from frames to the axes of a run, and on real footage."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.scale.conftest import TURN, Survey, lines, survey_along

from swimm3r.io.telemetry.of_images import telemetry_of_images
from swimm3r.prepare import load_frames, read_frames
from swimm3r.scene.frames import Frames
from swimm3r.scene.georeference import up_from_scene
from swimm3r.scene.gravity import with_measured_up
from swimm3r.scene.reconstruction_io import load_reconstruction

UP = TURN[:, 2]  # of the survey, in the axes of its run


@pytest.fixture(scope="module")
def survey() -> Survey:
    return survey_along(lines(count=2, each=6))


def measured(survey: Survey, noise_deg: float, seed: int = 0) -> Frames:
    """Frames whose camera measured gravity, with noise."""
    rng = np.random.default_rng(seed)
    rotations = survey.rec.cameras.cam2world[:, :3, :3].numpy()
    ups = [Rotation.from_rotvec(np.radians(noise_deg) * rng.normal(size=3)).apply(R.T @ UP).tolist() for R in rotations]
    frames = tuple(replace(frame, up=tuple(up)) for frame, up in zip(survey.frames, ups, strict=True))
    return replace(survey.frames, frames=frames)


def test_up_is_the_mean_of_what_the_frames_measured(survey):
    found = with_measured_up(survey.rec, measured(survey, 0.5)).up
    assert found is not None
    assert np.degrees(np.arccos(min(1.0, np.array(found) @ UP))) < 0.5
    np.testing.assert_allclose(up_from_scene(with_measured_up(survey.rec, measured(survey, 0.0)))[2], UP, atol=1e-6)


def test_a_few_frames_of_a_jerking_hand_do_not_turn_it(survey):
    frames = measured(survey, 0.2)
    wild = tuple(replace(frame, up=(1.0, 0.0, 0.0)) if i in (2, 7) else frame for i, frame in enumerate(frames))
    found = with_measured_up(survey.rec, replace(frames, frames=wild)).up
    assert found is not None
    assert np.degrees(np.arccos(min(1.0, np.array(found) @ UP))) < 1.0


def test_measurements_that_contradict_the_poses_tell_nothing(survey):
    assert with_measured_up(survey.rec, measured(survey, 25.0)).up is None
    assert with_measured_up(survey.rec, survey.frames).up is None


def test_up_is_kept_on_disk_with_frames_and_reconstruction(survey, tmp_path):
    rec = with_measured_up(survey.rec, measured(survey, 0.5))
    rec.save(tmp_path / "sfm")
    assert load_reconstruction(tmp_path / "sfm").up == pytest.approx(rec.up, abs=1e-12)


@pytest.mark.shared
def test_a_gopro_holds_up_in_the_axes_of_its_images(shared: Path, tmp_path):
    reef = shared / "data" / "gopro_reef" / "reef.mp4"
    found = telemetry_of_images(reef, [0.5, 3.0, 6.0]).up
    assert found is not None
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-9)
    assert (found[:, 1] < -0.8).all()  # filmed ahead and some 20 degrees down
    assert (np.abs(found[:, 0]) < 0.2).all()
    frames = read_frames(reef, folder=tmp_path / "frames", fps=1, end=3, long_side=160)
    assert all(frame.up is not None and np.linalg.norm(frame.up) == pytest.approx(1, abs=1e-5) for frame in frames)
    assert load_frames(tmp_path / "frames") == frames


@pytest.mark.shared
def test_a_clip_whose_telemetry_was_cut_off_by_an_editor_has_no_up(shared: Path):
    found = telemetry_of_images(shared / "data" / "gopro_transect" / "transect.mp4", [0.5])
    assert found.up is None
    assert found.gains is None
