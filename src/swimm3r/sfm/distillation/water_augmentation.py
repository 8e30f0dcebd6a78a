"""Water augmentation: clear images seen through a sampled water of the paper's four families (`swimm3r.water_types`).

I~ = J exp(-beta_D z) + Binf (1 - exp(-beta_B z)),   z the ray depth, gaps filled from the nearest known pixel
"""

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from swimm3r.medium import Medium, add_water

_BLACK = 5 / 255  # above what resizing leaves of a black area's own values


def with_sampled_water(
    clean: Float[Tensor, "3 h w"], ray_depth: Float[Tensor, "h w"], water: Medium
) -> Float[Tensor, "3 h w"]:
    """The network's clear image (-1..1) through the water; ray depth in metres, 0 where unknown.

    Black pixels of unknown depth show nothing and become open water.
    """
    J = ((clean + 1) / 2).permute(1, 2, 0)
    nothing = (ray_depth <= 0) & (J.amax(-1) < _BLACK)
    wet = torch.where(nothing[..., None], water.Binf, add_water(J, nearest_known(ray_depth), water))
    return 2 * wet.permute(2, 0, 1) - 1


def nearest_known(depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Depth with its gaps filled from the nearest pixel where it is known."""
    nearest = distance_transform_edt((depth <= 0).numpy(), return_distances=False, return_indices=True)
    rows, columns = torch.from_numpy(np.asarray(nearest)).long()
    return depth[rows, columns]
