"""The topics of a bag that can be used, and the choice of one where there are several.

A camera's lens is on the topic camera_info in the namespace of its images, as ROS has it: /left/camera_info beside
/left/image_raw and /left/image_raw/compressed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NoReturn

from swimm3r.errors import InputError, UsageError
from swimm3r.io.bags.bag import TRANSFORMS, Bag, open_bag, unreadable
from swimm3r.io.bags.pixels import is_camera_encoding, is_camera_format

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, IMU, PRESSURE = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Imu", "sensor_msgs/msg/FluidPressure"
FIX, ODOMETRY = "sensor_msgs/msg/NavSatFix", "nav_msgs/msg/Odometry"
POSE, POSE_COVARIANCE = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"

Use = Literal["images", "lens", "positions", "orientation", "depth", "transforms"]
USES: dict[str, Use] = {
    IMAGE: "images",
    COMPRESSED: "images",
    CAMERA_INFO: "lens",
    FIX: "positions",
    ODOMETRY: "positions",
    POSE: "positions",
    POSE_COVARIANCE: "positions",
    IMU: "orientation",
    PRESSURE: "depth",
    TRANSFORMS: "transforms",
}
STATIC = "/tf_static"  # the topic of transforms that hold for the whole bag
COMPRESSED_END = "/compressed"  # the last part of the names of compressed images


@dataclass(frozen=True)
class Topic:
    """A topic; times are those of the messages' headers, nanoseconds, of transforms those of recording."""

    name: str
    type: str
    count: int
    first: int
    last: int
    use: Use | None  # None where its messages cannot be used
    detail: str = ""  # size and encoding of images, or the reason why they are not used

    @property
    def rate(self) -> float:
        """Messages per second; 0 where the headers do not tell."""
        span = (self.last - self.first) * 1e-9
        return (self.count - 1) / span if span > 0 else 0.0


@dataclass(frozen=True)
class Topics:
    """The topics of a bag whose type is known, and the types of the others by their topics."""

    path: Path
    known: tuple[Topic, ...]
    others: dict[str, str]

    def used_for(self, use: Use) -> list[Topic]:
        """The topics of one use."""
        return [topic for topic in self.known if topic.use == use]


def read_topics(path: Path) -> Topics:
    """The topics of a bag. Raises InputError where it cannot be read or holds no message."""
    with open_bag(path) as bag:
        return topics_of(bag)


def topics_of(bag: Bag) -> Topics:
    """The topics of an open bag. Raises InputError where it holds no message."""
    types = bag.types
    counts = {name: bag.count(name) for name in sorted(types)}
    if not any(counts.values()):
        raise InputError(
            f"{bag.path} holds no messages",
            cause="the recording was stopped at once, or no topic was published",
            hint="another bag; ros2 bag info, or rosbag info, shows what one holds",
        )
    found = [_topic(bag, name, types[name]) for name in counts if types[name] in USES and counts[name]]
    known = tuple(topic for topic in found if topic is not None)
    if found and not known and bag.cut is not None:
        raise unreadable(bag.path, bag.cut)
    names = {topic.name for topic in known}
    return Topics(bag.path, known, {name: types[name] for name in counts if name not in names})


def choose_images(topics: Topics, asked: str | None) -> Topic:
    """The topic of images of that name, or the only camera's; of its raw and its compressed images the raw ones.

    Raises UsageError where there is a choice or no such topic, InputError where the bag holds no images.
    """
    cameras = topics.used_for("images")
    if not cameras:
        unused = "; ".join(
            f"{topic.name}: {topic.detail}" for topic in topics.known if topic.type in (IMAGE, COMPRESSED)
        )
        raise InputError(
            f"{topics.path} holds no images of a camera" + (f" ({unused})" if unused else ""),
            cause="the camera was not recorded, or its images are depth maps or a video stream",
            hint=f"swimm3r topics {topics.path} lists what the bag holds",
        )
    if asked is None:
        raw = {topic.name for topic in cameras if not topic.name.endswith(COMPRESSED_END)}
        cameras = [topic for topic in cameras if topic.name not in {name + COMPRESSED_END for name in raw}]
    return _chosen(topics.path, cameras, asked, "--topic", "images")


def choose_positions(topics: Topics, asked: str | None) -> Topic | None:
    """The topic of positions of that name, or the only one; None where the bag has none. Raises UsageError."""
    found = topics.used_for("positions")
    if not found and asked is None:
        return None
    return _chosen(topics.path, found, asked, "--nav-topic", "positions")


def lens_topic(topics: Topics, images: Topic) -> Topic | None:
    """The camera_info of a topic of images."""
    space = images.name.removesuffix(COMPRESSED_END).rpartition("/")[0]
    return next((topic for topic in topics.used_for("lens") if topic.name == f"{space}/camera_info"), None)


def _topic(bag: Bag, name: str, type_: str) -> Topic | None:
    first, last = bag.first(name), bag.last(name)
    if first is None or last is None:
        return None
    use, detail = USES[type_], ""
    if type_ == TRANSFORMS and name != STATIC:
        return Topic(name, type_, bag.count(name), first.stamp, last.stamp, None, "of what moves")
    if type_ in (IMAGE, COMPRESSED):
        try:
            content = bag.content(first)
        except ValueError as error:
            return Topic(name, type_, bag.count(name), first.stamp, last.stamp, None, f"damaged ({error})")
        if type_ == IMAGE:
            detail = f"{content.width}x{content.height} {content.encoding}"
            usable = is_camera_encoding(str(content.encoding))
        else:
            detail = str(content.format)
            usable = is_camera_format(detail)
        if not usable:
            return Topic(name, type_, bag.count(name), first.stamp, last.stamp, None, f"{detail}, which is not read")
    return Topic(name, type_, bag.count(name), first.stamp, last.stamp, use, detail)


def _chosen(path: Path, found: Sequence[Topic], asked: str | None, option: str, what: str) -> Topic:
    named = [topic for topic in found if asked in (None, topic.name)]
    if len(named) == 1:
        return named[0]
    _refuse(path, found, asked, option, what)


def _refuse(path: Path, found: Sequence[Topic], asked: str | None, option: str, what: str) -> NoReturn:
    listed = ", ".join(
        f"{topic.name} ({topic.count} messages{f', {topic.detail}' * bool(topic.detail)})" for topic in found
    )
    raise UsageError(
        f"{path} holds {len(found)} topics of {what}: {listed}"
        if asked is None
        else f"{path} has no topic of {what} {asked}, but {listed or 'none'}",
        cause="one of them is used" if asked is None else "a slip in the name",
        hint=_which(found, option) if found else f"leave out {option}",
    )


def _which(found: Sequence[Topic], option: str) -> str:
    told = f"{option} {found[0].name}, or another of these names"
    if option == "--topic" and len(found) > 1:
        told += f"; --rig {found[0].name} {found[1].name} where cameras are fixed to each other"
    return told
