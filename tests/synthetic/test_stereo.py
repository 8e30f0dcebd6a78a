"""Stereo dives: a second camera at an exact distance, at the same time or later."""

from dataclasses import replace

import pytest
import torch

from swimm3r.geometry import invert_poses
from swimm3r.synthetic import DiveSettings, make_dive

SMALL = DiveSettings(frames=6, width=64, height=48)
TRANSECT = replace(SMALL, path="transect", length=4.0, fps=1.0)


@pytest.mark.parametrize("way", [SMALL, TRANSECT])
def test_the_second_camera_keeps_its_distance(way: DiveSettings):
    dive = make_dive(replace(way, stereo=0.12))
    assert dive.names[:2] == ("left/0000.png", "right/0000.png")
    relative = invert_poses(dive.cameras.cam2world[::2]) @ dive.cameras.cam2world[1::2]
    offset = torch.tensor([0.12, 0, 0], dtype=torch.float64)
    assert (relative[:, :3, 3] - offset).abs().max() < 1e-12
    assert (relative - relative[0]).abs().max() < 1e-12


def test_the_first_camera_goes_where_a_single_one_goes():
    one, two = make_dive(SMALL), make_dive(replace(SMALL, stereo=0.1))
    assert torch.equal(one.cameras.cam2world, two.cameras.cam2world[::2])
    assert one.names == tuple(name.removeprefix("left/") for name in two.names[::2])
    assert torch.equal(one.frame(0).clear, two.frame(0).clear)


def test_a_late_camera_is_where_the_rig_is_by_then():
    together = make_dive(replace(TRANSECT, stereo=0.1))
    late = make_dive(replace(TRANSECT, stereo=0.1, stereo_delay=1.0))
    assert torch.allclose(late.cameras.cam2world[1:-2:2], together.cameras.cam2world[3::2])
    assert torch.equal(late.cameras.cam2world[::2], together.cameras.cam2world[::2])
    assert late.seconds(1) == 1.0
