"""Line charts as inline SVG in the colors of the page: they need no script and no network."""

import math
from dataclasses import dataclass
from html import escape

import numpy as np

CHANNELS = ("red", "green", "blue")
CHANNEL_COLORS = ("var(--red)", "var(--green)", "var(--blue)")  # of the page, which has others for the dark
_LEFT, _RIGHT, _TOP, _BOTTOM = 60, 26, 34, 44
_LETTER = 6.6  # width of one at the font size of the charts


@dataclass(frozen=True)
class Curve:
    """One line of a chart; `solid_until` is the x beyond which it is extrapolated and drawn dashed."""

    x: np.ndarray
    y: np.ndarray
    color: str
    label: str
    solid_until: float = math.inf


@dataclass(frozen=True)
class _Axes:
    """The mapping of values to the pixels of a drawing."""

    width: int
    height: int
    x_max: float
    y_max: float

    def px(self, x: float) -> float:
        return _LEFT + x / self.x_max * (self.width - _LEFT - _RIGHT)

    def py(self, y: float) -> float:
        return self.height - _BOTTOM - y / self.y_max * (self.height - _TOP - _BOTTOM)


def line_chart(curves: list[Curve], x_label: str, y_label: str, width: int = 460, height: int = 290) -> str:
    """An SVG of curves over common axes that start at 0, with a legend and ticks at round values."""
    x_max = max(float(c.x.max()) for c in curves)
    y_max = max(max(float(c.y.max()) for c in curves), 1e-3) * 1.05
    axes = _Axes(width, height, x_max or 1.0, y_max)
    described = f"{y_label} over {x_label}: " + ", ".join(c.label for c in curves)
    parts = [f'<svg class="chart" viewBox="0 0 {width} {height}" role="img" aria-label="{escape(described)}">']
    parts += _grid(axes)
    for curve in curves:
        parts += _polylines(curve, axes)
    parts += _legend(curves, axes)
    parts.append(_text((_LEFT + width - _RIGHT) / 2, height - 8, x_label, "middle"))
    middle = (_TOP + height - _BOTTOM) / 2
    parts.append(f'<g transform="rotate(-90 14 {middle:.1f})">{_text(14, middle, y_label, "middle")}</g></svg>')
    return "".join(parts)


def ticks(largest: float) -> list[float]:
    """Three to six round values from 0 up to `largest`."""
    step = 10 ** math.floor(math.log10(largest / 2))
    step *= next(m for m in (1, 2, 5, 10) if largest / (step * m) <= 5.5)
    return [round(float(step * i), 10) for i in range(int(largest / step + 1e-9) + 1)]


def _grid(axes: _Axes) -> list[str]:
    parts, low, left = [], axes.height - _BOTTOM, _LEFT
    for tick in ticks(axes.x_max):
        x = axes.px(tick)
        parts += [_line(x, _TOP, x, low), _text(x, low + 17, f"{tick:,g}", "middle")]
    for tick in ticks(axes.y_max):
        y = axes.py(tick)
        parts += [_line(left, y, axes.width - _RIGHT, y), _text(left - 7, y + 4, f"{tick:,g}", "end")]
    return parts


def _polylines(curve: Curve, axes: _Axes) -> list[str]:
    """The solid part of a curve, and the dashed one where there is any."""
    seen, parts = curve.x <= curve.solid_until, []
    for part, dash in ((seen, ""), (~seen | _boundary(seen), ' stroke-dasharray="3 4" opacity=".7"')):
        xy = zip(curve.x[part].tolist(), curve.y[part].tolist(), strict=True)
        points = " ".join(f"{axes.px(x):.1f},{axes.py(y):.1f}" for x, y in xy)
        if points and (not dash or not seen.all()):
            parts.append(
                f'<polyline points="{points}" fill="none" style="stroke:{curve.color}" stroke-width="2"{dash}/>'
            )
    return parts


def _legend(curves: list[Curve], axes: _Axes) -> list[str]:
    """A sample of each line with its name, and of the dashed one where a curve has any, above the drawing."""
    entries = [(curve.label, curve.color, "") for curve in curves]
    if any(curve.x.max() > curve.solid_until for curve in curves):
        entries.append(("beyond the depths seen", "currentColor", ' stroke-dasharray="3 4"'))
    parts, x = [], float(_LEFT)
    for label, color, dash in entries:
        parts.append(f'<path d="M{x:.0f} 14h18" style="stroke:{color}" stroke-width="2.5"{dash}/>')
        parts.append(_text(x + 23, 18, label, "start"))
        x += 23 + _LETTER * len(label) + 16
    return parts


def _boundary(seen: np.ndarray) -> np.ndarray:
    """The last solid sample, so that the dashed part starts where the solid one ends."""
    last = np.zeros_like(seen)
    if seen.any():
        last[np.flatnonzero(seen)[-1]] = True
    return last


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _line(x0: float, y0: float, x1: float, y1: float) -> str:
    return f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"/>'
