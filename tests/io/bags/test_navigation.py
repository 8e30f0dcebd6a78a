"""Fixes, odometry, IMUs and pressures of a bag as navigation, in the axes and units of the record."""

from pathlib import Path

import numpy as np
import pytest
from tests.bag_files import SECOND, START, VERSIONS, Sent, image, write_bag

from swimm3r.errors import InputError, UsageError
from swimm3r.io.navigation.pressure import depth_of_pressure
from swimm3r.io.navigation.read import read_navigation

TIMES = [START + i * SECOND for i in range(5)]
BOW_EAST, BOW_NORTH = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))  # of ROS: x forward, along east


def fix(i: int, status: int = 0, covariance: int = 2) -> Sent:
    fields = {
        "status": ("sensor_msgs/msg/NavSatStatus", {"status": status, "service": 1}),
        "latitude": 43.0 + 1e-5 * i,
        "longitude": 7.0,
        "altitude": 12.0,
        "position_covariance": np.diag([0.25, 0.36, 4.0]).ravel(),
        "position_covariance_type": covariance,
    }
    return Sent("/gps/fix", "sensor_msgs/msg/NavSatFix", fields, TIMES[i])


def pose(at: tuple[float, float, float], turned: tuple[float, ...]) -> tuple:
    place = ("geometry_msgs/msg/Point", dict(zip("xyz", at, strict=True)))
    turn = ("geometry_msgs/msg/Quaternion", dict(zip("xyzw", turned, strict=True)))
    return "geometry_msgs/msg/Pose", {"position": place, "orientation": turn}


def odometry(i: int, topic: str = "/odom", turned=BOW_EAST) -> Sent:
    still = ("geometry_msgs/msg/Vector3", {"x": 0.0, "y": 0.0, "z": 0.0})
    covariance = np.diag([0.01, 0.04, 0.09, 0, 0, 0]).ravel()
    twist = ("geometry_msgs/msg/Twist", {"linear": still, "angular": still})
    fields = {
        "child_frame_id": "base_link",
        "pose": ("geometry_msgs/msg/PoseWithCovariance", {"pose": pose((i, 2, -3), turned), "covariance": covariance}),
        "twist": ("geometry_msgs/msg/TwistWithCovariance", {"twist": twist, "covariance": np.zeros(36)}),
    }
    return Sent(topic, "nav_msgs/msg/Odometry", fields, TIMES[i])


def imu(i: int, turned=BOW_NORTH, known: float = 0.0) -> Sent:
    vector = ("geometry_msgs/msg/Vector3", {"x": 0.0, "y": 0.0, "z": 0.0})
    fields = {
        "orientation": ("geometry_msgs/msg/Quaternion", dict(zip("xyzw", turned, strict=True))),
        "orientation_covariance": np.array([known, *[0.0] * 8]),
        "angular_velocity": vector,
        "angular_velocity_covariance": np.zeros(9),
        "linear_acceleration": vector,
        "linear_acceleration_covariance": np.zeros(9),
    }
    return Sent("/imu/data", "sensor_msgs/msg/Imu", fields, TIMES[i] + SECOND // 10 * (1 if i else -1))


def pressure(i: int, pascal: float) -> Sent:
    return Sent("/pressure", "sensor_msgs/msg/FluidPressure", {"fluid_pressure": pascal, "variance": 0.0}, TIMES[i])


@pytest.mark.parametrize("version", VERSIONS)
def test_odometry_has_positions_their_spread_and_attitude(version: str, tmp_path: Path):
    found = read_navigation(write_bag(tmp_path, version, [odometry(i) for i in range(5)]))
    assert (found.frame, found.clock) == ("local", "utc")
    np.testing.assert_allclose(found.position, [[i, 2, -3] for i in range(5)])
    np.testing.assert_allclose(found.time, np.array(TIMES) * 1e-9)
    np.testing.assert_allclose(np.asarray(found.std), np.tile([0.1, 0.2, 0.3], (5, 1)))
    np.testing.assert_allclose(found.attitude[0], [[1, 0, 0], [0, -1, 0], [0, 0, -1]], atol=1e-12)  # starboard is south


def test_fixes_take_their_height_from_pressure_and_their_attitude_from_the_imu(tmp_path: Path):
    pascal = [101_325.0 + 1e4 * 10 * i for i in range(5)]  # 1 bar more each second
    sent = [*map(fix, range(5)), *map(imu, range(5)), *(pressure(i, p) for i, p in enumerate(pascal))]
    found = read_navigation(write_bag(tmp_path, "mcap", sent))
    assert found.frame == "geodetic"
    np.testing.assert_allclose(found.position[:, :2], [[43 + 1e-5 * i, 7] for i in range(5)])
    np.testing.assert_allclose(found.position[:, 2], -depth_of_pressure(np.arange(5.0), 43.0), atol=1e-9)
    np.testing.assert_allclose(found.std[:, :2], np.tile([0.5, 0.6], (5, 1)))
    np.testing.assert_allclose(found.attitude[2, :, 0], [0, 1, 0], atol=1e-9)  # the bow points north


def test_the_height_of_an_antenna_is_not_that_of_a_diver(tmp_path: Path):
    found = read_navigation(write_bag(tmp_path, "bag", list(map(fix, range(5)))))
    assert np.isinf(found.std[:, 2]).all()
    assert found.attitude is None


def test_rows_without_a_fix_and_orientations_that_are_not_stated_are_left_out(tmp_path: Path):
    sent = [*(fix(i, status=-1 if i == 2 else 0) for i in range(5)), *(imu(i, known=-1.0) for i in range(5))]
    found = read_navigation(write_bag(tmp_path, "mcap", sent))
    assert len(found) == 4
    assert found.attitude is None


def test_pressure_alone_gives_heights_and_says_nothing_of_east_and_north(tmp_path: Path):
    found = read_navigation(write_bag(tmp_path, "mcap", [pressure(i, 3e5 + 1e3 * i) for i in range(5)]))
    assert np.isinf(found.std[:, :2]).all()
    assert found.position[0, 2] == pytest.approx(-19.75, abs=0.1)
    assert np.all(np.diff(found.position[:, 2]) < 0)


def test_a_gauge_that_is_zero_at_the_surface_is_not_taken_for_a_vacuum(tmp_path: Path):
    found = read_navigation(write_bag(tmp_path, "mcap", [pressure(i, 1e5 * i) for i in range(5)]))
    assert found.position[0, 2] == pytest.approx(0.0, abs=1e-6)


def test_several_topics_of_positions_need_a_choice(tmp_path: Path):
    path = write_bag(tmp_path, "mcap", [*(odometry(i) for i in range(5)), *(odometry(i, "/slam") for i in range(5))])
    with pytest.raises(UsageError, match=r"2 topics of positions: /odom") as told:
        read_navigation(path)
    assert "--nav-topic /odom" in told.value.hint
    assert len(read_navigation(path, "/slam")) == 5
    with pytest.raises(UsageError, match="no topic of positions /none"):
        read_navigation(path, "/none")


def test_a_bag_without_navigation_is_refused(tmp_path: Path):
    path = write_bag(tmp_path, "mcap", [image("/cam/image_raw", np.zeros((8, 8, 3), np.uint8), "rgb8", START)])
    with pytest.raises(InputError, match="holds no positions and no pressure"):
        read_navigation(path)
    none = write_bag(tmp_path, "bag", [fix(i, status=-1) for i in range(5)])
    with pytest.raises(InputError, match=r"/gps/fix in .* has no position"):
        read_navigation(none)


def test_a_topic_of_a_file_without_topics_is_refused(tmp_path: Path):
    (tmp_path / "nav.csv").write_text("time,x,y\n0,0,0\n1,1,0\n")
    with pytest.raises(UsageError, match="has no topics"):
        read_navigation(tmp_path / "nav.csv", "/odom")
