"""The pose of one camera from pixels of known points."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import Cameras
from swimm3r.io.colmap.cameras import to_pycolmap_camera


def absolute_pose(
    points2d: Float[Tensor, "n 2"], points3d: Float[Tensor, "n 3"], camera: Cameras, max_error: float = 4.0
) -> tuple[Float[Tensor, "4 4"], Bool[Tensor, " n"]] | None:
    """cam2world of one camera from pixels of known points (PnP with RANSAC), and its inliers; None where there is none.

    Only the intrinsics of `camera` (one) are used; `max_error` is in pixels.
    """
    import pycolmap

    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = max_error
    options.ransac.random_seed = 0
    lens = to_pycolmap_camera(camera)
    found = pycolmap.estimate_and_refine_absolute_pose(
        points2d.double().numpy(), points3d.double().numpy(), lens, estimation_options=options
    )
    if found is None:
        return None
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3] = torch.from_numpy(found["cam_from_world"].inverse().matrix())
    return pose, torch.from_numpy(np.asarray(found["inlier_mask"], bool))
