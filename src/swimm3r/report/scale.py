"""The section on unit and place: every source with its residual, and the water in 1/m with what is derived from it."""

import math
from dataclasses import dataclass
from typing import Any

_CHANNELS = ("red", "green", "blue")


@dataclass(frozen=True)
class SourceRow:
    """One source of scale."""

    name: str
    scale: str
    residual: str
    in_std: str
    detail: str
    outlier: bool


@dataclass(frozen=True)
class Scale:
    """Everything that the section shows."""

    lead: str
    rows: tuple[SourceRow, ...]
    lines: tuple[str, ...]


@dataclass(frozen=True)
class MetricWater:
    """Rows of a label, a unit and three cells, which may stand in brackets; and sentences on what is derived."""

    title: str
    rows: tuple[tuple[str, str, tuple[str, ...]], ...]
    lines: tuple[str, ...]


def scale_section(summary: dict[str, Any]) -> Scale | None:
    """Unit and place of a run; None where nothing tells them."""
    scale = summary.get("scale")
    if scale is None:
        return None
    total, std = scale["metres_per_unit"], scale["std"]
    used = sum(not source["outlier"] for source in scale["sources"])
    lead = (
        f"A unit of structure from motion is {plus_minus(total, total * std)} m ({_percent(std)} of standard"
        f" deviation), by {used} source{'s' * (used != 1)}; all files are in metres."
    )
    rows = tuple(
        SourceRow(
            each["source"],
            plus_minus(each["scale"], each["scale"] * each["std"]),
            f"{100 * each['residual']:+.2f} %",
            f"{each['residual_in_std']:+.1f}",
            each["detail"],
            each["outlier"],
        )
        for each in scale["sources"]
    )
    return Scale(lead, rows, (*_place_lines(scale), *scale["notes"]))


def _place_lines(scale: dict[str, Any]) -> list[str]:
    lines = []
    place = scale["georeference"]
    if place["origin_std_m"] is not None:
        east, north, height = (
            plus_minus(value, std) for value, std in zip(place["origin_m"], place["origin_std_m"], strict=True)
        )
        lines.append(f"Origin of the coordinates in {place['crs']}: east {east} m, north {north} m, height {height} m.")
    if "navigation" in scale:
        navigation = scale["navigation"]
        told = f"Distance of the cameras from the navigation: {navigation['rms_m']:.3g} m root mean square over"
        lines.append(f"{told} {navigation['positions']} positions, {navigation['outliers']} of them outliers.")
        if navigation["offset_std_s"] is not None:
            offset = plus_minus(abs(navigation["offset_s"]), navigation["offset_std_s"])
            side = "ahead of" if navigation["offset_s"] >= 0 else "behind"
            lines.append(f"The clock of the navigation is {offset} s {side} that of the frames, as estimated.")
    for role, name in (("control", "control_rms_m"), ("check", "check_rms_m")):
        if scale.get("control", {}).get(name) is not None:
            lines.append(f"Residual at {role} points: {scale['control'][name]:.3g} m root mean square.")
    return lines


def metric_water(summary: dict[str, Any]) -> MetricWater | None:
    """The water of a run in metres; None where its unit is not known."""
    water = summary.get("water")
    if water is None:
        return None
    known = water["beta_D"]["identifiable"]
    rows = [
        (
            f"beta_D at {at['range_m']:g} m" + ("" if at["within_data"] else ", beyond the frames' distances"),
            "1/m",
            _cells(at["value"], at["std"], known),
        )
        for at in water["beta_D_at"]
    ]
    rows.append(
        ("beta_B", "1/m", _cells(water["beta_B"]["value"], water["beta_B"]["std"], water["beta_B"]["identifiable"]))
    )
    derived = water["derived"]
    seen = [
        f"{channel} {plus_minus(value, std)} m"
        for channel, value, std, sure in zip(
            _CHANNELS,
            derived["visibility_m"],
            derived["visibility_std_m"],
            water["beta_B"]["identifiable"],
            strict=True,
        )
        if sure and value is not None
    ]
    lines = [f"Standard deviations include that of the scale, {_percent(water['scale_std'])}."]
    if seen:
        lines.append(f"Derived: visibility of {derived['visibility_of']}: {', '.join(seen)}.")
    if derived["jerlov"] is not None:
        lines.append(
            f"Derived: the nearest of Jerlov's water types is {derived['jerlov']}, {derived['jerlov_in_std']:g}"
            f" standard deviations away in {', '.join(derived['jerlov_channels'])}."
        )
    light = "In linear light" if water["encoding"] == "linear" else "On stored pixel values"
    return MetricWater(f"{light}, at distances in metres", tuple(rows), tuple(lines))


def plus_minus(value: float, std: float) -> str:
    """A number with two digits of its standard deviation."""
    if not (std > 0 and math.isfinite(std)):
        return f"{value:.6g}"
    places = min(max(1 - math.floor(math.log10(std)), 0), 9)
    return f"{value:.{places}f} \u00b1 {std:.{places}f}"


def _cells(values: list[float], stds: list[float], known: list[bool]) -> tuple[str, ...]:
    cells = (plus_minus(value, std) for value, std in zip(values, stds, strict=True))
    return tuple(cell if sure else f"({cell})" for cell, sure in zip(cells, known, strict=True))


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"
