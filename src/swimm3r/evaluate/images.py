"""Rendered images against taken ones, the way the 3D Gaussian Splatting papers print it.

PSNR = -10 log10 mse over all pixels and channels; SSIM with an 11 x 11 Gaussian window of sigma 1.5, C1 = 0.01^2,
C2 = 0.03^2, biased moments and zero padding; both per image, then averaged. A high PSNR of a blurred image is no
success, so two more stand beside them: the PSNR that mere blurring would get, and the ratio of gradient magnitudes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter
from torch import Tensor
from torch.nn.functional import conv2d

from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.lpips import Lpips, lpips

SsimBorder = Literal["zero", "valid"]
_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


@dataclass(frozen=True)
class ViewScores:
    """One rendered view, or the mean of several."""

    psnr: float  # dB
    ssim: float
    lpips: float | NotComputed
    blur4_psnr: float  # dB, of the target against itself blurred with sigma 4 px
    sharpness: float | NotComputed  # mean gradient magnitude, render : target
    views: int
    variant: str  # the forms of SSIM and LPIPS


def view_scores(
    render: Float[Tensor, "h w 3"],
    target: Float[Tensor, "h w 3"],
    perceptual: Lpips | NotComputed,
    seen: Bool[Tensor, "h w"] | None = None,
) -> ViewScores:
    """Every score of one view, both images as their 8-bit files show them.

    Pixels not `seen` (masked out) do not count in the PSNRs; the scores that look at surroundings take them as matched.
    Raises ValueError where no pixel is seen.
    """
    render, target = as_8_bit(render), as_8_bit(target)
    if seen is None:
        seen = torch.ones(target.shape[:2], dtype=torch.bool)
    if not bool(seen.any()):
        raise ValueError("no pixel of the view is seen, so there is nothing to score")
    target = torch.where(seen[..., None], target, render)
    if isinstance(perceptual, NotComputed):
        perceived, variant = perceptual, "SSIM zero-padded"
    else:
        perceived, variant = lpips(render, target, perceptual), f"SSIM zero-padded, {perceptual.variant}"
    return ViewScores(
        psnr=psnr(render[seen], target[seen]),
        ssim=ssim(render, target),
        lpips=perceived,
        blur4_psnr=blur4_psnr(target, seen),
        sharpness=sharpness(render, target),
        views=1,
        variant=variant,
    )


def mean_view_scores(views: Sequence[ViewScores]) -> ViewScores:
    """Means over views; a score missing in one view is missing in the mean, with that view's reason."""
    if not views:
        raise ValueError("the mean score of no views is undefined")

    def mean(values: Sequence[float | NotComputed]) -> float | NotComputed:
        numbers = [v for v in values if not isinstance(v, NotComputed)]
        missing = [v for v in values if isinstance(v, NotComputed)]
        return missing[0] if missing else sum(numbers) / len(numbers)

    return ViewScores(
        psnr=sum(v.psnr for v in views) / len(views),
        ssim=sum(v.ssim for v in views) / len(views),
        lpips=mean([v.lpips for v in views]),
        blur4_psnr=sum(v.blur4_psnr for v in views) / len(views),
        sharpness=mean([v.sharpness for v in views]),
        views=sum(v.views for v in views),
        variant=views[0].variant,
    )


def as_8_bit(image: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*pixels 3"]:
    """The values a PNG of the image holds, 0..1 in steps of 1/255."""
    return (image.clamp(0, 1) * 255).round() / 255


def psnr(render: Float[Tensor, "*pixels 3"], target: Float[Tensor, "*pixels 3"]) -> float:
    """Peak signal-to-noise ratio, dB, of values in 0..1; infinite for equal images."""
    return psnr_from_errors(render.double() - target.double())


def psnr_from_errors(errors: Float[Tensor, "*n"]) -> float:
    """PSNR, dB, of any selection of value differences."""
    return -10 * (errors.double() ** 2).mean().log10().item()


def ssim(render: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], border: SsimBorder = "zero") -> float:
    """Structural similarity, mean over pixels and channels: `zero` pads as 3DGS does, `valid` keeps whole windows."""
    if border == "valid" and min(render.shape[:2]) < _WINDOW:
        raise ValueError(f"SSIM without padding needs {_WINDOW} pixels a side, got {tuple(render.shape[:2])}")
    x, y = render.double().permute(2, 0, 1)[:, None], target.double().permute(2, 0, 1)[:, None]
    offsets = torch.arange(_WINDOW, dtype=torch.float64) - _WINDOW // 2
    weights = torch.exp(-(offsets**2) / (2 * _SIGMA**2))
    weights = weights / weights.sum()
    padding = _WINDOW // 2 if border == "zero" else 0

    def local_mean(v: Tensor) -> Tensor:
        rows = conv2d(v, weights[None, None, None, :], padding=(0, padding))
        return conv2d(rows, weights[None, None, :, None], padding=(padding, 0))

    mean_x, mean_y = local_mean(x), local_mean(y)
    variance_x = local_mean(x * x) - mean_x**2
    variance_y = local_mean(y * y) - mean_y**2
    covariance = local_mean(x * y) - mean_x * mean_y
    brightness = (2 * mean_x * mean_y + _C1) / (mean_x**2 + mean_y**2 + _C1)
    structure = (2 * covariance + _C2) / (variance_x + variance_y + _C2)
    return (brightness * structure).mean().item()


def blur4_psnr(target: Float[Tensor, "h w 3"], seen: Bool[Tensor, "h w"] | None = None) -> float:
    """PSNR of an image against itself blurred with a Gaussian of sigma 4 px (mirrored borders), dB, where `seen`."""
    blurred = gaussian_filter(target.double().numpy(), sigma=(4, 4, 0), mode="reflect")
    errors = torch.from_numpy(blurred) - target.double()
    return psnr_from_errors(errors if seen is None else errors[seen])


def sharpness(
    render: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], counted: Bool[Tensor, "h w"] | None = None
) -> float | NotComputed:
    """Mean gradient magnitude (central differences of the channel mean) of the render over that of the target.

    Means are over the `counted` pixels, of which there must be one, or over all.
    """
    detail = _mean_gradient(target, counted)
    if detail == 0:
        return NotComputed("the target image is flat")
    return _mean_gradient(render, counted) / detail


def _mean_gradient(image: Float[Tensor, "h w 3"], counted: Bool[Tensor, "h w"] | None) -> float:
    down, right = torch.gradient(image.double().mean(-1))
    steps = torch.hypot(down, right)
    return (steps if counted is None else steps[counted]).mean().item()
