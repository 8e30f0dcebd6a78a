"""A cloud seen against the mean viewing direction, with the path of the camera over it."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from swimm3r.report.charts import ticks

WHITE = (255, 255, 255)
_INK, _PATH = "#04222d", "#ffd166"
_FLAT = 0.45  # extent along the normal, of that along the middle axis, below which points count as a ground


@dataclass(frozen=True)
class PlanView:
    """A cloud and a camera path seen along the mean viewing direction: RGB uint8 images, and the path in pixels."""

    raw: np.ndarray
    restored: np.ndarray
    path: np.ndarray  # [c, 2]
    units_per_pixel: float


def plan_view(
    xyz: np.ndarray,
    raw: np.ndarray,
    restored: np.ndarray,
    cam2world: np.ndarray,
    width: int = 760,
    background: tuple[int, int, int] = WHITE,
    path: Sequence[int] | slice = slice(None),
) -> PlanView:
    """The cloud from above, where "above" is against the mean viewing direction, with the camera path over it.

    `path` are the cameras that it leads through, in order: those of one camera of a rig.
    """
    down = cam2world[:, :3, 2].mean(0)
    down /= np.linalg.norm(down)
    forward = np.linalg.svd((cam2world[:, :3, 3] - cam2world[:, :3, 3].mean(0)) @ (np.eye(3) - np.outer(down, down)))[2]
    along = max((axis - down * (axis @ down) for axis in forward[:2]), key=lambda axis: np.linalg.norm(axis) > 1e-3)
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
        canvas, painted = np.zeros((height, width, 3), np.uint8), np.zeros((height, width), bool)
        canvas[cells[order, 1], cells[order, 0]] = (colors[order].clip(0, 1) * 255).astype(np.uint8)
        painted[cells[order, 1], cells[order, 0]] = True
        images.append(_without_pinholes(canvas, painted, background))
    return PlanView(images[0], images[1], (centers[path] - low) / units, units)


def path_overlay(view: PlanView, unit: str) -> str:
    """An SVG layer for a plan view: the camera path, its start, and a scale bar with its unit."""
    height, width = view.restored.shape[:2]
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in view.path)
    bar = next(t for t in (ticks(width * view.units_per_pixel / 4)[::-1]) if t > 0)
    length = bar / view.units_per_pixel
    dots = "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.5" fill="#fff" stroke="{_INK}"/>' for x, y in view.path)
    return (
        f'<svg class="overlay" viewBox="0 0 {width} {height}" aria-hidden="true">'
        f'<polyline points="{points}" fill="none" stroke="{_INK}" stroke-width="4" opacity=".55"/>'
        f'<polyline points="{points}" fill="none" stroke="{_PATH}" stroke-width="2"/>{dots}'
        f'<circle cx="{view.path[0, 0]:.1f}" cy="{view.path[0, 1]:.1f}" r="6" fill="{_PATH}" stroke="{_INK}"/>'
        f'<path d="M18 {height - 18} h{length:.1f}" stroke="{_INK}" stroke-width="8" stroke-linecap="round"/>'
        f'<path d="M18 {height - 18} h{length:.1f}" stroke="#fff" stroke-width="4" stroke-linecap="round"/>'
        f'<text x="16" y="{height - 30}" font-size="20" font-weight="600" fill="#fff" stroke="{_INK}" stroke-width="4"'
        f' paint-order="stroke">{bar:g} {unit}</text></svg>'
    )


def least_extended(xyz: np.ndarray) -> np.ndarray | None:
    """The direction in which points extend least; None where they are no ground or wall but a body."""
    low, high = np.quantile(xyz, [0.02, 0.98], axis=0)
    kept = xyz[((xyz >= low) & (xyz <= high)).all(1)].astype(np.float64)
    if len(kept) < 3:
        return None
    _, variances, axes = np.linalg.svd(np.cov((kept - kept.mean(0)).T))
    return axes[2] if variances[2] < _FLAT**2 * variances[1] else None


def _without_pinholes(canvas: np.ndarray, painted: np.ndarray, background: tuple[int, int, int]) -> np.ndarray:
    """Cells that no point fell into take their neighbors' color, so that a plan view is no lattice of dots."""
    spread = cv2.dilate(canvas, np.ones((3, 3), np.uint8))
    near = cv2.dilate(painted.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    filled = np.where(painted[..., None], canvas, spread)
    return np.where(near[..., None], filled, np.array(background, np.uint8))
