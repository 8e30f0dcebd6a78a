"""Paths of the camera: a loop over the terrace that comes back to where it began, or a survey of the plain."""

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from swimm3r.errors import UsageError
from swimm3r.synthetic.plain import REACH
from swimm3r.synthetic.seafloor import Seafloor, height_at
from swimm3r.synthetic.settings import DiveSettings

CLEARANCE = 0.65  # m above what is below, after smoothing


def loop(floor: Seafloor, frames: int, stream: list[int], later: float = 0.0, moment: float = 0.0) -> np.ndarray:
    """cam2world [frames, 4, 4] (OpenCV axes) along the loop; `stream` seeds what differs from visit to visit.

    `later` is the share of an interval between frames by which all of them are taken later; the path has 512 places,
    the nearest of which is taken, and `moment` is a share from there on, between places.
    """
    rng = np.random.default_rng(stream)
    phase = rng.uniform(-0.3, 0.3, 6)
    fine = np.arange(512) / 512
    turn = 2 * np.pi * fine
    x = 1.35 * np.sin(turn + phase[0]) + 0.15 * np.sin(3 * turn + phase[1])
    y = 0.25 - 0.75 * np.cos(turn) + 0.18 * np.sin(2 * turn + phase[2])
    ring = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    around = [height_at(floor, x + r * np.cos(a), y + r * np.sin(a)) for r in (0.0, 0.25, 0.5) for a in ring]
    below = ndimage.gaussian_filter1d(np.max(around, axis=0), 40, mode="wrap")
    z = below + CLEARANCE + 0.16 * np.sin(2 * turn + phase[3]) + 0.1
    at = ((np.arange(frames) + later) * len(fine) // max(frames, 1)).astype(int) + moment * len(fine) / max(frames, 1)
    yaw = 0.30 * np.sin(turn + np.pi + phase[4]) + 0.10 * np.sin(2 * turn + phase[5])
    pitch = np.radians(20) + np.radians(4) * np.sin(2 * turn + phase[1])
    roll = np.radians(5) * np.sin(turn + phase[2]) + np.radians(2.5) * np.sin(3 * turn + phase[0])
    x, y, z, yaw, pitch, roll = (
        np.interp(at, np.arange(len(fine)), v, period=len(fine)) for v in (x, y, z, yaw, pitch, roll)
    )
    return _poses(np.stack([x, y, z], 1), yaw, pitch, roll)


PITCH = np.radians(65)  # below the horizon, of a survey's camera
_SIDELAP = 0.5  # of two neighboring lines of a lawnmower path
_SWAY = (0.08, 0.08, np.radians(5), np.radians(3), np.radians(4))  # aside and up in meters; yaw, pitch, roll
_PERIODS = (3.1, 4.7, 7.3, 11.9)  # s
_ASTRAY = (0.15, np.radians(6))  # of a later visit's start in meters, and of its heading
_HOLLOWS = 0.3  # m below the sand's mean that the ground may lie


def survey(settings: DiveSettings, later: float = 0.0) -> np.ndarray:
    """cam2world [frames, 4, 4] (OpenCV axes) of a transect or of parallel lines, with the sway of a vehicle.

    `later` is the seconds by which all frames are taken later. Raises UsageError where the camera would see further
    than the plain's patches reach.
    """
    fine = _line(settings.length) if settings.path == "transect" else _lines(settings)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
    seconds = np.arange(settings.frame_count) / settings.fps + later
    at = seconds * settings.speed
    x, y = (np.interp(at, along, fine[:, k]) for k in range(2))
    fine = _as_of_visit(fine, settings)
    smooth = ndimage.gaussian_filter1d(np.gradient(fine, axis=0), 20, axis=0, mode="nearest")
    heading = np.interp(at, along, np.unwrap(np.arctan2(smooth[:, 0], smooth[:, 1])))
    aside, up, yaw, pitch, roll = _sway(seconds, np.random.default_rng(settings.stream(5)))
    x, y = x + aside * np.cos(heading), y - aside * np.sin(heading)
    poses = _poses(np.stack([x, y, settings.altitude + up], 1), heading + yaw, PITCH + pitch, roll)
    _check_reach(poses, settings)
    return poses


def motion_between(before: np.ndarray, after: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Motion [n, 6] of cameras from poses [n, 4, 4] to others: rotation vectors and translations in a middle's axes."""
    ends = [np.linalg.inv(middle) @ poses for poses in (before, after)]
    turns = [Rotation.from_matrix(poses[:, :3, :3]).as_rotvec() for poses in ends]
    return np.concatenate([turns[1] - turns[0], ends[1][:, :3, 3] - ends[0][:, :3, 3]], 1)


_TOE = np.radians([0.4, -0.9, 0.3])  # turns of the right camera about its x, y and z axes: no two are quite parallel


def right_of(poses: np.ndarray, baseline: float) -> np.ndarray:
    """cam2world [n, 4, 4] of a second camera `baseline` meters to the right of the first ones, toed in by a degree."""
    mounted = np.eye(4)
    mounted[:3, :3] = Rotation.from_rotvec(_TOE).as_matrix()
    mounted[0, 3] = baseline
    return poses @ mounted


def _as_of_visit(fine: np.ndarray, settings: DiveSettings) -> np.ndarray:
    """The path of a later visit: nobody finds the first one's start and heading again exactly."""
    if settings.visit == 0:
        return fine
    rng = np.random.default_rng(settings.stream(10))
    (east, north), turn = rng.uniform(-_ASTRAY[0], _ASTRAY[0], 2), rng.uniform(-_ASTRAY[1], _ASTRAY[1])
    middle, R = (fine.min(0) + fine.max(0)) / 2, np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return middle + (fine - middle) @ R.T + np.array([east, north])


def _line(length: float) -> np.ndarray:
    """A straight line ahead, a node every centimeter."""
    y = np.linspace(0, length, max(int(100 * length), 2) + 1)
    return np.stack([np.zeros_like(y), y], 1)


def _lines(settings: DiveSettings) -> np.ndarray:
    """Parallel lines with turns between them, and a last line across all of them; a node every centimeter."""
    swath = 2 * settings.altitude / np.sin(PITCH) * np.tan(np.radians(settings.fov) / 2)
    spacing = (1 - _SIDELAP) * swath
    count = max(2, round(np.sqrt(0.8 * settings.length / spacing)))
    shortest, longest = 0.0, settings.length
    for _ in range(50):
        each = (shortest + longest) / 2
        length = _length(_mown(count, each, spacing))
        shortest, longest = (each, longest) if length < settings.length else (shortest, each)
    return _mown(count, longest, spacing)


def _mown(count: int, each: float, spacing: float) -> np.ndarray:
    """`count` lines of length `each` with half circles after them, and a line across them back to the first."""
    half = np.linspace(0, np.pi, 33)[1:-1]
    corners: list[np.ndarray] = []
    for k in range(count):
        ends = np.array([[k * spacing, 0.0], [k * spacing, each]])
        corners.append(ends if k % 2 == 0 else ends[::-1])
        inward = 1 if k < count - 1 else -1  # after the last line, back over the others
        turn = np.stack([inward * (1 - np.cos(half)), (1 if k % 2 == 0 else -1) * np.sin(half)], 1)
        corners.append(corners[-1][1] + turn * spacing / 2)
    corners.append(np.array([[0.0, 0.0 if count % 2 else each]]))
    nodes = np.concatenate(corners)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(nodes, axis=0), axis=1))])
    at = np.linspace(0, along[-1], int(100 * along[-1]) + 2)
    dense = np.stack([np.interp(at, along, nodes[:, k]) for k in range(2)], 1)
    return ndimage.gaussian_filter1d(dense, 15, axis=0, mode="nearest")


def _length(nodes: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(nodes, axis=0), axis=1).sum())


def _sway(seconds: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Aside, up, yaw, pitch and roll of a vehicle in a swell: waves of a few periods, each within its bound."""
    found = []
    for bound in _SWAY:
        shares = rng.dirichlet(np.ones(len(_PERIODS)))
        phases = rng.uniform(0, 2 * np.pi, len(_PERIODS))
        waves = [w * np.sin(2 * np.pi * seconds / T + p) for w, T, p in zip(shares, _PERIODS, phases, strict=True)]
        found.append(bound * np.sum(waves, axis=0))
    return found


def _check_reach(poses: np.ndarray, settings: DiveSettings) -> None:
    """Raise UsageError where a corner of an image may see past the reach of a patch."""
    tangent = np.tan(np.radians(settings.fov) / 2)
    upright = tangent * settings.height / settings.width / settings.squeeze
    corners = np.array([[i * tangent, j * upright, 1.0] for i in (-1, 1) for j in (-1, 1)])
    rays = corners @ poses[:, :3, :3].transpose(0, 2, 1)
    drop = poses[:, 2, 3] + _HOLLOWS
    with np.errstate(divide="ignore"):
        seen = np.linalg.norm(rays[..., :2], axis=-1) * np.where(
            rays[..., 2] < 0, drop[:, None] / -rays[..., 2], np.inf
        )
    if seen.max() > REACH:
        raise UsageError(
            f"a survey's camera would see {seen.max():.1f} m far, where the synthetic plain shows {REACH:.1f} m",
            cause=f"a field of view of {settings.fov:g} degrees at {settings.width}x{settings.height} from"
            f" {settings.altitude:g} m",
            hint="a narrower field of view, a wider image, or a lower altitude",
        )


def _poses(position: np.ndarray, yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """cam2world [n, 4, 4] of cameras that look `pitch` below the horizon; yaw is clockwise from ahead."""
    poses = np.tile(np.eye(4), (len(position), 1, 1))
    for k, pose in enumerate(poses):
        forward = np.array([np.sin(yaw[k]) * np.cos(pitch[k]), np.cos(yaw[k]) * np.cos(pitch[k]), -np.sin(pitch[k])])
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        c, s = np.cos(roll[k]), np.sin(roll[k])
        pose[:3, :3] = np.stack([c * right + s * down, c * down - s * right, forward], 1)
        pose[:3, 3] = position[k]
    return poses
