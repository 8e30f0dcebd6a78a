"""Scores of restored colors: without a reference, and against known water.

UIQM (Panetta et al. 2015) in the variant of the FUnIE-GAN code, which the paper's table follows, two slips included;
UCIQE (Yang & Sowmya 2015) in CIELAB's own units. Both reward contrast stretching, so read them beside images.

Against a synthetic truth: mean absolute errors of the direct transmittance T_D and of the backscatter B over pixels at
their true ray depth, and the PSNR of clear colors where enough light is left to tell (true T_D > 0.05).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from PIL import Image
from scipy.ndimage import sobel
from torch import Tensor

from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.images import as_8_bit, psnr_from_errors
from swimm3r.medium import Medium, backscatter, linear_from_srgb, transmittances

URANKER = NotComputed("URanker's network is not published in enough detail to be rebuilt")
"""The reason for the missing UnderwaterRanker score (Guo et al. 2023).

Known are a CoaT-like transformer (patches 4, 2, 2, 2; widths 152, 320, 320, 320; serial depths 2, 2, 2, 2; 6 parallel
blocks; 8 heads; position windows 3, 5, 7 for 2, 3, 3 heads), a 64-bin histogram of each channel as a further token, and
the mean of three linear heads on the class tokens of scales 2 to 4. Not known: where that token enters attention and
position encodings, how the parallel blocks exchange scales, the normalizations, and the names in the weights' file,
without which a wrong guess would load in part and score silently. The authors' code is non-commercial and stays unread.
"""
_BLOCK = 10  # pixels; only whole blocks count


@dataclass(frozen=True)
class Uiqm:
    """UIQM and its three parts: colorfulness, sharpness, contrast."""

    uiqm: float
    uicm: float
    uism: float
    uiconm: float
    variant: str


@dataclass(frozen=True)
class WaterErrors:
    """Absolute errors of an estimated water in one view, per RGB channel, summed over its pixels of known depth."""

    T_D: Float[Tensor, "3"]
    B: Float[Tensor, "3"]
    pixels: int


@dataclass(frozen=True)
class WaterScores:
    """Errors of an estimated water against the true one, per RGB channel."""

    T_D_abs: list[float]
    B_abs: list[float]
    Binf_abs: list[float]
    beta_D_rel: list[float | None]  # |estimate - truth| / truth; None where the fit does not determine it
    beta_B_rel: list[float | None]

    def summary(self) -> dict[str, object]:
        """The scores as `summary.json` keeps them, reasons for missing coefficients included."""
        entries: dict[str, object] = dict(vars(self))
        for key in ("beta_D_rel", "beta_B_rel"):
            missing = [channel for channel, value in zip("RGB", getattr(self, key), strict=True) if value is None]
            if missing:
                entries[f"{key}_reason"] = f"not identifiable in {', '.join(missing)}"
        return entries


def uiqm(rgb: Float[Tensor, "h w 3"], size: tuple[int, int] | None = None) -> Uiqm:
    """UIQM = 0.0282 UICM + 0.2953 UISM + 3.5753 UIConM of an image in 0..1, FUnIE-GAN variant.

    The image is scored as its 8-bit file shows it. `size` (width, height) resizes first (Pillow, bicubic), as that
    code's driver does with 256 x 256; the default is the image's own resolution: a few percent apart.
    """
    values = (as_8_bit(rgb) * 255).round().numpy().astype(np.uint8)
    if size is not None:
        values = np.asarray(Image.fromarray(values).resize(size, Image.Resampling.BICUBIC))
    if min(values.shape[:2]) < _BLOCK:
        raise ValueError(f"UIQM needs at least {_BLOCK} pixels a side, got {values.shape[1]} x {values.shape[0]}")
    values = values.astype(np.float64)
    uicm, uism, uiconm = _colorfulness(values), _sharpness(values), _contrast(values)
    variant = "FUnIE-GAN, " + ("native size" if size is None else f"resized to {size[0]}x{size[1]}")
    return Uiqm(0.0282 * uicm + 0.2953 * uism + 3.5753 * uiconm, uicm, uism, uiconm, variant)


def uciqe(rgb: Float[Tensor, "h w 3"]) -> float:
    """0.4680 std of chroma + 0.2745 contrast of L + 0.2576 mean chroma / L of an sRGB image, in CIELAB's own units.

    The contrast is the mean of the brightest 1 % of L less that of the darkest 1 %; scored as the 8-bit file shows it.
    """
    lab = _lab_from_srgb((as_8_bit(rgb) * 255).round().to(torch.uint8)).reshape(-1, 3)
    L, chroma = lab[:, 0], lab[:, 1:].square().sum(-1).sqrt()
    extreme = max(1, round(0.01 * len(L)))
    ordered = np.partition(L.numpy(), (extreme - 1, len(L) - extreme))
    contrast = float(ordered[len(L) - extreme :].mean() - ordered[:extreme].mean())
    saturation = torch.where(L > 0, chroma / L, 0.0)
    return (0.4680 * chroma.std(correction=0) + 0.2745 * contrast + 0.2576 * saturation.mean()).item()


def view_water_errors(
    ray_depth: Float[Tensor, "h w"],
    estimated: Medium,
    true: Medium,
    true_backscatter: Float[Tensor, "h w 3"] | None = None,
) -> WaterErrors:
    """Errors of a water that may vary over the image, at the pixels of one view with their true ray depth.

    `true_backscatter` is given where that of the true water is not it: under a lamp.
    """
    z = ray_depth.double()
    seen = torch.isfinite(z) & (z > 0)
    T_D_off = (transmittances(z, estimated)[0] - transmittances(z, true)[0]).abs()
    true_B = backscatter(z, true) if true_backscatter is None else true_backscatter
    B_off = (backscatter(z, estimated) - true_B).abs()
    return WaterErrors(T_D_off[seen].sum(0), B_off[seen].sum(0), int(seen.sum()))


def water_scores_from_errors(
    errors: Sequence[WaterErrors], coefficients: Medium, identifiable: dict[str, Bool[Tensor, "3"]], true: Medium
) -> WaterScores:
    """Scores over the pixels of all views.

    `coefficients` are the scene's three numbers per channel that are reported and compared with the truth.
    """
    pixels = sum(each.pixels for each in errors)
    if not pixels:
        raise ValueError("no pixel has a true depth to compare the water at")

    def relative(name: str) -> list[float | None]:
        estimate, truth = getattr(coefficients, name).double(), getattr(true, name).double()
        known = identifiable[name]
        return [e.item() if k else None for e, k in zip((estimate - truth).abs() / truth, known, strict=True)]

    return WaterScores(
        T_D_abs=(torch.stack([each.T_D for each in errors]).sum(0) / pixels).tolist(),
        B_abs=(torch.stack([each.B for each in errors]).sum(0) / pixels).tolist(),
        Binf_abs=(coefficients.Binf.double() - true.Binf.double()).abs().tolist(),
        beta_D_rel=relative("beta_D"),
        beta_B_rel=relative("beta_B"),
    )


def clear_psnr(
    restored: Float[Tensor, "h w 3"],
    clear: Float[Tensor, "h w 3"],
    ray_depth: Float[Tensor, "h w"],
    true: Medium,
    min_transmittance: float = 0.05,
    light: Float[Tensor, "h w 3"] | None = None,
) -> float | NotComputed:
    """PSNR, dB, of restored against true clear colors, as shown (clamped to 0..1), where the light allows a judgement.

    A pixel counts in a channel when its true ray depth is known and its true T_D there is above `min_transmittance`;
    under a lamp when the share of its light that arrives is, `light` being that on the surface.
    """
    counted = lit_enough(ray_depth, true, min_transmittance, light)
    if not counted.any():
        return NotComputed(f"no pixel has a true depth and a transmittance above {min_transmittance}")
    errors = (restored.double().clamp(0, 1) - clear.double())[counted]
    if errors.isnan().any():
        raise ValueError("the restored image has values that are not numbers where it is scored")
    return psnr_from_errors(errors)


def lit_enough(
    ray_depth: Float[Tensor, "h w"],
    true: Medium,
    min_transmittance: float = 0.05,
    light: Float[Tensor, "h w 3"] | None = None,
) -> Bool[Tensor, "h w 3"]:
    """Mask of the values that `clear_psnr` counts."""
    z = ray_depth.double()
    seen = torch.isfinite(z) & (z > 0)
    T_D, _ = transmittances(torch.where(seen, z, 0.0), true)
    arriving = T_D if light is None else T_D * light.double()
    return seen[..., None] & arriving.gt(min_transmittance)


def strength_gain(
    views: Iterable[tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"], Bool[Tensor, "h w 3"]]],
) -> float:
    """The one gain of restored to true clear colors, over all counted values of all views.

    Images do not tell the strength of a lamp from the brightness of the scene, so that colors under a lamp are compared
    after it.
    """
    along, square = 0.0, 0.0
    for restored, clear, counted in views:
        found, true = restored.double()[counted], clear.double()[counted]
        along, square = along + float((found * true).sum()), square + float((found * found).sum())
    return along / square if square > 0 else 1.0


def _colorfulness(rgb: ndarray) -> float:
    R, G, B = rgb.reshape(-1, 3).T
    trimmed_means, variances = [], []
    for opponent in (R - G, (R + G) / 2 - B):
        ordered, n = np.sort(opponent), len(opponent)
        low, high = int(np.ceil(0.1 * n)), int(np.floor(0.1 * n))
        mean = ordered[low + 1 : n - high].sum() / (n - low - high)  # one value too few, as in that code
        trimmed_means.append(mean)
        variances.append(((opponent - mean) ** 2).mean())  # over all values, not only the kept ones
    return float(-0.0268 * np.hypot(*trimmed_means) + 0.1586 * np.sqrt(sum(variances)))


def _sharpness(rgb: ndarray) -> float:
    score = 0.0
    for channel, weight in zip(np.moveaxis(rgb, -1, 0), (0.299, 0.587, 0.144), strict=True):  # 0.114 in the article
        gradient = np.hypot(sobel(channel, 0), sobel(channel, 1))
        strongest = gradient.max()
        if strongest > 0:  # a flat channel has no edges to scale
            score += weight * _enhancement(gradient * (255 / strongest) * channel)
    return score


def _enhancement(edges: ndarray) -> float:
    """EME: mean over blocks of 2 ln(max / min), 0 for blocks that touch zero."""
    blocks = _blocks(edges[..., None])
    low, high = blocks.min(-1), blocks.max(-1)
    counted = (low > 0) & (high > 0)
    return float(2 * np.log(high[counted] / low[counted]).sum() / low.size)


def _contrast(rgb: ndarray) -> float:
    """-mean over blocks of c ln c, c = (max - min) / (max + min) over the three channels together."""
    blocks = _blocks(rgb)
    low, high = blocks.min(-1), blocks.max(-1)
    counted = high > low
    c = (high - low)[counted] / (high + low)[counted]
    return float(-(c * np.log(c)).sum() / low.size)


def _blocks(image: ndarray) -> ndarray:
    """All values of each whole block, [blocks, values]; ragged borders are cut off."""
    rows, columns = image.shape[0] // _BLOCK, image.shape[1] // _BLOCK
    cropped = image[: rows * _BLOCK, : columns * _BLOCK]
    tiles = cropped.reshape(rows, _BLOCK, columns, _BLOCK, -1).swapaxes(1, 2)
    return tiles.reshape(rows * columns, -1)


def _lab_from_srgb(srgb: UInt8[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """CIE 1976 L*a*b* under D65, L in 0..100, of 8-bit values; float64."""
    xyz_from_rgb = torch.tensor(
        [[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]],
        dtype=torch.float64,
    )
    white = torch.tensor([0.95047, 1.0, 1.08883], dtype=torch.float64)
    levels = (torch.arange(256, dtype=torch.float64) / 255)[:, None].expand(-1, 3)
    linear = linear_from_srgb(levels)[:, 0][srgb.int()]
    t = linear @ (xyz_from_rgb / white[:, None]).T
    f = torch.where(t > 0.008856, torch.from_numpy(np.cbrt(t.numpy())), 7.787 * t + 16 / 116)
    x, y, z = f.unbind(-1)
    return torch.stack((116 * y - 16, 500 * (x - y), 200 * (y - z)), -1)
