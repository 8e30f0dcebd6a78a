"""The focal length that the fundamental matrices of a clip's pairs agree on, before any frame is placed.

With the principal point at the center and one lens for all frames, E = K F K has two equal singular values s1 = s2 for
the right K = diag(f, f, 1) (Mendonca & Cipolla 1999). So each candidate f costs

    c(f) = mean over pairs of min((s1 - s2) / (s1 + s2), _OUTLIER)

Pairs that see a plane, or only turn, have no fundamental matrix; those that move without turning cost the same for
every f. The rest may be noise: the answer counts where parts of the pairs, each on its own, give it again.
"""

import numpy as np
from jaxtyping import Float

from swimm3r.sfm.features.database import FeatureDatabase

_LOWEST, _HIGHEST, _STEPS = 0.3, 3.0, 117  # candidates per image width, 2 % apart
_OUTLIER = 0.1  # cost of a pair that fits no f near
_PARTS = 4
_FEW = 20  # pairs in each part
_AGREE = 1.06  # largest over smallest answer of the parts


def focal_of_pairs(store: FeatureDatabase) -> float | None:
    """Focal length in pixels; None where the pairs leave it open."""
    import pycolmap

    with store.open() as database:
        camera = database.read_camera(1)
        geometries = database.read_two_view_geometries()[1]
    uncalibrated = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
    F = [g.F for g in geometries if g.config == uncalibrated and g.F is not None]
    return agreed_focal(np.array(F).reshape(-1, 3, 3), camera.width, camera.height)


def agreed_focal(F: Float[np.ndarray, "n 3 3"], width: int, height: int) -> float | None:
    """The f that fundamental matrices, of pixels whose center is the principal point, give in every part of them."""
    if len(F) < _PARTS * _FEW:
        return None
    candidates = width * np.geomspace(_LOWEST, _HIGHEST, _STEPS)
    centered = np.array([[1.0, 0.0, width / 2], [0.0, 1.0, height / 2], [0.0, 0.0, 1.0]])
    costs = np.stack([_cost(centered.T @ F @ centered, f) for f in candidates])
    best = [int(costs[:, part::_PARTS].sum(1).argmin()) for part in range(_PARTS)]
    at_the_edge = min(best) == 0 or max(best) == _STEPS - 1
    if at_the_edge or candidates[max(best)] > _AGREE * candidates[min(best)]:
        return None
    return float(candidates[costs.sum(1).argmin()])


def _cost(F: Float[np.ndarray, "n 3 3"], f: float) -> Float[np.ndarray, " n"]:
    K = np.diag([f, f, 1.0])
    s = np.linalg.svd(K @ F @ K, compute_uv=False)
    return np.minimum((s[:, 0] - s[:, 1]) / (s[:, 0] + s[:, 1]), _OUTLIER)
