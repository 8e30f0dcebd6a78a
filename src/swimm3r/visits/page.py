"""OUT/visits.html: sliders between two visits, the site as a whole, its changed places, and views of the maps.

The page asks no network. Orthophotos are without the water and in the light of the first visit. Where both runs have a
map, the same camera renders both.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from markupsafe import Markup
from scipy import ndimage

from swimm3r.io import images
from swimm3r.io.files.atomic import write_text
from swimm3r.report.style import page_template, style_sheet
from swimm3r.rounding import rounded
from swimm3r.visits.change import LESS, MORE, Change
from swimm3r.visits.places import Place
from swimm3r.visits.record import ChangeRecord, VisitsRecord, change_lines

PAGE = "visits.html"
COLORS = {"gained": (230, 57, 70), "lost": (58, 110, 222), "paler": (255, 209, 102), "darker": (46, 160, 90)}
_LONG_SIDE, _QUALITY = 1100, 86
_CLOSE_UPS = 8  # of the largest places
_ROWS = 30  # of the table of places; all are in places.csv
_AROUND = 1.0  # widths of a place around it in a close-up
_LEAST_SIDE = 60  # cells of a close-up
_PAPER = 244  # gray level of unknown ground
_COLUMNS = ("kind", "area", "height", "volume", "color", "significance")


@dataclass(frozen=True)
class Shown:
    """One stop of a slider."""

    caption: str
    views: tuple[tuple[str, str, str], ...]  # kind (raw, after, change), data URI, alternative text


@dataclass(frozen=True)
class Pair:
    """One change as the page shows it."""

    record: ChangeRecord
    lines: tuple[str, ...]
    shown: tuple[Shown, ...]
    rows: tuple[tuple[str, ...], ...]


def pair(
    record: ChangeRecord,
    places: Sequence[Place],
    orthophotos: tuple[UInt8[np.ndarray, "4 h w"], UInt8[np.ndarray, "4 h w"]],
    change: Change,
    views: Sequence[tuple[str, UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w 3"]]],
    whole: VisitsRecord,
) -> Pair:
    """The stops of a change: the site, its largest places, and rendered views.

    `views` are captions with what both maps show to the same camera.
    """
    before, after = (_on_paper(image) for image in orthophotos)
    over = overlay(after, change)
    unit = whole.unit
    stops = [_stop(f"The site, {record.earlier} and {record.later}", (before, after, over))]
    west, north, step = whole.west, whole.north, whole.gsd
    for each in places[:_CLOSE_UPS]:
        column, row = (each.x - west) / step, (north - each.y) / step
        half = max(_LEAST_SIDE / 2, (0.5 + _AROUND) * float(np.sqrt(each.area)) / step)
        box = tuple(
            slice(max(0, int(at - half)), min(size, int(at + half) + 1))
            for at, size in zip((row, column), before.shape[:2], strict=True)
        )
        stops.append(_stop(f"Place {each.number}, {each.kind}", (before[box], after[box], over[box])))
    stops += [_stop(caption, (first, second)) for caption, first, second in views]
    lines = tuple(line.strip() for line in change_lines(record, unit, whole.threshold))
    return Pair(record, lines, tuple(stops), tuple(_row(each, unit) for each in places[:_ROWS]))


def overlay(image: UInt8[np.ndarray, "h w 3"], change: Change) -> UInt8[np.ndarray, "h w 3"]:
    """The later orthophoto, pale and gray, with changed places in color and outlined; unknown ground white."""
    gray = image.astype(np.float64).mean(-1, keepdims=True)
    shown = np.repeat(150 + 0.4 * gray, 3, -1)
    masks = [kind == code for kind in (change.height_kind, change.color_kind) for code in (MORE, LESS)]
    for name, mask in reversed(list(zip(COLORS, masks, strict=True))):  # heights above colors
        edge = mask & np.logical_not(ndimage.binary_erosion(mask))
        shown[mask] = 0.45 * shown[mask] + 0.55 * np.array(COLORS[name])
        shown[edge] = np.array(COLORS[name])
    shown[~change.comparable] = _PAPER
    return np.clip(shown, 0, 255).astype(np.uint8)


def write_page(record: VisitsRecord, pairs: Sequence[Pair], folder: Path) -> Path:
    """Write visits.html, whole or not at all, and return its path."""
    template = page_template(files("swimm3r.visits").joinpath("visits.html.j2").read_text(encoding="utf-8"))
    script = files("swimm3r.report").joinpath("page.js").read_text(encoding="utf-8")
    page = template.render(
        title=", ".join(visit.name for visit in record.visits),
        record=record,
        pairs=pairs,
        verdict=_verdict(record),
        legend=[(name, "#{:02x}{:02x}{:02x}".format(*color)) for name, color in COLORS.items()],
        columns=_COLUMNS,
        version=version("swimm3r"),
        style=Markup(style_sheet()),
        script=Markup(script),
    )
    write_text(folder / PAGE, page)
    return folder / PAGE


def _stop(caption: str, views: Sequence[np.ndarray]) -> Shown:
    names = (("raw", "before"), ("after", "after"), ("change", "changes"))[: len(views)]
    return Shown(
        caption,
        tuple(
            (kind, images.jpeg_uri(_enlarged(view), _LONG_SIDE, _QUALITY), f"{caption}: {word}")
            for (kind, word), view in zip(names, views, strict=True)
        ),
    )


def _on_paper(rgba: UInt8[np.ndarray, "4 h w"]) -> UInt8[np.ndarray, "h w 3"]:
    return np.where(rgba[3, ..., None] > 0, rgba[:3].transpose(1, 2, 0), _PAPER).astype(np.uint8)


def _enlarged(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """A close-up with cells that a page shows as more than one pixel."""
    times = max(1, round(480 / max(image.shape[:2])))
    return image.repeat(times, 0).repeat(times, 1)


def _with_std(value: float | None, std: float | None, unit: str) -> str:
    if value is None or std is None:
        return ""
    return f"{rounded(value, 3, sign=True)} ± {rounded(std, 1)} {unit}"


def _row(place: Place, unit: str) -> tuple[str, ...]:
    height = _with_std(place.height, place.height_std, unit)
    volume = _with_std(place.volume, place.volume_std, f"{unit}³")
    color = "" if place.color is None else f"{place.color:.1f}, L* {place.lightness:+.1f}"
    return (
        f"{place.number}", place.kind, f"{rounded(place.area, 3)} {unit}²", height, volume, color,
        f"{place.significance:.1f}",
    )  # fmt: skip


def _verdict(record: VisitsRecord) -> str:
    told = [f"{len(record.visits)} visits in one frame"]
    for change in record.changes:
        told.append(
            f"{change.places} changed place{'s' * (change.places != 1)} from {change.earlier} to {change.later}"
        )
    return f"{'; '.join(told)}."
