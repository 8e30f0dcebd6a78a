"""The section on a rig: distances with their deviation, place and turn, and how well images were taken together."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.report.conftest import Asked, write_run
from tests.rig_scene import reconstruction, stereo

from swimm3r.prepare import load_frames
from swimm3r.report import write_report
from swimm3r.report.page import _plan
from swimm3r.report.rig import rig_section
from swimm3r.report.scene import pack_scene
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.rig import PlacedCamera, RigFit, pose_of

RIGHT = np.eye(4)  # pose of the right camera in the axes of the left one
RIGHT[:3, :3] = Rotation.from_rotvec(np.radians([0.5, -2.0, 0.25])).as_matrix()
RIGHT[:3, 3] = 0.1, 0.01, -0.02
LENGTH = float(np.linalg.norm(RIGHT[:3, 3]))
LEFT_CAMERA = PlacedCamera("left", pose_of(np.eye(4)), 9, 0.0, 0.0)
RIGHT_CAMERA = PlacedCamera("right", pose_of(np.linalg.inv(RIGHT)), 9, LENGTH, 0.002)


def summary(right: PlacedCamera = RIGHT_CAMERA, *, rigid: bool = True, metric: bool = True) -> dict:
    fit = RigFit((LEFT_CAMERA, right), rigid, 0.41, 0.44)
    return {"rig": json.loads(json.dumps(asdict(fit))), "sfm": {"metric": metric}}


def frames(later: float = 0.0) -> Frames:
    listed = (
        Frame(f"{side}/{i}.png", Path(), i / 5 + later * k, 1.0, "train", camera=side, instant=i)
        for i in range(9)
        for k, side in enumerate(("left", "right"))
    )
    return Frames(tuple(listed), 64, 48, True)


def test_a_single_camera_has_no_section():
    assert rig_section({"sfm": {"metric": True}}, frames()) is None


def test_the_second_camera_is_placed_and_turned_in_the_axes_of_the_first():
    section = rig_section(summary(), frames())
    assert section is not None
    (row,) = section.rows
    assert section.unit == "m"
    assert "2 cameras are one rigid rig" in section.lead
    assert row.place == "0.1, 0.01, -0.02"
    assert row.turn == "0.50, -2.00, 0.25"
    assert row.baseline == "0.10247 \u00b1 0.00020"
    assert row.known == "not known"
    assert section.lines == ("right and left have poses together at 9 instants.",)


def test_a_calibrated_distance_stands_beside_with_the_difference():
    known = replace(RIGHT_CAMERA, known_baseline=LENGTH / 1.01)
    for metric, told in ((True, "0.1015 m (+1.00 %)"), (False, "0.1015 m")):
        section = rig_section(summary(known, metric=metric), frames())
        assert section is not None
        assert section.rows[0].known == told


def test_times_apart_are_those_of_the_images():
    section = rig_section(summary(), frames(0.003))
    assert section is not None
    assert "right is +3 ms later, at most +3." in section.lines[0]


@pytest.mark.parametrize(("std", "meaning"), [(0.002, ": the cameras were not triggered together"), (0.05, "no sign")])
def test_a_delay_that_the_path_shows_is_told_with_its_deviation(std: float, meaning: str):
    late = replace(RIGHT_CAMERA, delay=0.04, delay_std=std)
    section = rig_section(summary(late, rigid=False), frames())
    assert section is not None
    assert "do not form a rigid rig" in section.lead
    (line,) = section.lines
    assert meaning in line
    assert "it is later by 0.20" in line


def test_the_page_shows_the_rig(tmp_path: Path):
    run = write_run(tmp_path / "run", Asked(metric=True))
    of_run = json.loads((run / "summary.json").read_text())
    assert "Cameras of the rig" not in write_report(run).read_text(encoding="utf-8")
    (run / "summary.json").write_text(json.dumps(of_run | {"rig": summary()["rig"]}))
    page = write_report(run).read_text(encoding="utf-8")
    assert "Cameras of the rig" in page
    assert "0.10247 \u00b1 0.00020" in page
    assert load_frames(run / "prepare").rig is None


def test_the_path_leads_through_one_camera_and_not_from_one_to_the_other():
    poses, clip = stereo(count=14)
    rec = reconstruction(poses, clip)
    scene, plan = pack_scene(rec, clip), _plan(rec, clip)
    assert scene is not None
    assert plan is not None
    left = rec.cameras.centers[::2].numpy()
    np.testing.assert_allclose(json.loads(scene.header)["path"], left, atol=1e-3)
    assert str(plan["overlay"]).count('r="2.5"') == len(left)
