"""Frames that contradict the pairs of frames which were verified before any was placed: a whole part may stand wrong.

Every pair's verified matches speak for one motion. Where a part of a clip was placed wrongly, many frames support each
other's errors and resection from one another finds nothing; but their pairs, within the part and to the rest, do not
meet their epipolar lines. Frames are taken away, the one whose pairs agree least first, until most pairs of each that
is left do. Pairs with hardly more matches than the verification asks for count little: some are of frames that share no
ground.
"""

from collections import defaultdict
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from swimm3r.sfm.features.database import FeatureDatabase

if TYPE_CHECKING:
    import pycolmap

_FEW = 15  # matches below which a pair is not asked; skerki_survey has wrong pairs with 15 to 26
_SURE = 15  # matches beyond those, from which on a pair counts fully
_AGREES = 2.0  # mean reprojection errors: the median distance from the lines that a right pair keeps
_LEAST = 1 / 640  # of the longer side, granted as a pixel is: a lens not yet refined errs with the size of the image
_MOST = 0.7  # share of a frame's pairs that must agree, by what they count
_KEPT = 0.3  # share of the frames that must be left to build upon, else nothing is said


def contradicting_frames(store: FeatureDatabase, model: "pycolmap.Reconstruction") -> list[int]:
    """Image ids of registered frames that stand against their own pairs; none where too few would be left."""
    camera = model.cameras[1]
    limit = max(1.0, _LEAST * max(camera.width, camera.height), _AGREES * model.compute_mean_reprojection_error())
    partners: defaultdict[int, dict[int, _Verdict]] = defaultdict(dict)
    for (i, j), pair in checked_pairs(store, model).items():
        partners[i][j] = partners[j][i] = _Verdict(pair.distance < limit, pair.weight)
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


@dataclass(frozen=True)
class _Verdict:
    """One pair's, on both of its frames."""

    agrees: bool
    weight: int


def _share(partners: Mapping[int, _Verdict], left: Collection[int]) -> float:
    """Share of a frame's pairs with frames that are left which agree, by their weights; 1 without any."""
    asked = [pair for partner, pair in partners.items() if partner in left]
    return sum(pair.agrees * pair.weight for pair in asked) / sum(pair.weight for pair in asked) if asked else 1.0


@dataclass(frozen=True)
class CheckedPair:
    """A registered pair's verified matches under a model."""

    distance: float  # median, pixels, from their epipolar lines
    matches: int

    @property
    def weight(self) -> int:
        """Weight beside other pairs, at least 1."""
        return min(self.matches - _FEW + 1, _SURE)


def checked_pairs(store: FeatureDatabase, model: "pycolmap.Reconstruction") -> dict[tuple[int, int], CheckedPair]:
    """Registered pairs of frames with enough verified matches, by image ids."""
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
            out[a, b] = CheckedPair(float(np.median(mean)) * camera.mean_focal_length(), len(matches))
    return out


def _rays(camera: "pycolmap.Camera", pixels: np.ndarray) -> np.ndarray:
    """Undistorted, z = 1."""
    xy = np.asarray(camera.cam_from_img(pixels))
    return np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
