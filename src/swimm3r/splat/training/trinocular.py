"""A view against virtual views from beside and below it (OceanSplat, Kweon & Park 2026).

A virtual camera looks the same way from a place that is shifted by b along the image's rows or columns. A point at z
depth D appears in it displaced by the disparity f b / D, so that its image, looked up there, is that of the training
camera wherever D is right:

    I'(x) = I_virtual(x + f b / D(x))

L_tri compares the light of the objects that way, and with the medium's added, with the training image; and disparity is
to be smooth where the image is.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from swimm3r.splat.gaussian_settings import VirtualViewSettings
from swimm3r.splat.projection.view_camera import ViewCamera
from swimm3r.splat.training.losses import edge_weights

_NEAREST = 1e-3  # of the unit of depths: nothing nearer is looked up


def virtual_shifts(settings: VirtualViewSettings, unit: float, rng: torch.Generator) -> Float[Tensor, "2 3"]:
    """Shifts of points in the axes of the horizontal and of the vertical virtual camera, working units.

    t_v = (0, b, 0) with b uniform in -baseline..baseline, t_h = (ratio b, 0, 0), in `unit`.
    """
    b = unit * settings.baseline * (2 * float(torch.rand((), generator=rng)) - 1)
    return torch.tensor([[settings.ratio * b, 0.0, 0.0], [0.0, b, 0.0]])


@dataclass(frozen=True)
class Warped:
    """A virtual image brought to the training camera's pixels."""

    image: Float[Tensor, "c h w"]
    inside: Bool[Tensor, "h w"]  # where the virtual camera has the point in its image


def inverse_warp(
    virtual: Float[Tensor, "c h w"], z_depth: Float[Tensor, "h w"], view: ViewCamera, shift: Float[Tensor, "3"]
) -> Warped:
    """A virtual image at the training camera's pixels by the rendered depth; differentiable in image and depth.

    For a pinhole this displaces by the disparity f b / D; other lenses project the shifted point. Depths of 0 are none
    and have to be left out by the caller.
    """
    points = camera_points(z_depth, view) + shift
    at = view.pixels(points)
    size = torch.tensor([view.width, view.height]).to(at)
    image = grid_sample(
        virtual[None], (2 * at / size - 1)[None].to(virtual), padding_mode="border", align_corners=False
    )[0]
    return Warped(image, ((at >= 0.5) & (at <= size - 0.5)).all(-1))


def camera_points(z_depth: Float[Tensor, "h w"], view: ViewCamera) -> Float[Tensor, "h w 3"]:
    """Points that pixels show, in camera axes."""
    x, y = (torch.arange(n, device=z_depth.device, dtype=z_depth.dtype) + 0.5 for n in (view.width, view.height))
    return view.rays(x, y) * z_depth.clamp(min=_NEAREST)[..., None]


def relative_l1(
    prediction: Float[Tensor, "3 h w"], target: Float[Tensor, "3 h w"], counted: Bool[Tensor, "h w"], floor: float
) -> Float[Tensor, ""]:
    """R-L1: mean of |prediction - target| / (sg(prediction) + floor) over the pixels that count; 0 for none."""
    off = (prediction - target).abs() / (prediction.detach() + floor)
    return torch.where(counted, off, 0.0).sum() / (3 * counted.sum()).clamp(min=1)


def disparity_roughness(
    z_depth: Float[Tensor, "h w"], rgb: Float[Tensor, "3 h w"], counted: Bool[Tensor, "h w"]
) -> Float[Tensor, ""]:
    """L_smooth: mean over the pixels that count of sum_k |d_k d| e^{-|d_k I|}, d = disparity over its mean.

    So every baseline and unit of depth has the same (Godard et al. 2019); k are right and down. 0 for no pixel.
    """
    disparity = 1 / z_depth.clamp(min=_NEAREST)
    count = counted.sum().clamp(min=1)
    d = disparity / (torch.where(counted, disparity, 0.0).sum() / count).clamp(min=1e-6)
    right, down = edge_weights(rgb)
    across = (d.diff(dim=1).abs() * right[:, :-1])[counted[:, 1:] & counted[:, :-1]].sum()
    along = (d.diff(dim=0).abs() * down[:-1])[counted[1:] & counted[:-1]].sum()
    return (across + along) / count
