"""Bundle adjustment of several reconstructions in one frame, some points of which are the same place.

A *site* is a place that is observed: a point of one reconstruction, or points of several. Lenses are held: each visit
has its own, and depth maps were made with it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, Int

from swimm3r.cameras import Cameras
from swimm3r.io.colmap.cameras import to_pycolmap_camera
from swimm3r.io.colmap.model import silence_log
from swimm3r.scene.reconstruction import Reconstruction

if TYPE_CHECKING:
    import pycolmap

Sites = tuple[Int[np.ndarray, " _"], ...]
"""For each reconstruction, the number of the site of each of its points, from 0."""


def adjusted(recs: Sequence[Reconstruction], sites: Sites) -> tuple[Reconstruction, ...]:
    """The reconstructions with the poses and points that reproject best, points of one site at one place.

    The frame is open: it comes out near the former one.
    """
    import pycolmap

    seen = _observations(recs, sites)
    model, config = _model(recs, sites, seen), pycolmap.BundleAdjustmentConfig()
    for image in np.unique(seen.image).tolist():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    _solve(model, config)
    return _read_back(model, recs, sites)


def with_own_points(recs: Sequence[Reconstruction]) -> tuple[Reconstruction, ...]:
    """The reconstructions with each point where the frames of its own visit see it; poses are held."""
    import pycolmap

    starts = np.cumsum([0, *(len(rec.points.xyz) for rec in recs)])
    sites = tuple(np.arange(first, last) for first, last in pairwise(starts.tolist()))
    seen = _observations(recs, sites)
    model, config = _model(recs, sites, seen), pycolmap.BundleAdjustmentConfig()
    for image in np.unique(seen.image).tolist():
        config.add_image(image)
        config.set_constant_rig_from_world_pose(model.images[image].frame_id)
    _solve(model, config)
    return _read_back(model, recs, sites)


@dataclass(frozen=True)
class _Observations:
    """One row for every site that an image observes; sites that one image alone observes are left out."""

    image: Int[np.ndarray, " o"]  # COLMAP's ids, from 1, those of the first reconstruction first
    site: Int[np.ndarray, " o"]
    xy: Float[np.ndarray, "o 2"]  # pixels


def _observations(recs: Sequence[Reconstruction], sites: Sites) -> _Observations:
    firsts = _first_images(recs)
    image = np.concatenate([first + rec.tracks.frame.numpy() for first, rec in zip(firsts, recs, strict=True)])
    site = np.concatenate([of[rec.tracks.point.numpy()] for of, rec in zip(sites, recs, strict=True)])
    xy = np.concatenate([rec.tracks.xy.double().numpy() for rec in recs])
    once = np.unique(np.column_stack([image, site]), axis=0, return_index=True)[1]  # two points may be one site
    image, site, xy = image[once], site[once], xy[once]
    often = np.bincount(site)[site] > 1
    return _Observations(image[often], site[often], xy[often])


def _first_images(recs: Sequence[Reconstruction]) -> list[int]:
    """The id of each reconstruction's first image."""
    return (1 + np.cumsum([0, *(len(rec.names) for rec in recs[:-1])])).tolist()


def _model(recs: Sequence[Reconstruction], sites: Sites, seen: _Observations) -> "pycolmap.Reconstruction":
    import pycolmap

    silence_log()
    model, cameras = pycolmap.Reconstruction(), 0
    order = np.argsort(seen.image, kind="stable")  # `point2D_idx` of a row: its place among those of the image
    starts = np.searchsorted(seen.image[order], np.arange(1, sum(len(rec.names) for rec in recs) + 2))
    within = np.empty(len(order), np.int64)
    within[order] = np.arange(len(order)) - starts[seen.image[order] - 1]
    for first, rec in zip(_first_images(recs), recs, strict=True):
        lens = _lenses(rec.cameras)
        for k in np.unique(lens).tolist():
            camera = to_pycolmap_camera(rec.cameras, int(np.flatnonzero(lens == k)[0]))
            camera.camera_id = cameras + k + 1
            model.add_camera_with_trivial_rig(camera)
        for frame in range(len(rec.names)):
            number = first + frame
            keypoints = seen.xy[order[starts[number - 1] : starts[number]]]
            image = pycolmap.Image(
                name=f"{number}", keypoints=keypoints, camera_id=cameras + int(lens[frame]) + 1, image_id=number
            )
            model.add_image_with_trivial_frame(image, _world2cam(rec.cameras, frame))
        cameras += int(lens.max()) + 1
    _add_points(model, recs, sites, (seen, within))
    return model


def _lenses(cameras: Cameras) -> Int[np.ndarray, " c"]:
    """The number of each camera's lens; cameras with the same intrinsics have one."""
    table = np.column_stack([cameras.K.double().numpy().reshape(len(cameras), -1), cameras.distortion.double().numpy()])
    return np.unique(table, axis=0, return_inverse=True)[1].reshape(-1)


def _world2cam(cameras: Cameras, frame: int) -> "pycolmap.Rigid3d":
    import pycolmap

    world2cam = np.linalg.inv(cameras.cam2world[frame].double().numpy())
    return pycolmap.Rigid3d(pycolmap.Rotation3d(world2cam[:3, :3]), world2cam[:3, 3])


def _add_points(
    model: "pycolmap.Reconstruction",
    recs: Sequence[Reconstruction],
    sites: Sites,
    rows: tuple[_Observations, Int[np.ndarray, " o"]],
) -> None:
    """Add the observed sites where their first visit has them; `rows`: observations and their place in the image."""
    import pycolmap

    seen, within = rows
    xyz = np.concatenate([rec.points.xyz.double().numpy() for rec in recs])
    known, first = np.unique(np.concatenate(sites), return_index=True)
    at = dict(zip(known.tolist(), first.tolist(), strict=True))
    order = np.argsort(seen.site, kind="stable")
    observed, starts = np.unique(seen.site[order], return_index=True)
    for site, mine in zip(observed.tolist(), np.split(order, starts[1:]), strict=True):
        track = pycolmap.Track()
        for image, k in zip(seen.image[mine].tolist(), within[mine].tolist(), strict=True):
            track.add_element(image, k)
        point = pycolmap.Point3D()
        point.xyz, point.track = xyz[at[site]], track
        model.add_point3D_with_id(site + 1, point)


def _solve(model: "pycolmap.Reconstruction", config: "pycolmap.BundleAdjustmentConfig") -> None:
    import pycolmap

    for camera in list(model.cameras):
        config.set_constant_cam_intrinsics(camera)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = 1  # the same sums in the same order
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _read_back(
    model: "pycolmap.Reconstruction", recs: Sequence[Reconstruction], sites: Sites
) -> tuple[Reconstruction, ...]:
    """The reconstructions with the poses and points of the model; what it does not have stays."""
    found = []
    for first, rec, of in zip(_first_images(recs), recs, sites, strict=True):
        poses, xyz = rec.cameras.cam2world.double().clone(), rec.points.xyz.double().numpy().copy()
        for frame in range(len(rec.names)):
            poses[frame, :3] = torch.from_numpy(model.images[first + frame].cam_from_world().inverse().matrix())
        for point in np.flatnonzero([model.exists_point3D(site + 1) for site in of.tolist()]).tolist():
            xyz[point] = model.points3D[int(of[point]) + 1].xyz
        cameras = replace(rec.cameras, cam2world=poses)
        found.append(replace(rec, cameras=cameras, points=replace(rec.points, xyz=torch.from_numpy(xyz))))
    return tuple(found)
