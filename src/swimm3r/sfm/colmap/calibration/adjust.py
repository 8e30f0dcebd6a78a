"""Bundle adjustment of a clip that is in place: poses, points and, where asked, the lens; matches are asked again."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from swimm3r.io.colmap.cameras import under_model
from swimm3r.sfm.colmap.adjustment import WIDEST, robust_adjustment
from swimm3r.sfm.colmap.calibration.start import set_camera
from swimm3r.sfm.features.database import MIN_INLIERS, FeatureDatabase

if TYPE_CHECKING:
    import pycolmap

SEED = 0
THREADS = 1  # sums in a changing order end in poses 0.01 degrees apart, on weak clips more; a resumed run must not
STILL = 1e-6  # relative change of the cost that ends a bundle adjustment; COLMAP's 0 always takes 50 or 100 iterations
_PASSES, _ENOUGH = 6, 0.99  # adjustments at most, and the share of the last error that ends them


def adjusted(
    store: FeatureDatabase,
    model: "pycolmap.Reconstruction",
    name: str,
    *,
    focal: bool = False,
    distortion: bool = False,
    is_large: bool = False,
    points_of_two: bool = False,
    width: float = WIDEST,
) -> "pycolmap.Reconstruction":
    """The model after bundle adjustment under the lens model `name`; its focal length and distortion where asked.

    The loss is quadratic up to `width` pixels. Poses and lens of a large model are adjusted without its redundant
    points, which follow afterwards. The lens of the database becomes that of the model before it. Where frames overlap
    little, `points_of_two` adds the points that two of them alone see; they follow any lens, and can tell none.
    """
    import pycolmap

    changed = under_model(model.cameras[1], name)
    set_camera(store, changed)  # the cache below and the model must agree on the lens
    options = pycolmap.DatabaseCacheOptions()
    options.min_num_matches = MIN_INLIERS
    with store.open() as database:
        cache = pycolmap.DatabaseCache.create(database, options)
    out = pycolmap.Reconstruction(model)
    out.cameras[1].model = changed.model
    out.cameras[1].params = list(map(float, changed.params))
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(out)
    mapping = pycolmap.IncrementalMapperOptions()
    mapping.random_seed = SEED
    mapping.num_threads = THREADS
    # half the time and memory of 262 frames; their path is off by 0.0029 % of its length instead of 0.0024 %
    mapping.ba_global_ignore_redundant_points3D = is_large
    triangulation = pycolmap.IncrementalTriangulatorOptions()
    triangulation.random_seed = SEED
    added = points_of_two and store.little_overlap
    triangulation.ignore_two_view_tracks = not added
    adjustment = robust_adjustment(width)
    adjustment.refine_focal_length, adjustment.refine_extra_params = focal, distortion
    adjustment.ceres.solver_options.num_threads = THREADS
    adjustment.ceres.solver_options.function_tolerance = STILL
    if added:
        for image in sorted(out.reg_image_ids()):
            mapper.triangulate_image(triangulation, image)
    mapper.iterative_global_refinement(5, 0.0005, mapping, adjustment, triangulation)
    mapper.end_reconstruction(False)
    out.update_point_3d_errors()
    return out


def settled(
    adjust: "Callable[[pycolmap.Reconstruction], pycolmap.Reconstruction]", model: "pycolmap.Reconstruction"
) -> "pycolmap.Reconstruction":
    """The model adjusted until the reprojection error stands still.

    A lens with many parameters leaves its start slowly: OPENCV on ruie_green_rock stopped at 0.71 px, and came to
    0.56 px when asked again.
    """
    error = np.inf
    for _ in range(_PASSES):
        model = adjust(model)
        before, error = error, model.compute_mean_reprojection_error()
        if error > _ENOUGH * before:
            break
    return model
