"""Images of several methods side by side, each under its name."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from swimm3r.io import images

_HEIGHT = 240  # of one image in the grid, pixels
_BAR, _GAP = 22, 4
_PAPER, _INK = 255, (30, 30, 30)


@dataclass(frozen=True)
class Panel:
    """One image of a grid; None is left white."""

    label: str
    image: UInt8[np.ndarray, "h w 3"] | None


def stored(label: str, path: Path) -> Panel:
    """An image file, or nothing where there is none."""
    if not path.is_file():
        return Panel(label, None)
    rgb = images.read_rgb(path)
    return Panel(label, rgb if rgb.dtype == np.uint8 else (rgb // 257).astype(np.uint8))


def write_grid(path: Path, rows: Sequence[Sequence[Panel]]) -> None:
    """The panels in rows, all of one height."""
    strips = [_strip(row) for row in rows]
    width = max(strip.shape[1] for strip in strips)
    padded = [np.pad(s, ((0, _GAP), (0, width - s.shape[1]), (0, 0)), constant_values=_PAPER) for s in strips]
    images.write_rgb(path, np.concatenate(padded))


def _strip(panels: Sequence[Panel]) -> UInt8[ndarray, "h w 3"]:
    import cv2

    usual = next((p.image.shape for p in panels if p.image is not None), (_HEIGHT, _HEIGHT, 3))
    parts = []
    for panel in panels:
        height, width = (usual if panel.image is None else panel.image.shape)[:2]
        size = (max(1, round(width * _HEIGHT / height)), _HEIGHT)
        part = np.full((_HEIGHT + _BAR, size[0], 3), _PAPER, np.uint8)
        if panel.image is not None:
            way = cv2.INTER_AREA if height > _HEIGHT else cv2.INTER_LINEAR
            part[_BAR:] = cv2.resize(np.ascontiguousarray(panel.image), size, interpolation=way)
        cv2.putText(part, panel.label, (3, _BAR - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _INK, 1, cv2.LINE_AA)
        parts.append(np.pad(part, ((0, 0), (0, _GAP), (0, 0)), constant_values=_PAPER))
    return np.concatenate(parts, 1)
