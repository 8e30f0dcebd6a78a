"""Misregistration apart from re-lighting: the displacement between a rendering and its frame, and PSNR without colors.

A PSNR does not tell a rendering that lies a pixel off from one in another white balance. Two scores do:

    flow_px       |u|, with u the dense optical flow (DIS) from frame to rendering, median and 90th percentile
    psnr_affine   the PSNR of A render + b, with the A (3 x 3) and b that fit the frame best

The flow is taken between gray images after that fit, each in units of its local contrast, so that neither colors nor
light that changes slowly over the image displace anything. It counts where the frame has texture enough: where the flow
to copies of the frame, displaced by known waves and noisy, finds the waves again. (Constant shifts would be found
anywhere, for dense flow fills what has no texture from what has.) The fit explains colors, not places.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.appearance import image_cosines
from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.images import as_8_bit, psnr

FLOW_SIDE = 480
"""Longer side in pixels of the images whose flow is taken; larger ones are reduced to it."""
_WAVE = (1.5, 96.0)  # px, amplitude and length of the displacements that decide where flow is to be believed
_NOISE = 0.01  # pixel value, of the displaced copies: a sensor's, and what compression leaves
_FOUND = 0.35  # px, the largest error of a round trip where flow counts
_CONTRAST = 6.0  # px, sigma of the window that local contrast is taken in
_FLAT = 0.01  # pixel value, contrast below which noise would pass for texture
_LEAST = 0.02  # of the asked pixels, fewer of which say nothing
_TILES = 8  # of a chessboard along the longer side, finer than the smooth gains that are fitted over it
_STAY = 1e-3  # of maps that are used beyond the pixels they were fitted to: noise of 0.006 over a spread of 0.2


@dataclass(frozen=True)
class Displacement:
    """Lengths of the flow between two images, pixels of images `FLOW_SIDE` large at most."""

    median: float
    p90: float
    share: float  # of the asked pixels, those with texture enough


@dataclass(frozen=True)
class ColorMap:
    """An affine map of colors, c -> matrix c + offset."""

    matrix: Float[Tensor, "3 3"]
    offset: Float[Tensor, "3"]

    def __call__(self, colors: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*pixels 3"]:
        return (colors.to(self.matrix) @ self.matrix.mT + self.offset).to(colors)


def fit_colors(render: Float[Tensor, "*pixels 3"], target: Float[Tensor, "*pixels 3"], stay: float = 1e-6) -> ColorMap:
    """The affine map of the rendered colors that is nearest to the target's, least squares; float64.

    `stay` is the variance of the noise over that of the matrix about the identity: what holds back colors that hardly
    occur.
    """
    x, y = render.reshape(-1, 3).double(), target.reshape(-1, 3).double()
    mean_x, mean_y = x.mean(0), y.mean(0)
    x, y = x - mean_x, y - mean_y
    prior = stay * len(x) * torch.eye(3, dtype=torch.float64, device=x.device)
    matrix = torch.linalg.solve(x.mT @ x + prior, x.mT @ y + prior).mT
    return ColorMap(matrix, mean_y - matrix @ mean_x)


def recolored_by_halves(
    render: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], trusted: Bool[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """A rendering in a frame's colors, each half by the map of colors that fits the other half best.

    So no pixel is compared in colors that it was fitted to. The halves are left and right; a half that is `trusted` in
    hardly any pixel says nothing about the other.
    """
    middle = render.shape[1] // 2
    left, right = slice(None, middle), slice(middle, None)
    halves = []
    for here, there in ((left, right), (right, left)):
        known = trusted[:, there]
        if int(known.sum()) < _LEAST * known.numel():
            halves.append(render[:, here])
            continue
        fit = fit_colors(render[:, there][known], target[:, there][known], _STAY)
        halves.append(fit(render[:, here]))
    return torch.cat(halves, 1)


def recolored_by_tiles(
    render: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], trusted: Bool[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """A rendering in the colors of a frame whose gains change over the image, each half by the fit to the other half.

    The fit is an affine map and a smooth gain (`swimm3r.appearance`), A c + b + s(x, y) c. The halves are the dark and
    the light fields of a chessboard, for a gain beyond the pixels that it was fitted to would be a guess.
    """
    height, width = render.shape[:2]
    side = max(1, round(max(height, width) / _TILES))
    row, column = torch.arange(height)[:, None] // side, torch.arange(width) // side
    dark = (row + column) % 2 == 0
    waves = image_cosines(height, width).permute(1, 2, 0)
    shown = render.clone()
    for here, there in ((dark, ~dark), (~dark, dark)):
        known = there & trusted
        if int(known.sum()) < _LEAST * int(there.sum()):
            continue
        for c in range(3):
            terms, fitted = (_terms(render[part], waves[part], c) for part in (here, known))
            stay = torch.full((terms.shape[1],), _STAY * len(fitted), dtype=torch.float64)
            stay[3] = 0.0
            first = stay * torch.eye(len(stay), dtype=torch.float64)[c]
            products = fitted.mT @ target[known][:, c].double() + first
            shown[..., c][here] = (terms @ torch.linalg.solve(fitted.mT @ fitted + stay.diag(), products)).to(shown)
    return shown


def _terms(colors: Float[Tensor, "p 3"], waves: Float[Tensor, "p k"], c: int) -> Float[Tensor, "p n"]:
    colors = colors.double()
    return torch.cat([colors, torch.ones_like(colors[:, :1]), waves.double() * colors[:, c : c + 1]], 1)


def psnr_affine(
    render: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], where: Bool[Tensor, "h w"]
) -> float | NotComputed:
    """PSNR, dB, over some pixels after the affine map of colors that fits them best, both images in 8 bits."""
    if not bool(where.any()):
        return NotComputed("no pixel to compare")
    render, target = as_8_bit(render)[where], as_8_bit(target)[where]
    return psnr(as_8_bit(fit_colors(render, target)(render)), target)


def displacement(
    render: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], where: Bool[Tensor, "h w"]
) -> Displacement | NotComputed:
    """The flow from a frame to its rendering over the pixels `where` there is texture enough for one."""
    if min(target.shape[:2]) < 32:
        return NotComputed("images of less than 32 pixels a side are too small for optical flow")
    if not bool(where.any()):
        return NotComputed("no training frame saw what the test frames show")
    render, target = as_8_bit(render), as_8_bit(target)
    render = fit_colors(render[where], target[where])(render)
    height, width = target.shape[:2]
    shrunk = min(1.0, FLOW_SIDE / max(height, width))
    size = (max(32, round(width * shrunk)), max(32, round(height * shrunk)))
    there, shown = (_resized(image.mean(-1).float().numpy(), size) for image in (target, render))
    asked = _resized(where.float().numpy(), size) > 0.99
    if not asked.any():
        return NotComputed("what training frames saw is too small for optical flow")
    counted = asked & _reliable(there)
    share = float(counted.sum() / asked.sum())
    if share < _LEAST:
        return NotComputed(f"only {share:.1%} of the pixels have texture enough for optical flow")
    length = np.linalg.norm(flow_between(there, shown), axis=-1)[counted]
    return Displacement(float(np.median(length)), float(np.quantile(length, 0.9)), share)


def flow_between(source: Float[np.ndarray, "h w"], target: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 2"]:
    """Dense optical flow (DIS) of gray images 0..1, in pixels: the source shows at x what the target shows at x + flow.

    Both in units of their local contrast. Where there is no texture it is filled from where there is.
    """
    return _flow(_contrast(source), _contrast(target))


def _resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    import cv2

    return image if image.shape[::-1] == size else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _contrast(gray: np.ndarray) -> np.ndarray:
    """Differences to the local mean in units of the local contrast, in 8 bits; two units are the whole range."""
    import cv2

    def mean(values: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(values, (0, 0), _CONTRAST, borderType=cv2.BORDER_REFLECT)

    off = gray - mean(gray)
    spread = np.sqrt(mean(off * off) + _FLAT**2)
    return np.clip(128 + 64 * off / spread, 0, 255).round().astype(np.uint8)


def _flow(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """[h, w, 2] in pixels: what source shows at x is at x + flow in target."""
    import cv2

    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)  # pyright: ignore[reportAttributeAccessIssue]
    dis.setFinestScale(0)  # sub-pixel displacements are asked for
    start = np.zeros((*source.shape, 2), np.float32)
    return dis.calc(source, target, start)


def _reliable(gray: np.ndarray) -> np.ndarray:
    """Pixels from which flow finds displaced, noisy copies of the image."""
    import cv2

    amplitude, length = _WAVE
    row, column = np.mgrid[: gray.shape[0], : gray.shape[1]].astype(np.float32)
    there, found = _contrast(gray), np.ones(gray.shape, dtype=bool)
    rng = np.random.default_rng(0)
    for phase in (0.0, np.pi / 2):
        along, across = (2 * np.pi * at / length + phase for at in (column, row))
        wave = amplitude * np.stack([np.sin(across), np.sin(along)], -1).astype(np.float32)
        # the copy shows at x what the image shows at x - wave(x): its flow is wave up to the wave's own change over it
        moved = cv2.remap(
            gray, column - wave[..., 0], row - wave[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
        )
        moved = moved + _NOISE * rng.standard_normal(gray.shape, dtype=np.float32)
        # from the copy back, where the displacement is known exactly
        back = _flow(_contrast(moved), there) + wave
        found &= np.linalg.norm(back, axis=-1) < _FOUND
    return found
