"""Image formation in water and its inverse (Akkaynak & Treibitz 2018, 2019; paper Eqs. 2-4).

    I = J * T_D + Binf * (1 - T_B),   T_D = exp(-beta_D * z),   T_B = exp(-beta_B * z)

z is *ray* depth: the distance from the camera center along the pixel's ray (see `cameras.ray_depth_from_z`), in metres
when the reconstruction is metric, else in its own unit; the coefficients are per that unit. I and J are in the encoding
the medium was fitted in.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r import notebook
from swimm3r.io.files.atomic import write_text
from swimm3r.lamp import (
    Lamp,
    LightEvidence,
    lamp_distance,
    lamp_document,
    log_light,
    rescaled_lamp,
    share_scattered,
    veil_pattern,
)

_FEW_COLORS = 1e-3  # of one surface known in every channel: gray, where there is none
_UNSEEN = 1e-6  # of a known channel, the weight of those that are not

Encoding = Literal["srgb", "linear"]
Estimator = Literal["Sea-Thru", "physics head"]


@dataclass(frozen=True)
class Medium:
    """Color of the open water and how fast light is lost in it, per RGB channel, for a scene or per pixel."""

    Binf: Float[Tensor, "*#pixels 3"]  # veiling light, 0..1
    beta_D: Float[Tensor, "*#pixels 3"]  # attenuation of the scene's light, 1/unit of ray depth
    beta_B: Float[Tensor, "*#pixels 3"]  # build-up of backscatter, 1/unit of ray depth

    def save(self, path: str | Path) -> None:
        """Write the coefficients of a scene as JSON, whole or not at all; `swimm3r.load_medium` reads them in float32.

        Raises ValueError for a medium per pixel.
        """
        if self.Binf.shape != (3,):
            raise ValueError(
                f"a medium of one scene has 3 values per coefficient, got the shape {list(self.Binf.shape)}"
            )
        write_text(Path(path), json.dumps(_plain(self), indent=2) + "\n")

    def __repr__(self) -> str:
        return f"Medium({_coefficients(self)})" if self.Binf.shape == (3,) else notebook.shapes(self)

    def _repr_html_(self) -> str:
        if self.Binf.shape == (3,):
            return notebook.table("Medium", _rows(self, "per unit of ray depth"), _HEADER)
        mean = Medium(*(values.flatten(0, -2).mean(0) for values in vars(self).values()))
        title = f"Medium per pixel, {list(self.Binf.shape[:-1])}: means"
        return notebook.table(title, _rows(mean, "per unit of ray depth"), _HEADER)


@dataclass(frozen=True)
class AttenuationCurve:
    """Sea-Thru's depth-dependent attenuation beta_D(z) = a exp(b z) + c exp(d z), with a, c >= 0 and b, d <= 0.

    One curve for a scene, or one per pixel.
    """

    a: Float[Tensor, "*#pixels 3"]  # 1/unit
    b: Float[Tensor, "*#pixels 3"]  # 1/unit
    c: Float[Tensor, "*#pixels 3"]  # 1/unit
    d: Float[Tensor, "*#pixels 3"]  # 1/unit

    def __repr__(self) -> str:
        return notebook.shapes(self)

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
    lamp: Lamp | None = None  # that lights the scene from the camera; None in daylight
    light: LightEvidence | None = None  # for the one or the other; None where the light was given

    def at(self, ray_depth: Float[Tensor, "*pixels"], direction: Float[Tensor, "*pixels 3"] | None = None) -> Medium:
        """The medium as each pixel sees it: beta_D follows the curve, held constant outside `z_range`.

        Under a lamp, `direction` (unit, camera axes) adds its light: T_D is then the share of J that arrives, and Binf
        makes the backscatter that of its beam. Without directions it is the water alone.
        """
        beta_D = self.curve.at(ray_depth.clamp(*self.z_range))
        Binf, beta_B = self.Binf.expand_as(beta_D), self.beta_B.expand_as(beta_D)
        if self.lamp is None or direction is None:
            return Medium(Binf, beta_D, beta_B)
        z = ray_depth.clamp(min=_NEAREST * self.lamp.reference)[..., None]
        points = direction * z
        before = beta_D * lamp_distance(points, self.lamp)[..., None] - log_light(points, self.lamp)[..., None]
        scattered = share_scattered(direction, z[..., 0], self.lamp, self.beta_D)
        return Medium(Binf * scattered / -torch.expm1(-beta_B * z), beta_D + before / z, beta_B)

    def open_water(self, direction: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*#pixels 3"]:
        """Color of open water in unit directions of the camera's axes: Binf, under a lamp with its pattern."""
        return self.Binf if self.lamp is None else self.Binf * veil_pattern(direction, self.lamp)[..., None].float()

    def constant(self) -> Medium:
        """The three numbers per channel alone, without the curve."""
        return Medium(self.Binf, self.beta_D, self.beta_B)

    def save(self, path: str | Path) -> None:
        """Write a medium.json that holds this fit, whole or not at all; `swimm3r.load_medium` reads it."""
        save_fits(Path(path), {"linear" if self.encoding == "linear" else "stored": self})

    def __repr__(self) -> str:
        near, far = self.z_range
        about = f"{self.encoding}, ray depths {near:.3g} to {far:.3g}, by {self.estimator}"
        return f"MediumFit({_coefficients(self)},\n  {about})"

    def _repr_html_(self) -> str:
        return self.table("per unit of ray depth")

    def table(self, unit: str) -> str:
        """An HTML table of the coefficients with their standard deviations; `unit` is that of the betas."""
        rows = _rows(self, unit)
        near, far = self.z_range
        title = f"Water by {self.estimator}, {self.encoding} values, ray depths {near:.3g} to {far:.3g}"
        bracketed = not all(bool(flags.all()) for flags in self.identifiable.values())
        return notebook.table(title + "; in brackets: not determined" * bracketed, rows, _HEADER)


_NEAREST = 1e-3  # of a lamp's reference distance: the ray depth of what has none
_HEADER = ("", "red", "green", "blue")
_LABELS = {"Binf": "veiling light Binf", "beta_D": "attenuation beta_D", "beta_B": "backscatter beta_B"}


def _coefficients(water: Medium | MediumFit) -> str:
    """Binf, beta_D and beta_B of a scene in a line."""
    return ", ".join(f"{name}={notebook.channels(getattr(water, name).tolist())}" for name in _LABELS)


def _rows(water: Medium | MediumFit, unit: str) -> list[tuple[str, ...]]:
    """The rows of a table: a coefficient and its values, with what a fit knows about them."""
    rows: list[tuple[str, ...]] = []
    for name, label in _LABELS.items():
        cells = [f"{value:.3f}" for value in getattr(water, name).tolist()]
        if isinstance(water, MediumFit):
            std: list[float] = getattr(water.std, name).tolist()
            known: list[bool] = [bool(flag) for flag in water.identifiable[name]]
            cells = [f"{cell} \u00b1 {each:.3f}" for cell, each in zip(cells, std, strict=True)]
            cells = [cell if sure else f"({cell})" for cell, sure in zip(cells, known, strict=True)]
        rows.append((label if name == "Binf" else f"{label}, {unit}", *cells))
    return rows


def save_fits(path: Path, fits: Mapping[str, MediumFit]) -> None:
    """Write a medium.json of named fits ("stored", "linear"); lists are R, G, B."""
    document: dict[str, dict[str, object]] = {
        name: {
            "medium": _plain(fit.constant()),
            "curve": _plain(fit.curve),
            "std": _plain(fit.std),
            "identifiable": {key: [bool(flag) for flag in flags] for key, flags in fit.identifiable.items()},
            "z_range": list(fit.z_range),
            "encoding": fit.encoding,
            "estimator": fit.estimator,
            **({} if fit.lamp is None else {"lamp": lamp_document(fit.lamp)}),
            **({} if fit.light is None else {"light": vars(fit.light)}),
        }
        for name, fit in fits.items()
    }
    write_text(path, json.dumps(document, indent=2) + "\n")


def _plain(record: Medium | AttenuationCurve) -> dict[str, list[float]]:
    return {name: value.tolist() for name, value in vars(record).items()}


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


def expected_colors(
    J: Float[Tensor, "*pixels 3"],
    known: Float[Tensor, "*pixels 3"],
    counted: Bool[Tensor, "*pixels 1"] | None = None,
) -> Float[Tensor, "*pixels 3"]:
    """Clear colors that the known channels let expect of all: the mean hue, at the brightness of what is known.

    `known` is how far each channel is known, 0..1: below a T_D of some percent an error of the backscatter outweighs
    the color. The hue is that of the surfaces known in every channel, of those `counted`; gray where there are none.
    """
    weight = known**2
    well = weight.prod(-1, keepdim=True) * (known.amin(-1, keepdim=True) > 0.5)
    if counted is not None:
        well = well * counted
    hue = (well * J).reshape(-1, 3).sum(0) + _FEW_COLORS
    hue = hue / hue.mean()
    weight = weight + _UNSEEN
    return hue * (weight * J).sum(-1, keepdim=True) / (weight * hue).sum(-1, keepdim=True)


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
        lamp=None if fit.lamp is None else rescaled_lamp(fit.lamp, scale),
    )


def linear_from_srgb(srgb: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*pixels 3"]:
    """Linear light from sRGB-encoded values in 0..1 (IEC 61966-2-1); values below 0 continue the linear toe."""
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp(min=0) + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*pixels 3"]:
    """The inverse of `linear_from_srgb`."""
    return torch.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)
