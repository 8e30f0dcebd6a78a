"""Navigation of a ROS bag: fixes or odometry, heights by the pressure of the water, attitude by an IMU.

ROS has vehicles with x forward, y to port and z up, and the world with x east, y north and z up (REP 103). Times are
those of the headers.
"""

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from swimm3r.errors import InputError
from swimm3r.io.bags.bag import Bag, open_bag
from swimm3r.io.bags.topics import FIX, IMU, POSE, PRESSURE, Topics, choose_positions, topics_of
from swimm3r.io.navigation.clock import is_date
from swimm3r.io.navigation.pressure import depth_of_pressure
from swimm3r.io.navigation.record import PORT_UP, Navigation

log = logging.getLogger(__name__)

_NO_FIX = -1  # NavSatStatus
_GAUGE = 0.5  # bar; absolute pressures are never below, those above the air's are at the surface
_UNKNOWN = 0.0  # variance: the message has none

Sample = tuple[float, np.ndarray]  # seconds of the header, values


def read_bag(path: Path, topic: str | None = None) -> Navigation:
    """The positions of a topic of that name, or the only one's. Raises UsageError where there is a choice."""
    with open_bag(path) as bag:
        topics = topics_of(bag)
        chosen = choose_positions(topics, topic)
        if chosen is None:
            return _depths_alone(bag, topics)
        read = _fix if chosen.type == FIX else _pose_reader(chosen.type)
        samples = _samples(bag, chosen.name, read)
        if not samples:
            raise InputError(
                f"{chosen.name} in {path} has no position",
                cause="the receiver never had a fix, which it has at the surface alone",
                hint=f"another topic of swimm3r topics {path}",
            )
        time, values = np.array([t for t, _ in samples]), np.array([row for _, row in samples])
        position, variance, quaternion = values[:, :3], values[:, 3:6], values[:, 6:]
        navigation = Navigation(
            path=path,
            frame="geodetic" if chosen.type == FIX else "local",
            position=position,
            clock="utc" if is_date(float(time[0])) else "clip",
            time=time,
            std=np.where(variance > 0, np.sqrt(variance), np.nan) if (variance > 0).any() else None,
            attitude=None if np.isnan(quaternion).all() else _attitudes(quaternion),
        )
        return _with_attitude(_with_depth(navigation, bag, topics), bag, topics)


def _depths_alone(bag: Bag, topics: Topics) -> Navigation:
    """Heights of a bag without positions. Raises InputError where it has no pressure either."""
    depths = _depths(bag, topics, 45.0)
    if depths is None:
        raise InputError(
            f"{bag.path} holds no positions and no pressure",
            cause="fixes, odometry, poses and pressures were not recorded",
            hint=f"swimm3r topics {bag.path} lists what the bag holds",
        )
    time, depth = depths
    position = np.stack([np.zeros_like(depth), np.zeros_like(depth), -depth], -1)
    std = np.tile([np.inf, np.inf, np.nan], (len(depth), 1))
    clock = "utc" if is_date(float(time[0])) else "clip"
    return _with_attitude(Navigation(bag.path, "local", position, clock, time, std=std), bag, topics)


def _with_depth(navigation: Navigation, bag: Bag, topics: Topics) -> Navigation:
    """Heights by pressure in the place of those of fixes, which are the antenna's; rows beyond them are left out."""
    if navigation.frame != "geodetic":
        return navigation
    depths = _depths(bag, topics, float(np.median(navigation.position[:, 0])))
    std = np.full_like(navigation.position, np.nan) if navigation.std is None else navigation.std.copy()
    if depths is None:
        std[:, 2] = np.inf
        return replace(navigation, std=std)
    time, depth = depths
    inside = (navigation.time >= time[0]) & (navigation.time <= time[-1])
    position = navigation.position.copy()
    position[:, 2], std[:, 2] = -np.interp(navigation.time, time, depth), np.nan
    return replace(navigation, position=position, std=std).rows(inside)


def _with_attitude(navigation: Navigation, bag: Bag, topics: Topics) -> Navigation:
    """The orientation of the only IMU that states one, where the positions have none."""
    imus = [topic for topic in topics.used_for("orientation") if topic.type == IMU]
    if navigation.attitude is not None or len(imus) != 1:
        return navigation
    samples = _samples(bag, imus[0].name, _orientation)
    if len(samples) < 2:
        return navigation
    from scipy.spatial.transform import Rotation, Slerp

    known = {time: quaternion for time, quaternion in samples}
    time = np.array(sorted(known))
    turning = Slerp(time, Rotation.from_quat(np.array([known[t] for t in time.tolist()])))
    attitude = np.full((len(navigation), 3, 3), np.nan)
    inside = (navigation.time >= time[0]) & (navigation.time <= time[-1])
    attitude[inside] = turning(navigation.time[inside]).as_matrix() @ PORT_UP
    return replace(navigation, attitude=attitude) if inside.any() else navigation


def _depths(
    bag: Bag, topics: Topics, latitude: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]] | None:
    """Times and depths of the first topic of pressures; None without one."""
    topic = next((topic for topic in topics.used_for("depth") if topic.type == PRESSURE), None)
    samples = [] if topic is None else sorted(_samples(bag, topic.name, _pressure), key=lambda sample: sample[0])
    if not samples:
        return None
    bar = np.array([float(value[0]) for _, value in samples])
    absolute = bool(bar.min() > _GAUGE)
    return np.array([time for time, _ in samples]), depth_of_pressure(bar, latitude, absolute=absolute)


def _samples(bag: Bag, topic: str, read: Callable[[Any], np.ndarray | None]) -> list[Sample]:
    """Times and values of the messages that hold any. Raises ValueError where one is damaged."""
    found = []
    for message in bag.messages(topic):
        values = read(bag.content(message))
        if values is not None:
            found.append((message.stamp * 1e-9, values))
    if bag.cut is not None:
        log.warning(
            "%s cannot be read to its end (%s): %d messages of %s are used", bag.path, bag.cut, len(found), topic
        )
    return found


def _fix(message: Any) -> np.ndarray | None:
    """Latitude, longitude and height of a NavSatFix, variances east, north and up, and no orientation."""
    place = np.array([message.latitude, message.longitude, message.altitude])
    if int(message.status.status) == _NO_FIX or not np.isfinite(place[:2]).all():
        return None
    known = int(message.position_covariance_type) > 0
    variance = np.asarray(message.position_covariance)[[0, 4, 8]] if known else np.zeros(3)
    return np.concatenate([np.nan_to_num(place), variance, np.full(4, np.nan)])


def _pose_reader(type_: str) -> Callable[[Any], np.ndarray]:
    def read(message: Any) -> np.ndarray:
        with_covariance = type_ != POSE
        pose = message.pose.pose if with_covariance else message.pose
        variance = np.asarray(message.pose.covariance)[[0, 7, 14]] if with_covariance else np.full(3, _UNKNOWN)
        at, turned = pose.position, pose.orientation
        quaternion = np.array([turned.x, turned.y, turned.z, turned.w])
        if np.linalg.norm(quaternion) < 0.1:
            quaternion = np.full(4, np.nan)
        return np.concatenate([[at.x, at.y, at.z], variance, quaternion])

    return read


def _orientation(message: Any) -> np.ndarray | None:
    """The quaternion x, y, z, w of an Imu; None where it has none, by its covariance or its length."""
    turned = message.orientation
    quaternion = np.array([turned.x, turned.y, turned.z, turned.w])
    stated = np.asarray(message.orientation_covariance)[0] != -1
    return quaternion if stated and np.linalg.norm(quaternion) > 0.1 else None


def _pressure(message: Any) -> np.ndarray:
    return np.array([message.fluid_pressure * 1e-5])


def _attitudes(quaternions: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3 3"]:
    from scipy.spatial.transform import Rotation

    out = np.full((len(quaternions), 3, 3), np.nan)
    known = np.isfinite(quaternions).all(1)
    out[known] = Rotation.from_quat(quaternions[known]).as_matrix() @ PORT_UP
    return out
