"""Pose of a frame interpolated between the frames before and after it."""

from bisect import bisect_left

from jaxtyping import Float
from torch import Tensor

from swimm3r.geometry import pose_from, so3_exp, so3_log
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction

_MAX_STEPS = 2.0  # a pose is carried on by at most this many steps of its neighbors
_NEAR = 3  # times of training frames away, at most; frames farther apart do not tell how the camera moved between


def between(before: Float[Tensor, "4 4"], after: Float[Tensor, "4 4"], share: float) -> Float[Tensor, "4 4"]:
    """The pose at `share` of the way from one to the other: evenly turned, evenly moved; carried on outside 0..1."""
    share = min(max(share, -_MAX_STEPS), 1 + _MAX_STEPS)
    turn = so3_exp(share * so3_log(before[:3, :3].mT @ after[:3, :3]))
    return pose_from(before[:3, :3] @ turn, before[:3, 3] + share * (after[:3, 3] - before[:3, 3]))


def neighbors(rec: Reconstruction, frames: Frames, name: str, count: int) -> list[str]:
    """The registered frames nearest to a frame in the order of the dive, nearest first."""
    place = {frame.name: i for i, frame in enumerate(frames)}
    known = [other for other in rec.names if other in place and other != name]
    return sorted(known, key=lambda other: abs(place[other] - place[name]))[:count]


def is_beside_registered(rec: Reconstruction, frames: Frames, name: str) -> bool:
    """Return whether the frames that `pose_from_neighbors` takes a pose from are among the next training frames."""
    time = {frame.name: frame.time for frame in frames}
    times = sorted({frame.time for frame in frames.train} | {time[name]})
    here = bisect_left(times, time[name])
    return all(abs(bisect_left(times, time[other]) - here) <= _NEAR for other in _pair(rec, frames, name))


def pose_from_neighbors(rec: Reconstruction, frames: Frames, name: str) -> Float[Tensor, "4 4"]:
    """Between the registered frames before and after in time, or carried on from the two nearest at an end."""
    time = {frame.name: frame.time for frame in frames}
    first, second = _pair(rec, frames, name)
    poses = rec.cameras.cam2world[[rec.index(first), rec.index(second)]].double()
    span = time[second] - time[first]
    return between(poses[0], poses[1], (time[name] - time[first]) / span if span > 0 else 0.0)


def _pair(rec: Reconstruction, frames: Frames, name: str) -> tuple[str, str]:
    """The registered frames before and after a frame in time, or the two nearest at an end, the earlier first."""
    time = {frame.name: frame.time for frame in frames}
    near = neighbors(rec, frames, name, len(rec.names))
    earlier = [other for other in near if time[other] <= time[name]]
    later = [other for other in near if time[other] > time[name]]
    pair = (earlier[0], later[0]) if earlier and later else (near[0], near[min(1, len(near) - 1)])
    first, second = sorted(pair, key=lambda other: time[other])
    return first, second
