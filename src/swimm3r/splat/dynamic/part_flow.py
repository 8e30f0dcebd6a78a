"""Optical flow of a moving part from one frame to another.

Parts that are laid over each other (`part_tracks`) are near each other up to their turning and bending; optical flow
says that, and where it leads nowhere the motion of the whole part says enough.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate, pad

from swimm3r.cameras import inside_image, pixel_grid
from swimm3r.splat.dynamic.part_tracks import Fit, Part
from swimm3r.splat.views import TrainingView

_RETURN = 1.5  # pixels within which flow there and back must end where it began
_FLOW_SIDE = 240  # flow is found on images halved until their long side is below twice as many pixels
_LEADS = 30  # pixels that must be followed for the motion of a part to be more than it was laid over by


@dataclass(frozen=True)
class Passage:
    """Positions of the pixels of a part in another frame, both at full size."""

    flow: Float[Tensor, "2 h w"]
    back: Float[Tensor, "2 h w"]
    whole: Float[Tensor, "2 3"]  # the motion of the part as a whole: affine, of homogeneous pixels

    def there(self, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
        """By the flow where the flow back ends where it began, else with the whole part."""
        moved, leads = _followed(self.flow, self.back, pixels)
        return torch.where(leads[:, None], moved, carried(self.whole, pixels))


def carried(whole: Float[Tensor, "2 3"], pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
    """Pixels that move with a part as a whole."""
    return (pixels.to(whole) @ whole[:, :2].mT + whole[:, 2]).to(pixels)


def passages(fit: Fit, a: Part, b: Part, first: TrainingView, second: TrainingView) -> tuple[Passage, Passage]:
    """From part a in one view to part b in another, and back."""
    scale = first.camera.width / a.mask.shape[1]
    there = torch.cat([fit.whole[:, :2], scale * fit.whole[:, 2:]], 1)
    back = _inverse(there)
    mine, theirs = _on_gray(first, a.mask), _on_gray(second, b.mask)
    flow, return_flow = _flow(mine, theirs, there), _flow(theirs, mine, back)
    return (
        Passage(flow, return_flow, _as_a_whole(flow, return_flow, full_size(a.mask, first), there)),
        Passage(return_flow, flow, _as_a_whole(return_flow, flow, full_size(b.mask, second), back)),
    )


def _inverse(whole: Float[Tensor, "2 3"]) -> Float[Tensor, "2 3"]:
    turned = torch.linalg.inv(whole[:, :2])
    return torch.cat([turned, -turned @ whole[:, 2:]], 1)


def full_size(values: Shaped[Tensor, "h w"], view: TrainingView) -> Float[Tensor, "H W"]:
    """The values of a smaller image's pixels, at the size of a view's own."""
    return interpolate(values[None, None].float(), view.rgb.shape[1:], mode="nearest")[0, 0]


def _on_gray(view: TrainingView, mask: Bool[Tensor, "h w"]) -> UInt8[np.ndarray, "H W"]:
    """The moving pixels of a frame on an even gray, so that the ground's motion does not enter the flow."""
    import cv2

    gray = cv2.cvtColor((255 * view.rgb).byte().permute(1, 2, 0).numpy(), cv2.COLOR_RGB2GRAY)
    gray[full_size(mask, view).numpy() == 0] = 128
    return gray


def _flow(
    first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"], about: Float[Tensor, "2 3"]
) -> Float[Tensor, "2 h w"]:
    """Displacement of every pixel of one image in another, pixels (x, y), starting from `about`."""
    import cv2

    height, width = first.shape
    pixels = pixel_grid(height, width)
    there = carried(about, pixels.reshape(-1, 2)).reshape(height, width, 2).float()
    column, row = (there - 0.5).numpy().transpose(2, 0, 1)
    brought = cv2.remap(second, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    outside = ((there < 0) | (there > torch.tensor([width, height]))).any(-1).numpy()
    brought[outside] = first[outside]  # what is out of the second image goes with the rest
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow.setFinestScale(max(0, int(np.log2(max(first.shape) / _FLOW_SIDE))))
    found = pixels + torch.from_numpy(flow.calc(first, brought, None))  # pyright: ignore
    moved = carried(about, found.reshape(-1, 2)).reshape(height, width, 2).float()
    return (moved - pixels).permute(2, 0, 1)


def _followed(
    flow: Float[Tensor, "2 h w"], back: Float[Tensor, "2 h w"], pixels: Float[Tensor, "n 2"]
) -> tuple[Float[Tensor, "n 2"], Bool[Tensor, " n"]]:
    """Targets of the flow, and whether they lie inside the image and the backward flow returns to the start."""
    moved = pixels + _sampled(flow, pixels)
    returned = moved + _sampled(back, moved)
    inside = inside_image(moved, flow.shape[2], flow.shape[1])
    return moved, inside & (torch.linalg.vector_norm(returned - pixels, dim=-1) < _RETURN)


def _as_a_whole(
    flow: Float[Tensor, "2 h w"],
    back: Float[Tensor, "2 h w"],
    mask: Float[Tensor, "h w"],
    about: Float[Tensor, "2 3"],
) -> Float[Tensor, "2 3"]:
    """The affine motion that most of a part's flow agrees on; what it is about where there is too little flow."""
    rows, columns = mask.nonzero().unbind(-1)
    pixels = torch.stack([columns, rows], -1) + 0.5
    moved, leads = _followed(flow, back, pixels)
    whole = about
    for _ in range(2):  # again without what is off
        if int(leads.sum()) < _LEADS:
            return whole
        known = pad(pixels[leads].double(), (0, 1), value=1.0)
        whole = torch.linalg.lstsq(known, moved[leads].double()).solution.mT
        off = torch.linalg.vector_norm(moved - carried(whole, pixels), dim=-1)
        leads &= off <= 2 * max(_RETURN, float(off[leads].median()))
    return whole


def _sampled(maps: Float[Tensor, "c h w"], pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n c"]:
    """Values of maps at pixels, bilinear; those of the border beyond it."""
    size = torch.tensor([maps.shape[2], maps.shape[1]])
    at = (2 * pixels / size - 1).reshape(1, 1, -1, 2).to(maps)
    return grid_sample(maps[None], at, padding_mode="border", align_corners=False)[0, :, 0].mT
