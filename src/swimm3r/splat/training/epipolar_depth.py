"""Depth of a map from its own Gaussians as virtual views see them (OceanSplat, Kweon & Park 2026).

An opaque Gaussian that all three cameras see is triangulated from its places in the two virtual images. In the axes of
the training camera, whose directions the virtual ones share, its homogeneous point solves A X = 0 with the rows

    x_h Z - X = b_h,   y_h Z - Y = 0,   x_v Z - X = 0,   y_v Z - Y = b_v

of places on the planes z = 1; by least squares, X and Y eliminated,

    Z = (a b_h - c b_v) / (a^2 + c^2),   a = x_h - x_v,   c = y_h - y_v

The nearest of a pixel is the prior of its rendered depth. In turn Gaussians are held to the rendered depth.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from swimm3r.splat.projection.view_camera import ViewCamera
from swimm3r.splat.training.losses import edge_weights

_LEAST_PARALLAX = 1e-12  # squared, on the plane z = 1


def triangulated_depth(
    horizontal: Float[Tensor, "n 2"], vertical: Float[Tensor, "n 2"], b_h: float, b_v: float
) -> Float[Tensor, " n"]:
    """Z of points by their places on the planes z = 1 of the two virtual cameras, in the baselines' unit."""
    a, c = (horizontal - vertical).unbind(-1)
    return (a * b_h - c * b_v) / (a * a + c * c).clamp(min=_LEAST_PARALLAX)


def epipolar_prior(
    points: Float[Tensor, "n 3"], view: ViewCamera, shifts: Float[Tensor, "2 3"], near: float
) -> Float[Tensor, "h w"]:
    """D_epi: triangulated depths of points in camera axes at the pixels that show them, 0 where none does.

    Points have to lie in the images of the camera and of both virtual ones, beyond `near`; the nearest of a pixel
    counts. Without gradient.
    """
    points = points.detach()
    points = points[points[:, 2] > near]
    planes = [(points + shift)[:, :2] / points[:, 2:] for shift in shifts]
    at = view.pixels(points)
    seen = in_image(at, view)
    for shift in shifts:
        seen = seen & in_image(view.pixels(points + shift), view)
    z = triangulated_depth(planes[0], planes[1], float(shifts[0, 0]), float(shifts[1, 1]))
    column, row = at.long().unbind(-1)
    place = torch.where(seen, row * view.width + column, 0)
    nearest = torch.full((view.height * view.width,), torch.inf, dtype=z.dtype, device=z.device)
    nearest = nearest.scatter_reduce(0, place, torch.where(seen, z, torch.inf), "amin")
    return torch.where(nearest.isfinite(), nearest, 0.0).reshape(view.height, view.width)


def epipolar_error(
    z_depth: Float[Tensor, "h w"],
    prior: Float[Tensor, "h w"],
    rgb: Float[Tensor, "3 h w"],
    counted: Bool[Tensor, "h w"],
) -> Float[Tensor, ""]:
    """L_epi = 1 / (H W) sum_x sum_k log(1 + |D - D_epi|) e^{-|d_k I|} over the pixels that count and have a prior."""
    right, down = edge_weights(rgb)
    off = torch.log1p((z_depth - prior).abs()) * (right + down)
    return torch.where(counted & (prior > 0), off, 0.0).mean()


def depth_residual(
    points: Float[Tensor, "n 3"], z_depth: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"], view: ViewCamera,
    near: float, least_alpha: float,
) -> Float[Tensor, ""]:  # fmt: skip
    """L_res = mean |D(x_i) - z_i| over the points, in camera axes, that the image has; 0 for none.

    D is looked up between pixels, and only where alpha is at least `least_alpha`.
    """
    ahead = points[points[:, 2] > near]
    at = view.pixels(ahead.detach())
    grid = (2 * at / torch.tensor([view.width, view.height]).to(at) - 1)[None, :, None]
    maps = torch.stack([z_depth, alpha.detach()])[None]
    D, covered = grid_sample(maps, grid.to(maps), padding_mode="border", align_corners=False)[0, :, :, 0]
    counted = in_image(at, view) & (covered >= least_alpha)
    return torch.where(counted, (D - ahead[:, 2]).abs(), 0.0).sum() / counted.sum().clamp(min=1)


def in_image(at: Float[Tensor, "n 2"], view: ViewCamera) -> Bool[Tensor, " n"]:
    """Mask of the places that lie in a view's image."""
    return ((at >= 0) & (at < torch.tensor([view.width, view.height]).to(at))).all(-1)
