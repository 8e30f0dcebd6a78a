"""Frames that contradict the pairs of frames which were verified before any was placed: a whole part may stand wrong.

Every pair's verified matches speak for one motion. Where a part of a clip was placed wrongly, many frames support each
other's errors and resection from one another finds nothing; but their pairs, within the part and to the rest, do not
meet their epipolar lines. Frames are taken away, the one with the fewest pairs that agree first, until most pairs of
each that is left do.
"""

from collections import defaultdict
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

import numpy as np

from swimm3r.sfm.features.database import FeatureDatabase

if TYPE_CHECKING:
    import pycolmap

_FEW = 15  # matches below which a pair is not asked
_AGREES = 2.0  # mean reprojection errors, a pixel at least: the median distance from the lines that a right pair keeps
_MOST = 0.7  # share of a frame's pairs that must agree
_KEPT = 0.3  # share of the frames that must be left to build upon, else nothing is said


def contradicting_frames(store: FeatureDatabase, model: "pycolmap.Reconstruction") -> list[int]:
    """Image ids of registered frames that stand against their own pairs; none where too few would be left."""
    distances = pair_distances(store, model)
    limit = max(1.0, _AGREES * model.compute_mean_reprojection_error())
    partners: defaultdict[int, dict[int, bool]] = defaultdict(dict)
    for (i, j), distance in distances.items():
        partners[i][j] = partners[j][i] = distance < limit
    left = set(model.reg_image_ids())
    share = {i: _share(partners[i], left) for i in left}
    while True:
        worst = min(left, key=lambda i: (share[i], i))
        if share[worst] >= _MOST:
            break
        left.remove(worst)
        share |= {i: _share(partners[i], left) for i in partners[worst] if i in left}
    placed = model.reg_image_ids()
    if len(left) < max(3, _KEPT * len(placed)):
        return []
    return sorted(set(placed) - left)


def _share(partners: Mapping[int, bool], left: Collection[int]) -> float:
    """Share of a frame's pairs with frames that are left which agree; 1 without any."""
    asked = [agrees for partner, agrees in partners.items() if partner in left]
    return sum(asked) / len(asked) if asked else 1.0


def pair_distances(store: FeatureDatabase, model: "pycolmap.Reconstruction") -> dict[tuple[int, int], float]:
    """Median distance, pixels, of registered pairs' verified matches from their epipolar lines under the model."""
    import pycolmap

    placed, camera = set(model.reg_image_ids()), model.cameras[1]
    out = {}
    with store.open() as database:
        rays = {i: _rays(camera, database.read_keypoints(i)[:, :2].astype(np.float64)) for i in placed}
        for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
            a, b = pycolmap.pair_id_to_image_pair(pair)
            matches = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
            if a not in placed or b not in placed or len(matches) < _FEW:
                continue
            b_from_a = model.images[b].cam_from_world() * model.images[a].cam_from_world().inverse()
            t = b_from_a.translation
            E = np.cross(np.eye(3), t) @ b_from_a.rotation.matrix()
            x, y = rays[a][matches[:, 0]], rays[b][matches[:, 1]]
            lines_b, lines_a = x @ E.T, y @ E
            off = np.abs((y * lines_b).sum(1))
            lengths = (np.linalg.norm(lines[:, :2], axis=1) for lines in (lines_a, lines_b))
            mean = sum(off / np.maximum(length, 1e-12) for length in lengths) / 2
            out[a, b] = float(np.median(mean)) * camera.mean_focal_length()
    return out


def _rays(camera: "pycolmap.Camera", pixels: np.ndarray) -> np.ndarray:
    """Undistorted, z = 1."""
    xy = np.asarray(camera.cam_from_img(pixels))
    return np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
