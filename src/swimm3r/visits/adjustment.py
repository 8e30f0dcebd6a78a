"""Joint adjustment of a visit with an earlier one: both observe the points that they share on stable ground.

One similarity leaves the bends that each visit has of its own, and a bend looks like a change of the ground. Cameras of
the earlier visit are held; poses and points of the later one move until shared points, too, reproject best, under the
soft L1 norm. Points whose error is several times the median one lie on changed ground, stones on a bank that has risen
for example, and would pull it back: they are left out, twice, as errors shrink with the bends. A share of the others is
left out as well: the distances between their places by either visit alone are the worth of the alignment (check points,
as surveyors call them).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float

from swimm3r.cameras import project
from swimm3r.geometry import Similarity
from swimm3r.io.colmap.cameras import to_pycolmap_camera
from swimm3r.io.colmap.model import silence_log
from swimm3r.scene.reconstruction import DepthMap, DepthMaps, Reconstruction
from swimm3r.sfm.colmap.chunks.links import Sim3
from swimm3r.visits.alignment import Alignment, Pairs
from swimm3r.visits.matches import VisitMatches

if TYPE_CHECKING:
    import pycolmap

IDENTITY = Sim3(1.0, np.eye(3), np.zeros(3))
_CHECK_EVERY = 5  # shared points of which one is a check point
_ROUNDS = 4
_STABLE = 4.0  # median reprojection errors within which a shared point lies on stable ground
_LEAST_ERROR = 0.5  # pixels
_LEAST_OBSERVED = 8  # points of a frame that tell how its depth has changed
_FIRST = 1_000_000  # COLMAP's ids of the later visit's images and points begin here


@dataclass(frozen=True)
class CheckPoints:
    """Shared points that took no part in the adjustment, placed by either visit alone, in the frame of the first."""

    xyz_a: Float[np.ndarray, "n 3"]
    xyz_b: Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class ScaledDepthMaps(DepthMaps):
    """Depth maps of a visit in the unit of another one; each frame has a factor."""

    factors: dict[str, float]

    def __getitem__(self, name: str) -> DepthMap:
        stored = super().__getitem__(name)
        return DepthMap(stored.z_depth * self.factors.get(name, 1.0), stored.confidence)


@dataclass(frozen=True)
class Placed:
    """A visit in the frame of the first."""

    rec: Reconstruction
    check: CheckPoints


def place(a: Reconstruction, b: Reconstruction, matches: VisitMatches, alignment: Alignment) -> Placed:
    """Visit b in the axes and unit of visit a, adjusted to the points that both have."""
    moved = _moved(b, alignment.a_from_b)
    shared = matches.select(alignment.verified)
    if not len(shared):
        factors = dict.fromkeys(b.names, float(alignment.a_from_b.scale))
        nothing = np.zeros((0, 3))
        return Placed(replace(moved, depth=ScaledDepthMaps(b.depth.folder, factors)), CheckPoints(nothing, nothing))
    check = np.unique(shared.point_b, return_inverse=True)[1].reshape(-1) % _CHECK_EVERY == 0
    adjusted, stable = moved, alignment.inlier[alignment.verified]
    for _ in range(_ROUNDS):
        errors = Pairs(a, adjusted, shared).errors(IDENTITY)
        stable = errors <= max(_LEAST_ERROR, _STABLE * float(np.median(errors[stable])))
        adjusted = _adjusted(a, moved, shared.select(stable & ~check))
    factors = _depth_factors(moved, adjusted, b, alignment.a_from_b.scale)
    placed = replace(adjusted, depth=ScaledDepthMaps(b.depth.folder, factors))
    held = shared.select(check & stable)
    points = a.points.xyz.double().numpy()[held.point_a], placed.points.xyz.double().numpy()[held.point_b]
    return Placed(placed, CheckPoints(*points))


def similarity(found: Sim3) -> Similarity:
    """The similarity as poses take it."""
    scale, R, t = (torch.as_tensor(value).double() for value in (found.scale, found.R, found.t))
    return Similarity(scale, R, t)


def _moved(b: Reconstruction, a_from_b: Sim3) -> Reconstruction:
    onto = similarity(a_from_b)
    cameras = replace(b.cameras, cam2world=onto.poses(b.cameras.cam2world.double()))
    return replace(b, cameras=cameras, points=replace(b.points, xyz=onto.points(b.points.xyz.double())))


def _adjusted(a: Reconstruction, b: Reconstruction, shared: VisitMatches) -> Reconstruction:
    """Visit b with the poses and points that fit its own tracks and the shared points best; visit a is held."""
    import pycolmap

    silence_log()
    model, config = pycolmap.Reconstruction(), pycolmap.BundleAdjustmentConfig()
    extra, own = _observations_of_a(a, shared), _tracks_by_frame(b)
    _add_frames(model, a, 1, {frame: [xy for _, xy in rows] for frame, rows in extra.items()})
    _add_frames(model, b, _FIRST, {frame: xy for frame, (_, xy) in own.items()})
    adjusted = _add_points(model, b, own, extra)
    for image in (*(1 + frame for frame in extra), *(_FIRST + frame for frame in own)):
        config.add_image(image)
    for frame in extra:
        config.set_constant_rig_from_world_pose(model.images[1 + frame].frame_id)
    for camera in list(model.cameras):
        config.set_constant_cam_intrinsics(camera)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = 1  # the same sums in the same order
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    poses, xyz = b.cameras.cam2world.double().clone(), b.points.xyz.double().numpy().copy()
    for frame in own:
        poses[frame, :3] = torch.from_numpy(model.images[_FIRST + frame].cam_from_world().inverse().matrix())
    for point in adjusted:
        xyz[point] = model.points3D[_FIRST + point].xyz
    cameras = replace(b.cameras, cam2world=poses)
    return replace(b, cameras=cameras, points=replace(b.points, xyz=torch.from_numpy(xyz)))


def _add_points(
    model: "pycolmap.Reconstruction",
    b: Reconstruction,
    own: dict[int, tuple[np.ndarray, Float[np.ndarray, "n 2"]]],
    extra: dict[int, list[tuple[int, np.ndarray]]],
) -> list[int]:
    """Add the points of b with their observations by both visits; those that one frame alone observes are left out."""
    import pycolmap

    elements: dict[int, list[tuple[int, int]]] = {}
    for frame, (points, _) in own.items():
        for k, point in enumerate(points.tolist()):
            elements.setdefault(point, []).append((_FIRST + frame, k))
    for frame, rows in extra.items():
        for k, (point, _) in enumerate(rows):
            elements.setdefault(point, []).append((1 + frame, k))
    xyz = b.points.xyz.double().numpy()
    added = [point for point, seen in elements.items() if len(seen) > 1]
    for point in added:
        track = pycolmap.Track()
        for image, k in elements[point]:
            track.add_element(image, k)
        made = pycolmap.Point3D()
        made.xyz, made.track = xyz[point], track
        model.add_point3D_with_id(_FIRST + point, made)
    return added


def _observations_of_a(a: Reconstruction, shared: VisitMatches) -> dict[int, list[tuple[int, np.ndarray]]]:
    """Points of b, and where frames of a observe them, by frame of a."""
    point_b = dict(zip(shared.point_a.tolist(), shared.point_b.tolist(), strict=True))
    found: dict[int, list[tuple[int, np.ndarray]]] = {}
    seen: set[tuple[int, int]] = set()
    rows = np.flatnonzero(np.isin(a.tracks.point.numpy(), shared.point_a))
    for row in rows.tolist():
        frame, point = int(a.tracks.frame[row]), point_b[int(a.tracks.point[row])]
        if (frame, point) not in seen:  # two points of a may be one of b
            seen.add((frame, point))
            found.setdefault(frame, []).append((point, a.tracks.xy[row].double().numpy()))
    return found


def _tracks_by_frame(b: Reconstruction) -> dict[int, tuple[np.ndarray, Float[np.ndarray, "n 2"]]]:
    """Points that each frame observes, and the pixels."""
    frame, point, xy = b.tracks.frame.numpy(), b.tracks.point.numpy(), b.tracks.xy.double().numpy()
    return {i: (point[frame == i], xy[frame == i]) for i in np.unique(frame).tolist()}


def _add_frames(
    model: "pycolmap.Reconstruction", rec: Reconstruction, first: int, xy: Mapping[int, list | np.ndarray]
) -> None:
    """Add the frames of a visit with their observations; ids begin at `first`."""
    import pycolmap

    for frame, pixels in xy.items():
        number = first + frame
        camera = to_pycolmap_camera(rec.cameras, frame)
        camera.camera_id = number
        model.add_camera_with_trivial_rig(camera)
        keypoints = np.asarray(pixels, np.float64).reshape(-1, 2)
        image = pycolmap.Image(name=f"{number}", keypoints=keypoints, camera_id=number, image_id=number)
        world2cam = np.linalg.inv(rec.cameras.cam2world[frame].double().numpy())
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(world2cam[:3, :3]), world2cam[:3, 3])
        model.add_image_with_trivial_frame(image, pose)


def _depth_factors(
    moved: Reconstruction, adjusted: Reconstruction, stored: Reconstruction, scale: float
) -> dict[str, float]:
    """Depth in the adjusted frame per depth of the file, for every frame: the median over the points it observes."""
    frame, point = stored.tracks.frame, stored.tracks.point
    factors = {}
    for i, name in enumerate(stored.names):
        mine = point[frame == i]
        if len(mine) < _LEAST_OBSERVED:
            factors[name] = scale
            continue
        before, after = (project(r.cameras[i], r.points.xyz[mine].double()[None])[1][0] for r in (moved, adjusted))
        good = _in_front(before) & _in_front(after)
        change = float((after[good] / before[good]).median()) if bool(good.any()) else 1.0
        factors[name] = scale * change
    return factors


def _in_front(z: torch.Tensor) -> Bool[torch.Tensor, " n"]:
    return z > 0
