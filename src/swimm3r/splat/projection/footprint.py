"""The finest pixel of the training images at the place of each primitive (Mip-Splatting, Yu et al. 2024, Eq. 7).

    h = min over the cameras that have the primitive in their image of z / f

Half of 1 / h is the highest frequency that any of them resolves there.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras, project_visible


def footprints(xyz: Float[Tensor, "n 3"], cameras: Cameras) -> Float[Tensor, " n"]:
    """h in the unit of the cameras; of a primitive that none of them has in its image, that of the nearest camera.

    A pixel of a fisheye is as wide as the lens makes it on its axis, at the distance of the primitive.
    """
    points = xyz.detach().double().cpu()
    inside_any, anywhere = torch.full((2, len(points)), torch.inf, dtype=torch.float64)
    for i in range(len(cameras)):
        camera = cameras[i]
        _, z, inside = (values[0] for values in project_visible(camera, points[None]))
        away = torch.linalg.vector_norm(points - camera.centers[0].double(), dim=-1)
        depth = away if camera.model == "OPENCV_FISHEYE" else z
        f = float(camera.K[0, [0, 1], [0, 1]].max())
        inside_any = inside_any.minimum(torch.where(inside, depth, torch.inf) / f)
        anywhere = anywhere.minimum(away / f)
    return torch.where(inside_any.isinf(), anywhere, inside_any).to(xyz)
