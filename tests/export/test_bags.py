"""Poses come back from a bag, and from a TUM file, with the stamps of the images that went in."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from tests.bag_files import SECOND, START
from tests.export.conftest import COUNT, cameras

from swimm3r.errors import StorageError, UsageError
from swimm3r.export import export_run
from swimm3r.export.settings import Rosbag2Settings, RosbagSettings, TumSettings
from swimm3r.io.bags.bag import open_bag
from swimm3r.io.navigation.read import read_navigation


@pytest.fixture
def run_of_a_bag(sfm_run: Path, tmp_path: Path) -> Path:
    """A run whose images were stamped, a quarter of a second apart."""
    folder = shutil.copytree(sfm_run, tmp_path / "run")
    path = folder / "prepare" / "frames.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "start_ns": START}))
    return folder


STAMPS = [START + i * SECOND // 4 for i in range(COUNT)]


@pytest.mark.parametrize("settings", [RosbagSettings(), Rosbag2Settings(), Rosbag2Settings(storage="sqlite3")])
def test_a_bag_of_poses_has_the_stamps_of_the_images(settings, run_of_a_bag: Path, tmp_path: Path):
    path = tmp_path / ("poses.bag" if isinstance(settings, RosbagSettings) else "poses")
    told = str(export_run(run_of_a_bag, path, settings))
    assert f"{COUNT} poses, in metres, times of the images' headers" in told
    with open_bag(path) as bag:
        assert bag.types == {"/swimm3r/pose": "geometry_msgs/msg/PoseStamped", "/swimm3r/path": "nav_msgs/msg/Path"}
        assert [message.stamp for message in bag.messages("/swimm3r/pose")] == STAMPS
        (only,) = bag.messages("/swimm3r/path")
        whole = bag.content(only)
        at = [[pose.pose.position.x, pose.pose.position.y, pose.pose.position.z] for pose in whole.poses]
    np.testing.assert_allclose(at, cameras().centers.numpy())
    again = read_navigation(path)
    np.testing.assert_allclose(again.position, cameras().centers.numpy())
    np.testing.assert_allclose(again.attitude @ np.diag([1, -1, -1]), cameras().cam2world[:, :3, :3].numpy(), atol=1e-9)


def test_a_tum_trajectory_has_the_stamps_to_the_nanosecond(run_of_a_bag: Path, tmp_path: Path):
    export_run(run_of_a_bag, tmp_path / "poses.tum", TumSettings())
    times = [line.split()[0] for line in (tmp_path / "poses.tum").read_text().splitlines()]
    assert times == [f"{stamp // SECOND}.{stamp % SECOND:09d}" for stamp in STAMPS]


def test_what_others_made_is_not_replaced(run_of_a_bag: Path, tmp_path: Path):
    (tmp_path / "poses.bag").write_text("mine")
    with pytest.raises(UsageError, match="no ROS 1 bag"):
        export_run(run_of_a_bag, tmp_path / "poses.bag", RosbagSettings())
    with pytest.raises(StorageError, match="other things lie in it"):
        export_run(run_of_a_bag, tmp_path, Rosbag2Settings())
    export_run(run_of_a_bag, tmp_path / "twice.bag", RosbagSettings())
    export_run(run_of_a_bag, tmp_path / "twice.bag", RosbagSettings())
