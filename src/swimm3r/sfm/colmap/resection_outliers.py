"""Frames that stand in the wrong place although most of their matches fit: found by asking all the others.

A flat bottom seen by two frames allows two motions between them. A mapper that begins with the wrong one corrects the
scene as more frames join, but not always the frame it began with: bundle adjustment never leaves that pose's basin.
"""

from typing import TYPE_CHECKING

import numpy as np

from swimm3r.sfm.features.database import FeatureDatabase

if TYPE_CHECKING:
    import pycolmap

_MAX_ERROR = 4.0  # pixels, as in mapping
_ELSEWHERE = 2.0  # degrees; resection of a frame that stands right finds its pose again within tenths
_SEED = 0


def misplaced_frames(store: FeatureDatabase, model: "pycolmap.Reconstruction") -> list[int]:
    """Image ids of frames for which a quite different pose explains as many of their matches, or more; at most half.

    Each frame is resected (PnP with RANSAC) from the points that at least two other frames see. As those points bend
    toward where the frame stands, a tie already speaks against it; placing it again must then show which is better.
    """
    import pycolmap

    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = _MAX_ERROR
    options.ransac.random_seed = _SEED
    gains: dict[int, float] = {}
    observations = _matched_points(store, model)
    for image_id, (feature, xy, xyz) in observations.items():
        image = model.images[image_id]
        standing = _explained(image.cam_from_world(), model.cameras[1], feature, xy, xyz)
        found = pycolmap.estimate_and_refine_absolute_pose(xy, xyz, model.cameras[1], estimation_options=options)
        if found is None:
            continue
        possible = _explained(found["cam_from_world"], model.cameras[1], feature, xy, xyz)
        turn = found["cam_from_world"].rotation * image.cam_from_world().rotation.inverse()
        if possible >= standing and np.degrees(turn.angle()) > _ELSEWHERE:
            gains[image_id] = possible / max(standing, 1)
    worst_first = sorted(gains, key=lambda image_id: gains[image_id], reverse=True)
    return worst_first[: len(observations) // 2]


def _explained(
    cam_from_world: "pycolmap.Rigid3d", camera: "pycolmap.Camera", feature: np.ndarray, xy: np.ndarray, xyz: np.ndarray
) -> int:
    """Features with at least one point that projects onto them."""
    local = xyz @ cam_from_world.rotation.matrix().T + cam_from_world.translation
    front = local[:, 2] > 0
    error = np.full(len(xy), np.inf)
    error[front] = np.linalg.norm(camera.img_from_cam(local[front]) - xy[front], axis=1)
    return len(np.unique(feature[error < _MAX_ERROR]))


def _matched_points(
    store: FeatureDatabase, model: "pycolmap.Reconstruction"
) -> dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Per registered image: features, their pixels, and the points that their verified matches belong to.

    Only points that two frames other than the image itself see: those do not depend on where it stands.
    """
    import pycolmap

    point_of = {i: _point_ids(model.images[i]) for i in model.reg_image_ids()}
    rows: dict[int, list[np.ndarray]] = {i: [] for i in point_of}
    with store.open() as database:
        pixels = {i: database.read_keypoints(i)[:, :2].astype(np.float64) for i in point_of}
        for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
            a, b = pycolmap.pair_id_to_image_pair(pair)
            if a not in point_of or b not in point_of:
                continue
            matches = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
            for here, there, columns in ((a, b, matches), (b, a, matches[:, ::-1])):
                points = point_of[there][columns[:, 1]]
                rows[here].append(np.stack((columns[:, 0], points), axis=1)[points >= 0])
    seen_in = {p: {element.image_id for element in point.track.elements} for p, point in model.points3D.items()}
    xyz = {p: point.xyz for p, point in model.points3D.items()}
    out = {}
    for i, found in rows.items():
        pairs = np.unique(np.concatenate([np.empty((0, 2), np.int64), *found]), axis=0)
        pairs = pairs[[len(seen_in[p]) - (i in seen_in[p]) >= 2 for p in pairs[:, 1].tolist()]]
        if len(pairs) >= 4:
            out[i] = pairs[:, 0], pixels[i][pairs[:, 0]], np.stack([xyz[p] for p in pairs[:, 1].tolist()])
    return out


def _point_ids(image: "pycolmap.Image") -> np.ndarray:
    """The point of every feature of an image, -1 where it has none."""
    return np.array([p.point3D_id if p.has_point3D() else -1 for p in image.points2D], np.int64)
