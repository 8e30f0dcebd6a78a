"""TUM trajectories say when and where."""

from pathlib import Path

import numpy as np
import torch

from swimm3r.geometry import pose_from, so3_exp
from swimm3r.io.trajectory import tum_line, write_tum


def test_a_line_turns_back_into_the_pose():
    pose = pose_from(so3_exp(torch.tensor([0.3, -0.2, 0.5]).double()), torch.tensor([1.0, 2.0, 3.0]).double())
    time, *numbers = (float(value) for value in tum_line(0.25, pose.numpy()).split())
    assert (time, numbers[:3]) == (0.25, [1.0, 2.0, 3.0])
    x, y, z, w = numbers[3:]
    v = torch.tensor([x, y, z]).double()
    angle = 2 * torch.atan2(v.norm(), torch.tensor(w))
    torch.testing.assert_close(so3_exp(angle * v / v.norm()), pose[:3, :3], atol=1e-6, rtol=0)


def test_poses_stand_in_the_order_of_their_times(tmp_path: Path):
    poses = np.eye(4)[None].repeat(3, 0)
    poses[:, 0, 3] = (5, 6, 7)
    write_tum(tmp_path / "poses.tum", [0.5, 0.1, 0.3], poses)
    rows = np.loadtxt(tmp_path / "poses.tum")
    assert rows[:, 0].tolist() == [0.1, 0.3, 0.5]
    assert rows[:, 1].tolist() == [6, 7, 5]
