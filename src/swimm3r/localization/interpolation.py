"""Pose and lens of a frame that is not registered, by the registered frames of its camera before and after it.

The cameras of a rig have lenses of their own and lie apart: frames of another one tell neither.
"""

from bisect import bisect_left

from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras
from swimm3r.geometry import pose_from, so3_exp, so3_log
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap.rig.lenses import stated_lens

_MAX_STEPS = 2.0  # a pose is carried on by at most this many steps of its neighbors
_NEAR = 3  # times of training frames away, at most; frames farther apart do not tell how the camera moved between


def between(before: Float[Tensor, "4 4"], after: Float[Tensor, "4 4"], share: float) -> Float[Tensor, "4 4"]:
    """The pose at `share` of the way from one to the other: evenly turned, evenly moved; carried on outside 0..1."""
    share = min(max(share, -_MAX_STEPS), 1 + _MAX_STEPS)
    turn = so3_exp(share * so3_log(before[:3, :3].mT @ after[:3, :3]))
    return pose_from(before[:3, :3] @ turn, before[:3, 3] + share * (after[:3, 3] - before[:3, 3]))


def neighbors(rec: Reconstruction, frames: Frames, name: str, count: int) -> list[str]:
    """The registered frames nearest to a frame in the order of the dive, nearest first; of a rig, of any camera."""
    return _nearest(rec, frames, name)[:count]


def lens_of(rec: Reconstruction, frames: Frames, name: str) -> Cameras | None:
    """The lens of a frame (one camera, its pose unused): that of the nearest registered frame of its camera.

    Where none of its camera is registered it is the calibrated one of the rig; None without.
    """
    own = _of_camera(rec, frames, name)
    if own:
        return rec.cameras[rec.index(own[0])]
    camera = frames.frames[frames.index(name)].camera
    cameras = () if frames.rig is None else frames.rig.cameras
    return next((stated_lens(each, frames) for each in cameras if each.name == camera), None)


def is_beside_registered(rec: Reconstruction, frames: Frames, name: str) -> bool:
    """Return whether the frames that `pose_from_neighbors` takes a pose from are among the next training frames.

    They are not where no frame of the camera is registered.
    """
    pair = _pair(rec, frames, name)
    time = {frame.name: frame.time for frame in frames}
    times = sorted({frame.time for frame in frames.train} | {time[name]})
    here = bisect_left(times, time[name])
    return pair is not None and all(abs(bisect_left(times, time[other]) - here) <= _NEAR for other in pair)


def pose_from_neighbors(rec: Reconstruction, frames: Frames, name: str) -> Float[Tensor, "4 4"]:
    """Between the registered frames of its camera before and after in time, or carried on from the two nearest at an
    end. Raises ValueError where no frame of its camera is registered.
    """
    time, pair = {frame.name: frame.time for frame in frames}, _pair(rec, frames, name)
    if pair is None:
        raise ValueError(f"no frame of the camera that took {name} is registered")
    first, second = pair
    poses = rec.cameras.cam2world[[rec.index(first), rec.index(second)]].double()
    span = time[second] - time[first]
    return between(poses[0], poses[1], (time[name] - time[first]) / span if span > 0 else 0.0)


def _nearest(rec: Reconstruction, frames: Frames, name: str) -> list[str]:
    """The other registered frames, the nearest in the order of the dive first."""
    place = {frame.name: i for i, frame in enumerate(frames)}
    known = [other for other in rec.names if other in place and other != name]
    return sorted(known, key=lambda other: abs(place[other] - place[name]))


def _of_camera(rec: Reconstruction, frames: Frames, name: str) -> list[str]:
    """Those of them that the frame's own camera took."""
    camera = {frame.name: frame.camera for frame in frames}
    return [other for other in _nearest(rec, frames, name) if camera[other] == camera[name]]


def _pair(rec: Reconstruction, frames: Frames, name: str) -> tuple[str, str] | None:
    """The registered frames of its camera before and after a frame in time, or the two nearest at an end.

    The earlier comes first; None where no frame of its camera is registered.
    """
    time = {frame.name: frame.time for frame in frames}
    near = _of_camera(rec, frames, name)
    if not near:
        return None
    earlier = [other for other in near if time[other] <= time[name]]
    later = [other for other in near if time[other] > time[name]]
    pair = (earlier[0], later[0]) if earlier and later else (near[0], near[min(1, len(near) - 1)])
    first, second = sorted(pair, key=lambda other: time[other])
    return first, second
