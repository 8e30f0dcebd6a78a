"""Image formation in water and its inverse (Akkaynak & Treibitz 2018, 2019; paper Eqs. 2-4).

    I = J * T_D + Binf * (1 - T_B),   T_D = exp(-beta_D * z),   T_B = exp(-beta_B * z)

z is *ray* depth: the distance from the camera center along the pixel's ray (see `cameras.ray_depth_from_z`), in metres
when the reconstruction is metric, else in its own unit; the coefficients are per that unit. I and J are in the encoding
the medium was fitted in.
"""

from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Encoding = Literal["srgb", "linear"]
Estimator = Literal["Sea-Thru", "physics head"]


@dataclass(frozen=True)
class Medium:
    """Color of the open water and how fast light is lost in it, per RGB channel, for a scene or per pixel."""

    Binf: Float[Tensor, "*#pixels 3"]  # veiling light, 0..1
    beta_D: Float[Tensor, "*#pixels 3"]  # attenuation of the scene's light, 1/unit of ray depth
    beta_B: Float[Tensor, "*#pixels 3"]  # build-up of backscatter, 1/unit of ray depth


@dataclass(frozen=True)
class AttenuationCurve:
    """Sea-Thru's depth-dependent attenuation beta_D(z) = a exp(b z) + c exp(d z), with a, c >= 0 and b, d <= 0.

    One curve for a scene, or one per pixel.
    """

    a: Float[Tensor, "*#pixels 3"]  # 1/unit
    b: Float[Tensor, "*#pixels 3"]  # 1/unit
    c: Float[Tensor, "*#pixels 3"]  # 1/unit
    d: Float[Tensor, "*#pixels 3"]  # 1/unit

    def at(self, ray_depth: Float[Tensor, "*pixels"]) -> Float[Tensor, "*pixels 3"]:
        """beta_D at each depth, 1/unit."""
        z = ray_depth[..., None]
        return self.a * torch.exp(self.b * z) + self.c * torch.exp(self.d * z)


@dataclass(frozen=True)
class MediumFit:
    """A medium estimated from images, with what is known about the estimate.

    `std` holds one standard deviation of each coefficient; `identifiable` says per coefficient and channel ("Binf",
    "beta_D", "beta_B" -> 3 flags) whether the frames determine it, which a short depth range often does not.
    """

    Binf: Float[Tensor, "3"]  # veiling light, 0..1
    beta_D: Float[Tensor, "3"]  # the one number that stands for the curve: -ln T_D(z_med) / z_med at the median depth
    beta_B: Float[Tensor, "3"]  # build-up of backscatter, 1/unit of ray depth
    curve: AttenuationCurve
    std: Medium
    identifiable: dict[str, Bool[Tensor, "3"]]
    z_range: tuple[float, float]  # ray depths the fit has seen
    encoding: Encoding  # of the pixel values it explains
    estimator: Estimator = "Sea-Thru"  # that found it, and restored the images and points it goes with

    def at(self, ray_depth: Float[Tensor, "*pixels"]) -> Medium:
        """The medium as each pixel sees it: beta_D follows the curve, held constant outside `z_range`."""
        beta_D = self.curve.at(ray_depth.clamp(*self.z_range))
        return Medium(self.Binf.expand_as(beta_D), beta_D, self.beta_B.expand_as(beta_D))

    def constant(self) -> Medium:
        """The three numbers per channel alone, without the curve."""
        return Medium(self.Binf, self.beta_D, self.beta_B)


def transmittances(
    ray_depth: Float[Tensor, "*pixels"], medium: Medium
) -> tuple[Float[Tensor, "*pixels 3"], Float[Tensor, "*pixels 3"]]:
    """T_D and T_B (Eq. 2): the shares of scene light kept, and of veiling light still missing, at each depth."""
    z = ray_depth[..., None]
    return torch.exp(-medium.beta_D * z), torch.exp(-medium.beta_B * z)


def backscatter(ray_depth: Float[Tensor, "*pixels"], medium: Medium) -> Float[Tensor, "*pixels 3"]:
    """B(z) = Binf (1 - T_B): the light the water itself sends, what a black object would show."""
    return medium.Binf * -torch.expm1(-medium.beta_B * ray_depth[..., None])


def add_water(
    J: Float[Tensor, "*pixels 3"], ray_depth: Float[Tensor, "*pixels"], medium: Medium
) -> Float[Tensor, "*pixels 3"]:
    """The image a camera takes through the water (Eq. 3)."""
    T_D, _ = transmittances(ray_depth, medium)
    return J * T_D + backscatter(ray_depth, medium)


def remove_water(
    I: Float[Tensor, "*pixels 3"],
    ray_depth: Float[Tensor, "*pixels"],
    medium: Medium,
    min_transmittance: float = 0.05,
) -> Float[Tensor, "*pixels 3"]:
    """The inverse of `add_water` (Eq. 4). Not clamped: who shows it clamps, losses that punish overshoot need it."""
    T_D, _ = transmittances(ray_depth, medium)
    return (I - backscatter(ray_depth, medium)) / T_D.clamp(min=min_transmittance)


def rescale(fit: MediumFit, scale: float) -> MediumFit:
    """The same water after every length was multiplied by `scale`: every coefficient, b and d too, is divided by it."""
    if scale <= 0:
        raise ValueError(f"a scale is positive, got {scale}")

    def per_length(m: Medium) -> Medium:
        return Medium(m.Binf, m.beta_D / scale, m.beta_B / scale)

    c = fit.curve
    return replace(
        fit,
        **vars(per_length(fit.constant())),
        std=per_length(fit.std),
        curve=AttenuationCurve(c.a / scale, c.b / scale, c.c / scale, c.d / scale),
        z_range=(fit.z_range[0] * scale, fit.z_range[1] * scale),
    )


def linear_from_srgb(srgb: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*pixels 3"]:
    """Linear light from sRGB-encoded values in 0..1 (IEC 61966-2-1); values below 0 continue the linear toe."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp(min=0) + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*pixels 3"]:
    """The inverse of `linear_from_srgb`."""
    return torch.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)
