"""Charts as inline SVG and images that show depth or the path: the page needs no script and no network."""

import math
from dataclasses import dataclass

import cv2
import numpy as np

CHANNELS = ("#d6453d", "#2f9e57", "#2f6fd6")  # R, G, B curves
_INK = "#51646f"
_UNKNOWN = (221, 215, 210)  # BGR of pixels without depth


@dataclass(frozen=True)
class Curve:
    """One line of a chart; `solid_until` is the x beyond which it is extrapolated and drawn dashed."""

    x: np.ndarray
    y: np.ndarray
    color: str
    label: str
    solid_until: float = math.inf


def line_chart(curves: list[Curve], x_label: str, y_label: str, width: int = 420, height: int = 260) -> str:
    """An SVG of curves over common axes, with ticks at round values."""
    left, right, top, bottom = 46, 12, 12, 40
    x_max = max(float(c.x.max()) for c in curves)
    y_max = max(max(float(c.y.max()) for c in curves), 1e-3) * 1.05

    def px(x: float) -> float:
        return left + x / x_max * (width - left - right)

    def py(y: float) -> float:
        return height - bottom - y / y_max * (height - top - bottom)

    parts = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{y_label} over {x_label}">']
    for tick in ticks(x_max):
        parts.append(_text(px(tick), height - bottom + 16, f"{tick:g}", "middle"))
        parts.append(_line(px(tick), top, px(tick), height - bottom))
    for tick in ticks(y_max):
        parts.append(_text(left - 6, py(tick) + 4, f"{tick:g}", "end"))
        parts.append(_line(left, py(tick), width - right, py(tick)))
    for curve in curves:
        seen = curve.x <= curve.solid_until
        for part, dash in ((seen, ""), (~seen | _boundary(seen), ' stroke-dasharray="3 4" opacity=".6"')):
            xy = zip(curve.x[part].tolist(), curve.y[part].tolist(), strict=True)
            points = " ".join(f"{px(x):.1f},{py(y):.1f}" for x, y in xy)
            parts.append(f'<polyline points="{points}" fill="none" stroke="{curve.color}" stroke-width="2"{dash}/>')
    parts.append(_text((left + width - right) / 2, height - 6, x_label, "middle"))
    parts.append(
        f'<text x="12" y="{(height - bottom) / 2}" text-anchor="middle" fill="{_INK}" font-size="12" '
        f'transform="rotate(-90 12 {(height - bottom) / 2})">{y_label}</text></svg>'
    )
    return "".join(parts)


def ticks(largest: float) -> list[float]:
    """Three to six round values from 0 up to `largest`."""
    step = 10 ** math.floor(math.log10(largest / 2))
    step *= next(m for m in (1, 2, 5, 10) if largest / (step * m) <= 5.5)
    return [round(float(step * i), 10) for i in range(int(largest / step + 1e-9) + 1)]


def depth_image(z_depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Depth in colors, RGB uint8: near warm, far cold, gray where nothing is known; even steps in inverse depth."""
    known = z_depth > 0
    inverse = (1 / np.maximum(z_depth, 1e-9) - 1 / far) / max(1 / near - 1 / far, 1e-12)
    colors = cv2.applyColorMap((inverse.clip(0, 1) * 255).astype(np.uint8), cv2.COLORMAP_TURBO)
    colors[~known] = _UNKNOWN
    return colors[..., ::-1]


@dataclass(frozen=True)
class PlanView:
    """A cloud and a camera path seen along the least-extended direction: RGB uint8 images and the path in pixels."""

    raw: np.ndarray
    restored: np.ndarray
    path: np.ndarray  # [c, 2]
    units_per_pixel: float


def plan_view(
    xyz: np.ndarray, raw: np.ndarray, restored: np.ndarray, cam2world: np.ndarray, width: int = 760
) -> PlanView:
    """The cloud from above, where "above" is against the mean viewing direction, with the camera path over it."""
    down = cam2world[:, :3, 2].mean(0)
    down /= np.linalg.norm(down)
    forward = np.linalg.svd((cam2world[:, :3, 3] - cam2world[:, :3, 3].mean(0)) @ (np.eye(3) - np.outer(down, down)))[2]
    along = forward[0] - down * (forward[0] @ down)
    along /= np.linalg.norm(along)
    axes = np.stack([along, np.cross(down, along)])
    flat, centers = xyz @ axes.T, cam2world[:, :3, 3] @ axes.T
    low = np.minimum(np.quantile(flat, 0.01, axis=0), centers.min(0))
    high = np.maximum(np.quantile(flat, 0.99, axis=0), centers.max(0))
    low, high = low - 0.03 * (high - low), high + 0.03 * (high - low)
    units = float((high - low)[0] / width)
    height = int(np.clip((high - low)[1] / units, 120, 1.2 * width))
    cells = ((flat - low) / units).astype(int)
    inside: np.ndarray = np.all((cells >= 0) & (cells < (width, height)), axis=1)
    order = np.argsort(-(xyz @ down))  # what is nearer to the camera is painted last
    order = order[inside[order]]
    images = []
    for colors in (raw, restored):
        canvas = np.full((height, width, 3), 255, np.uint8)
        canvas[cells[order, 1], cells[order, 0]] = (colors[order].clip(0, 1) * 255).astype(np.uint8)
        images.append(_fill_pinholes(canvas))
    return PlanView(images[0], images[1], (centers - low) / units, units)


def path_overlay(view: PlanView) -> str:
    """An SVG layer for a plan view: the camera path, its start, and a scale bar in scene units."""
    height, width = view.restored.shape[:2]
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in view.path)
    bar = next(t for t in (ticks(width * view.units_per_pixel / 4)[::-1]) if t > 0)
    length = bar / view.units_per_pixel
    dots = "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.5" fill="#fff" stroke="#08384a"/>' for x, y in view.path)
    return (
        f'<svg class="overlay" viewBox="0 0 {width} {height}">'
        f'<polyline points="{points}" fill="none" stroke="#08384a" stroke-width="4" opacity=".55"/>'
        f'<polyline points="{points}" fill="none" stroke="#ffd166" stroke-width="2"/>{dots}'
        f'<circle cx="{view.path[0, 0]:.1f}" cy="{view.path[0, 1]:.1f}" r="6" fill="#ffd166" stroke="#08384a"/>'
        f'<path d="M14 {height - 16} h{length:.1f}" stroke="#08384a" stroke-width="4"/>'
        f'<text x="14" y="{height - 24}" font-size="15" fill="#08384a">{bar:g}</text></svg>'
    )


def _fill_pinholes(canvas: np.ndarray) -> np.ndarray:
    """Cells that no point fell into take their neighbors' color, so that a plan view is no lattice of dots."""
    empty = (canvas == 255).all(2)
    closed = cv2.erode(canvas, np.ones((3, 3), np.uint8))
    canvas[empty] = closed[empty]
    return canvas


def _boundary(seen: np.ndarray) -> np.ndarray:
    """The last solid sample, so that the dashed part starts where the solid one ends."""
    last = np.zeros_like(seen)
    if seen.any():
        last[np.flatnonzero(seen)[-1]] = True
    return last


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{_INK}" font-size="12">{text}</text>'


def _line(x0: float, y0: float, x1: float, y1: float) -> str:
    return f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="#e3eaed"/>'
