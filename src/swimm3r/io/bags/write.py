"""Camera poses -> a bag: a PoseStamped per frame at its time, and all of them as one Path."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float

from swimm3r.geometry import quaternion_from_rotation
from swimm3r.io.bags.bag import ros_package

Version = Literal["bag", "sqlite3", "mcap"]

_VERSION_2 = 9  # of metadata.yaml, which ROS 2 Jazzy and later write
_POSE, _PATH = "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Path"


def write_poses(
    path: Path,
    version: Version,
    stamps: Sequence[int],
    cam2world: Float[np.ndarray, "c 4 4"],
    space: str = "/swimm3r",
    frame_id: str = "map",
) -> None:
    """Write poses (camera to world, z forward) in the order of their stamps, nanoseconds, to `space`/pose and /path.

    A file, or of version 2 a folder; nothing may be there. Raises DeviceError without rosbags.
    """
    old = version == "bag"
    typesys = ros_package("typesys")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if old else typesys.Stores.ROS2_HUMBLE)
    order = np.argsort(np.asarray(stamps), kind="stable").tolist()
    poses = [_pose(store, stamps[i], cam2world[i], frame_id, old=old) for i in order]
    with _writer(path, version) as writer:
        pose_topic = writer.add_connection(f"{space}/pose", _POSE, typestore=store)
        path_topic = writer.add_connection(f"{space}/path", _PATH, typestore=store)
        serialize = store.serialize_ros1 if old else store.serialize_cdr
        for i, pose in zip(order, poses, strict=True):
            writer.write(pose_topic, stamps[i], serialize(pose, _POSE))
        last = stamps[order[-1]]
        whole = store.types[_PATH](header=_header(store, last, frame_id, old=old), poses=poses)
        writer.write(path_topic, last, serialize(whole, _PATH))


def _writer(path: Path, version: Version) -> Any:
    if version == "bag":
        return ros_package("rosbag1").Writer(path)
    rosbag2 = ros_package("rosbag2")
    plugin = rosbag2.StoragePlugin.MCAP if version == "mcap" else rosbag2.StoragePlugin.SQLITE3
    return rosbag2.Writer(path, version=_VERSION_2, storage_plugin=plugin)


def _header(store: Any, stamp: int, frame_id: str, *, old: bool) -> Any:
    time = store.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    sequence = {"seq": 0} if old else {}
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id, **sequence)


def _pose(store: Any, stamp: int, cam2world: Float[np.ndarray, "4 4"], frame_id: str, *, old: bool) -> Any:
    w, x, y, z = quaternion_from_rotation(torch.from_numpy(cam2world[:3, :3]).double()).tolist()
    pose = store.types["geometry_msgs/msg/Pose"](
        position=store.types["geometry_msgs/msg/Point"](*cam2world[:3, 3].tolist()),
        orientation=store.types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
    )
    return store.types[_POSE](header=_header(store, stamp, frame_id, old=old), pose=pose)
