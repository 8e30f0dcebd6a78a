"""Canonical view of one frame from all passes of the network, as running sums: memory does not grow with the pairs.

Every pair (i, m) yields a pointmap X of frame i in its own camera with confidence C. With w = C - 0.999:

    X_bar = sum w X / sum w,   C_bar = sum w^2 / sum w
    the slope of the surface between a pixel p and the anchor a of its block, averaged as an angle:
        rho = |xy(p) - xy(a)|,  theta = atan((z(p) - z(a)) / rho)
        relative depth(p) = 1 + mean(rho) tan(sum w theta / sum w) / z_bar(a)

The anchor of a block of S x S pixels is its pixel (S/2, S/2). Depth inside a block keeps its shape relative to the
anchor, so that the alignment needs one depth per block (MASt3R-SfM, Duisterhof et al. 2024, sec. 3).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from swimm3r.errors import WeightsError

_NEAREST = 1e-8  # of depths and distances that are divided by
_LEAST_RATIO = 1e-2  # a pixel this much nearer than its block's anchor is an error of the network
_WIDEST, _NARROWEST = 0.5, 3.5  # focals the network may imply, in focals of 60 degrees


@dataclass(frozen=True)
class CanonicalSums:
    """The running sums of one frame, float64."""

    passes: int
    weight: Float[Tensor, "h w"]
    weight_squared: Float[Tensor, "h w"]
    points: Float[Tensor, "h w 3"]
    distance: Float[Tensor, "h w"]
    angle: Float[Tensor, "h w"]


@dataclass(frozen=True)
class CanonicalView:
    """One frame's own geometry, in its camera and in the network's metres."""

    points: Float[Tensor, "h w 3"]
    relative_depth: Float[Tensor, "h w"]  # z(p) / z(anchor of p's block)
    confidence: Float[Tensor, "h w"]


@dataclass(frozen=True)
class AnchoredFrame:
    """The data of a frame that the alignment keeps."""

    height: int
    width: int
    focal: float  # pixels, as the pointmap implies
    anchor_depth: Float[Tensor, " a"]  # z at the anchors, row-major over blocks
    confidence: float  # mean of the canonical one


def add_pass(
    sums: CanonicalSums | None,
    points: Float[Tensor, "h w 3"],
    confidence: Float[Tensor, "h w"],
    subsample: int = 8,
) -> CanonicalSums:
    """The sums with one more pass. Raises WeightsError for a pointmap that is not finite."""
    h, w = confidence.shape
    if h % subsample or w % subsample:
        raise ValueError(f"a pointmap of {h} x {w} pixels does not divide into blocks of {subsample}")
    if not (points.isfinite().all() and confidence.isfinite().all()):
        wrong = int((~points.isfinite().all(-1) | ~confidence.isfinite()).sum())
        raise WeightsError(
            f"the network's pointmap is not finite at {wrong:,} of {h * w:,} pixels",
            cause="the weights are damaged, or half precision overflowed",
            hint="swimm3r weights verify mast3r, and run the network in float32",
        )
    points, confidence = points.cpu().double(), confidence.cpu().double()  # not every device has float64
    weight = confidence - 0.999
    anchor = spread_anchors(points, subsample)
    distance = (points - anchor)[..., :2].norm(dim=-1).clamp(min=_NEAREST)
    angle = torch.atan((points[..., 2] - anchor[..., 2].clamp(min=_NEAREST)) / distance)
    new = (weight, weight**2, weight[..., None] * points, distance, weight * angle)
    if sums is None:
        return CanonicalSums(1, *new)
    old = (sums.weight, sums.weight_squared, sums.points, sums.distance, sums.angle)
    return CanonicalSums(sums.passes + 1, *(a + b for a, b in zip(old, new, strict=True)))


def canonical_view(sums: CanonicalSums, subsample: int = 8) -> CanonicalView:
    """The averages the sums stand for, float32."""
    points = sums.points / sums.weight[..., None]
    step = sums.distance / sums.passes * torch.tan(sums.angle / sums.weight)
    relative = 1 + step / spread_anchors(points, subsample)[..., 2].clamp(min=_NEAREST)
    confidence = sums.weight_squared / sums.weight
    return CanonicalView(points.float(), relative.clamp(min=_LEAST_RATIO).float(), confidence.float())


def anchored_frame(view: CanonicalView, subsample: int = 8, pixel_center: float = 0.5) -> AnchoredFrame:
    """The anchors' depths and the focal length; `pixel_center` is the coordinate of the first pixel's center."""
    h, w = view.confidence.shape
    half = subsample // 2
    depth = view.points[half::subsample, half::subsample, 2].flatten().clamp(min=_NEAREST)
    return AnchoredFrame(h, w, implied_focal(view.points, pixel_center), depth, float(view.confidence.mean()))


def implied_focal(points: Float[Tensor, "h w 3"], pixel_center: float = 0.5) -> float:
    """The focal length (pixels) that projects the points onto their own pixels, by Weiszfeld's median of 10 steps.

    The principal point is the image's center. Clipped to 0.5 .. 3.5 times that of a 60 degree lens.
    """
    h, w = points.shape[:2]
    y, x = torch.meshgrid(torch.arange(h) + pixel_center, torch.arange(w) + pixel_center, indexing="ij")
    pixels = torch.stack([x - w / 2, y - h / 2], dim=-1)
    rays = torch.nan_to_num(points[..., :2] / points[..., 2:], nan=0.0, posinf=0.0, neginf=0.0)
    along, squared = (rays * pixels).sum(-1), (rays * rays).sum(-1)
    focal = along.mean() / squared.mean().clamp(min=_NEAREST)
    for _ in range(10):
        weight = 1 / (pixels - focal * rays).norm(dim=-1).clamp(min=1e-8)
        focal = (weight * along).mean() / (weight * squared).mean().clamp(min=_NEAREST)
    normal = max(h, w) / (2 * 3**-0.5)  # of a 60 degree lens: tan 30 = 1 / sqrt 3
    return float(focal.clamp(_WIDEST * normal, _NARROWEST * normal))


def anchors_of(
    view: CanonicalView, xy: Int64[Tensor, "m 2"], subsample: int = 8
) -> tuple[Int64[Tensor, " m"], Float[Tensor, " m"]]:
    """For pixels of a frame, the number of their block's anchor and their depth relative to it."""
    x, y = xy.T
    blocks = view.confidence.shape[1] // subsample
    anchor = y // subsample * blocks + x // subsample
    return anchor, view.relative_depth[y, x]


def spread_anchors(values: Float[Tensor, "h w c"], subsample: int) -> Float[Tensor, "h w c"]:
    """At every pixel the value of its block's anchor."""
    half = subsample // 2
    chosen = values[half::subsample, half::subsample]
    return chosen.repeat_interleave(subsample, dim=0).repeat_interleave(subsample, dim=1)
