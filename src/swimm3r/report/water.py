"""The section on the water: the two curves over ray depth, the tables of coefficients, and how images are shown."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from swimm3r.medium import MediumFit, backscatter, srgb_from_linear, transmittances
from swimm3r.report import charts
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.medium.plausibility import any_determined, attenuation_is_a_guess

_LABELS = {
    "Binf": "Veiling light, color of the open water (Binf)",
    "beta_D": "Attenuation of the scene's light at the median depth (beta_D)",
    "beta_B": "Build-up of backscatter (beta_B)",
}


@dataclass(frozen=True)
class Cell:
    """A coefficient of one channel with its standard deviation; `known` where the frames determine it."""

    text: str
    known: bool


@dataclass(frozen=True)
class Table:
    """The coefficients of one fit: rows of a label, a unit and three cells."""

    title: str
    rows: tuple[tuple[str, str, tuple[Cell, ...]], ...]


@dataclass(frozen=True)
class Water:
    """Everything that the section shows."""

    swatch: str  # CSS color of the open water
    backscatter: str  # SVG
    transmittance: str  # SVG
    tables: tuple[Table, ...]
    guessed: bool
    colors: str  # of the restored frames, after "the colors"
    unit: str
    light: str  # sun or lamp, in words; empty for the sun


def water_section(rec: Reconstruction) -> Water | None:
    """The water of a reconstruction in the encodings it was fitted in; None where it was not estimated."""
    fit = rec.medium
    if fit is None:
        return None
    unit = "m" if rec.metric else "scene units"
    veil = srgb_from_linear(fit.Binf) if fit.encoding == "linear" else fit.Binf
    return Water(
        "rgb({:.0f}, {:.0f}, {:.0f})".format(*(veil.clamp(0, 1) * 255).tolist()),
        _chart(fit, "Backscatter B(z), 0 to 1", unit, lambda z: backscatter(z, fit.at(z))),
        _chart(fit, "Share of light kept T_D(z)", unit, lambda z: transmittances(z, fit.at(z))[0]),
        tuple(_table(each, rec.metric) for each in (rec.medium_linear, fit) if each is not None),
        attenuation_is_a_guess(fit),
        _colors(fit),
        unit,
        _light_note(fit),
    )


def _light_note(fit: MediumFit) -> str:
    """The light of the dive, where it is a lamp's, with the evidence."""
    if fit.lamp is None:
        return ""
    told = "given by --light"
    if (evidence := fit.light) is not None:
        told = f"{evidence.explained:.0%} of what distance leaves of the light of {evidence.points:,} points stays with"
        told += f" their place in the image, which changes it by {evidence.change:.0%}"
        if evidence.fall_off is not None:
            told += f"; it falls with distance to the power of {evidence.fall_off:.1f}"
            told += "" if evidence.fall_off_std is None else f" ± {evidence.fall_off_std:.1f}"
    return f"The dive is lit by a lamp on the camera ({told}). Colors without the water are evenly lit."


def _colors(fit: MediumFit) -> str:
    if not attenuation_is_a_guess(fit):
        return "without the water"
    return "as filmed" if fit.lamp is None else "evenly lit in the hue as filmed"


def restored_as(fit: MediumFit) -> str:
    """The difference between restored and filmed frames, which depends on the knowledge of the water."""
    if attenuation_is_a_guess(fit):
        return f"{'left ' if fit.lamp is None else ''}{_colors(fit)}: the water is not determined"
    balance = "white-balanced for display" if any_determined(fit) else "of a hue between that as filmed and gray"
    return f"without the water, {balance}"


def _table(fit: MediumFit, metric: bool) -> Table:
    """The coefficients of one fit with their standard deviations."""
    rate = "1/m" if metric else "1 / scene unit"
    rows = []
    for name, label in _LABELS.items():
        values, errors = getattr(fit, name).tolist(), getattr(fit.std, name).tolist()
        known = fit.identifiable[name].tolist()
        cells = tuple(Cell(_with_std(v, e), k) for v, e, k in zip(values, errors, known, strict=True))
        rows.append((label, "0 to 1" if name == "Binf" else rate, cells))
    title = (
        "In linear light, for tables" if fit.encoding == "linear" else "On stored pixel values, as images are restored"
    )
    return Table(title, tuple(rows))


def _with_std(value: float, std: float) -> str:
    """A number with two digits of its standard deviation, which may lie orders of magnitude apart between scenes."""
    places = min(max(1 - math.floor(math.log10(std)), 2), 5) if std > 0 else 3
    return f"{value:.{places}f} \u00b1 {std:.{places}f}"


def _chart(fit: MediumFit, label: str, unit: str, law: Callable[[Tensor], Tensor]) -> str:
    z = torch.linspace(0, fit.z_range[1] * 1.25, 60)
    values = law(z).numpy()
    curves = [
        charts.Curve(z.numpy(), values[:, c], charts.CHANNEL_COLORS[c], charts.CHANNELS[c], fit.z_range[1])
        for c in range(3)
    ]
    return charts.line_chart(curves, f"distance from the camera z, {unit}", label)
