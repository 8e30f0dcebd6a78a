"""Images of several cameras by instants: those of equal names, of one time, or of the same place in their lists."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from swimm3r.errors import InputError
from swimm3r.scene.settings import FrameSettings

Instant = dict[str, int]  # of each camera that has an image, its position in the camera's list

_SAME_NAMES = 0.5  # share of the instants with all cameras, from which equal names are no chance
_NAMED = 3  # images without partner that a message names


@dataclass(frozen=True)
class CameraImages:
    """The images of one camera."""

    name: str
    labels: Sequence[str]  # by which messages name them
    times: Sequence[float] | None  # seconds on a clock of all cameras; None where one image has none
    keys: Sequence[str] | None = None  # that images of one instant share; None where images have no names

    def __len__(self) -> int:
        return len(self.labels)


def instants_of(cameras: Sequence[CameraImages], settings: FrameSettings) -> list[Instant]:
    """The images of each instant by their camera, in no order. Raises InputError where they cannot be paired."""
    named = [camera.keys for camera in cameras if camera.keys is not None]
    unique = len(named) == len(cameras) and all(len(set(keys)) == len(keys) for keys in named)
    shared = len(set.intersection(*map(set, named))) / max(map(len, cameras)) if unique else 0.0
    clocked = all(camera.times is not None for camera in cameras)
    how = settings.rig_pairs
    if how == "auto":
        how = "name" if shared >= _SAME_NAMES or not clocked else "time"
    if how == "time" and clocked:
        return _by_time(cameras, settings.rig_tolerance)
    if how == "order" and len(set(map(len, cameras))) == 1:
        return [{camera.name: i for camera in cameras} for i in range(len(cameras[0]))]
    if how != "name" or not shared:
        raise InputError(
            f"the images of the rig cannot be paired by {how}: {_counts(cameras)}",
            cause={
                "time": "an image carries no time, neither in its name nor in EXIF",
                "order": "the cameras have different numbers of images",
                "name": "no names agree, and the images carry no times",
            }[how],
            hint="the same name for images of one instant (left/0001.png, right/0001.png); or --rig-pairs order where"
            " the first image of each camera is of the first instant, and so on",
        )
    found: dict[str, Instant] = {}
    for camera, keys in zip(cameras, named, strict=True):
        for i, key in enumerate(keys):
            found.setdefault(key, {})[camera.name] = i
    return list(found.values())


def missing(instants: Sequence[Instant], cameras: Sequence[CameraImages], settings: FrameSettings) -> str | None:
    """A sentence about instants that lack a camera; None where all are whole. Raises InputError for too many."""
    of_name = {camera.name: camera for camera in cameras}
    partial = [instant for instant in instants if len(instant) < len(cameras)]
    if not partial:
        return None
    alone = [of_name[name].labels[i] for instant in partial for name, i in instant.items()]
    told = (
        f"{len(partial)} of {len(instants)} instants lack the image of a camera"
        f" ({', '.join(alone[:_NAMED])}{' ...' * (len(alone) > _NAMED)}); there are {_counts(cameras)}"
    )
    if len(partial) <= settings.rig_missing * len(instants):
        return f"{told}."
    apart = _apart(cameras)
    raise InputError(
        told + ("" if apart is None else f", {apart:.3g} s apart in the median"),
        cause="the cameras were not triggered together, or images of one of them were lost or left out",
        hint=f"--rig-tolerance (now {settings.rig_tolerance:g} s) where the times differ by little, --rig-missing (now"
        f" {settings.rig_missing:g}) to go on without the partners, or --rig none: one camera after the other",
    )


def _by_time(cameras: Sequence[CameraImages], tolerance: float) -> list[Instant]:
    """Images that are each other's nearest in time, within the tolerance; the others are instants of their own."""
    first, *others = cameras
    times = _times(first)
    instants: list[Instant] = [{first.name: i} for i in range(len(times))]
    for camera in others:
        own = _times(camera)
        nearest, back = _nearest(own, times), _nearest(times, own)
        for i, at in enumerate(nearest.tolist()):
            if abs(own[i] - times[at]) <= tolerance and back[at] == i:
                instants[at][camera.name] = i
            else:
                instants.append({camera.name: i})
    return instants


def _nearest(of: Float[np.ndarray, " n"], among: Float[np.ndarray, " m"]) -> Int[np.ndarray, " n"]:
    """Positions of the times that are nearest to some, the earlier of two that are as near."""
    order = np.argsort(among, kind="stable")
    later = np.minimum(np.searchsorted(among[order], of), len(among) - 1)
    earlier = np.maximum(later - 1, 0)
    is_earlier = np.abs(of - among[order[earlier]]) <= np.abs(of - among[order[later]])
    return order[np.where(is_earlier, earlier, later)]


def _apart(cameras: Sequence[CameraImages]) -> float | None:
    """Median difference of the images' times from the nearest of the first camera; None without times."""
    if any(camera.times is None for camera in cameras):
        return None
    first, *others = map(_times, cameras)
    return float(np.median(np.concatenate([np.abs(own - first[_nearest(own, first)]) for own in others])))


def _times(camera: CameraImages) -> Float[np.ndarray, " n"]:
    return np.array(camera.times, np.float64)


def _counts(cameras: Sequence[CameraImages]) -> str:
    return ", ".join(f"{len(camera)} images of {camera.name}" for camera in cameras)
