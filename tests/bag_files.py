"""ROS bags as tests need them, written with rosbags' own types."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

VERSIONS = ("bag", "sqlite3", "mcap")
SECOND = 10**9
START = 1_700_000_000 * SECOND + 123_456_789

TF = "tf2_msgs/msg/TFMessage"
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))


@dataclass(frozen=True)
class Sent:
    """A message, the topic it goes to, and when it is recorded."""

    topic: str
    type: str
    fields: dict[str, Any]  # beside the header
    stamp: int
    received: int | None = None  # by default a hundredth of a second after the stamp
    frame_id: str = "camera"


def write_bag(folder: Path, version: str, sent: Sequence[Sent], name: str = "dive") -> Path:
    """The path of a bag: a .bag file, or a folder of version 2."""
    old = version == "bag"
    store, path = (ROS1, folder / f"{name}.bag") if old else (ROS2, folder / f"{name}_{version}")
    plugin = StoragePlugin.MCAP if version == "mcap" else StoragePlugin.SQLITE3
    with Writer1(path) if old else Writer2(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for one in sorted(sent, key=received):
            if one.topic not in connections:
                connections[one.topic] = writer.add_connection(one.topic, one.type, typestore=store)
            fields = one.fields
            if one.type == TF:
                fields = {"transforms": [transform(store, one, *each, old=old) for each in fields["transforms"]]}
            else:
                fields = {"header": header(store, one.stamp, one.frame_id, old=old), **fields}
            fields = {key.upper() if old and key in ("k", "d", "r", "p") else key: v for key, v in fields.items()}
            message = store.types[one.type](**{key: built(store, value) for key, value in fields.items()})
            serialize = store.serialize_ros1 if old else store.serialize_cdr
            writer.write(connections[one.topic], received(one), serialize(message, one.type))
    return path


def received(one: Sent) -> int:
    return one.stamp + SECOND // 100 if one.received is None else one.received


def header(store: Any, stamp: int, frame_id: str, *, old: bool) -> Any:
    time = store.types["builtin_interfaces/msg/Time"](stamp // SECOND, stamp % SECOND)
    sequence = {"seq": 0} if old else {}
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id, **sequence)


def transform(store: Any, sent: Sent, parent: str, child: str, pose: np.ndarray, *, old: bool) -> Any:
    """A TransformStamped: `pose` takes points of the child to the parent."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    x0, y0, z0 = pose[:3, 3].tolist()
    fields = (
        "geometry_msgs/msg/Transform",
        {
            "translation": ("geometry_msgs/msg/Vector3", {"x": x0, "y": y0, "z": z0}),
            "rotation": ("geometry_msgs/msg/Quaternion", {"x": x, "y": y, "z": z, "w": w}),
        },
    )
    return store.types["geometry_msgs/msg/TransformStamped"](
        header=header(store, sent.stamp, parent, old=old), child_frame_id=child, transform=built(store, fields)
    )


def transforms(topic: str, poses: Sequence[tuple[str, str, np.ndarray]], stamp: int) -> Sent:
    """A message of tf: parent, child, and the pose that takes points of the child to the parent."""
    return Sent(topic, TF, {"transforms": list(poses)}, stamp)


def built(store: Any, value: Any) -> Any:
    """A field; (type, fields) stands for a message within a message."""
    if isinstance(value, tuple) and len(value) == 2 and isinstance(value[0], str):
        return store.types[value[0]](**{key: built(store, inner) for key, inner in value[1].items()})
    return value


def image(topic: str, pixels: np.ndarray, encoding: str, stamp: int, pad: int = 0, **other: Any) -> Sent:
    """An Image of pixels as they lie in memory, with rows that are `pad` bytes longer."""
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, pad)), constant_values=7)
    fields = {
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": int(pixels.dtype.byteorder == ">"),
        "step": rows.shape[1],
        "data": rows.ravel(),
    }
    return Sent(topic, "sensor_msgs/msg/Image", fields, stamp, **other)


def compressed(topic: str, data: bytes, format: str, stamp: int) -> Sent:
    fields = {"format": format, "data": np.frombuffer(data, np.uint8)}
    return Sent(topic, "sensor_msgs/msg/CompressedImage", fields, stamp)


def camera_info(
    topic: str,
    size: tuple[int, int],
    K: Sequence[float],
    D: Sequence[float],
    stamp: int,
    roi: Sequence[int] = (0, 0, 0, 0),
    R: np.ndarray | None = None,
    P: np.ndarray | None = None,
) -> Sent:
    x, y, width, height = roi
    region = {"x_offset": x, "y_offset": y, "width": width, "height": height, "do_rectify": False}
    fields = {
        "height": size[1],
        "width": size[0],
        "distortion_model": "plumb_bob",
        "d": np.array(D, np.float64),
        "k": np.array(K, np.float64),
        "r": (np.eye(3) if R is None else R).ravel(),
        "p": (np.insert(np.array(K, np.float64).reshape(3, 3), 3, 0, axis=1) if P is None else P).ravel(),
        "binning_x": 0,
        "binning_y": 0,
        "roi": ("sensor_msgs/msg/RegionOfInterest", region),
    }
    return Sent(topic, "sensor_msgs/msg/CameraInfo", fields, stamp)
