"""Frames on the page, as data URIs: as filmed, without the water, as the map shows them, and their depth in colors."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from swimm3r.imaging.depth_colors import depth_image, depth_scale, depth_span
from swimm3r.io import images
from swimm3r.io.view_names import view_stems
from swimm3r.report.head import caption
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction

_SHOWN_FRAMES = 8
_SHOWN_TESTS = 4
_SHOWN_MOVING = 6
_MOVING = np.array([255.0, 40.0, 40.0])  # color of moving objects
_LONG_SIDE = 720  # pixels
_QUALITY = 82
_STEPS = 17  # colors of the bar
_NUMBERS = (0.0, 0.25, 0.5, 0.75, 1.0)  # places on the bar that carry one


@dataclass(frozen=True)
class View:
    """One image of a frame; `kind` is raw, restored, rgb, clear or depth."""

    kind: str
    uri: str
    alt: str


@dataclass(frozen=True)
class ShownFrame:
    """A frame with its views, the one as filmed first."""

    caption: str
    views: tuple[View, ...]


@dataclass(frozen=True)
class DepthBar:
    """The colors of depth as a CSS gradient, and depths at even places along it."""

    gradient: str
    numbers: tuple[str, ...]
    unit: str


def depth_limits(rec: Reconstruction) -> tuple[float, float] | None:
    """The z depths that are red and blue on the page; None where no depth is known."""
    depths = rec.point_depths() if len(rec.points.xyz) else None
    return None if depths is None or not len(depths) else depth_span(depths)


def depth_bar(near_far: tuple[float, float], metric: bool) -> DepthBar:
    """The bar for images between these depths."""
    colors, _ = depth_scale(*near_far, _STEPS)
    stops = ", ".join("rgb({}, {}, {})".format(*color) for color in colors.tolist())
    _, depths = depth_scale(*near_far, len(_NUMBERS))
    return DepthBar(
        f"linear-gradient(90deg, {stops})",
        tuple(f"{depth:.3g}" if depth < 100 else f"{depth:,.0f}" for depth in depths),
        "metres" if metric else "scene units",
    )


def dive_frames(
    rec: Reconstruction, frames: Frames, folder: Path, near_far: tuple[float, float] | None, restored_as: str
) -> list[ShownFrame]:
    """A few registered frames, evenly spread over the dive."""
    found = []
    for name in _spread(rec.names, _SHOWN_FRAMES):
        views = [View("raw", _uri(filmed(frames, name)), f"{name} as filmed")]
        restored = folder / "sfm" / "restored" / f"{name}.png"
        if restored.is_file():
            views.append(View("restored", _uri(images.read_rgb(restored)), f"{name} {restored_as}"))
        if near_far is not None and name in rec.depth:
            colors = depth_image(rec.depth[name].z_depth.numpy(), *near_far)
            views.append(View("depth", _uri(colors), f"depth of {name} in colors"))
        found.append(ShownFrame(caption(frames, name), tuple(views)))
    return found


def moving_objects(rec: Reconstruction, frames: Frames) -> list[ShownFrame]:
    """A few of the frames with moving objects, evenly spread over the dive, and these in color."""
    if rec.moving is None:
        return []
    shares = dict(rec.moving.shares(frames))
    masked, found = rec.moving.on(frames), []
    for name in _spread(tuple(shares), _SHOWN_MOVING):
        f = frames.index(name)
        image, moving = filmed(frames, name), (frames.mask(f) & ~masked.mask(f)).numpy()
        image[moving] = (0.5 * image[moving] + 0.5 * _MOVING).round().astype(np.uint8)
        view = View("raw", _uri(image), f"moving objects in {name}")
        found.append(ShownFrame(f"{caption(frames, name)}: {shares[name]:.1%}", (view,)))
    return found


def frames_only(frames: Frames) -> list[ShownFrame]:
    """A few frames as filmed, for a run without structure from motion."""
    chosen = _spread(frames.names, _SHOWN_FRAMES)
    return [
        ShownFrame(caption(frames, name), (View("raw", _uri(filmed(frames, name)), f"{name} as filmed"),))
        for name in chosen
    ]


def test_frames(frames: Frames, folder: Path, unplaced: Sequence[str]) -> list[ShownFrame]:
    """A few test frames, evenly spread, beside the views of the map from there; `unplaced` ones have none."""
    found, stems = [], view_stems(frames.names)
    alts = {"rgb": "as the map renders it", "clear": "as the map renders it without the water", "z_depth": "depth"}
    placed = tuple(name for name in frames.test.names if name not in unplaced)
    for name in _spread(placed, _SHOWN_TESTS):
        views = [View("raw", _uri(filmed(frames, name)), f"{name} as filmed")]
        for kind, alt in alts.items():
            image = images.read_rgb(folder / "renders" / "test" / f"{stems[name]}_{kind}.png")
            views.append(View("depth" if kind == "z_depth" else kind, _uri(image), f"{name} {alt}"))
        found.append(ShownFrame(caption(frames, name), tuple(views)))
    return found


def _spread(names: tuple[str, ...], most: int) -> list[str]:
    return [names[k] for k in sorted({round(i) for i in np.linspace(0, len(names) - 1, most)})] if names else []


def filmed(frames: Frames, name: str) -> np.ndarray:
    """A frame as filmed, 8-bit RGB."""
    return (frames.image(frames.index(name)).numpy() * 255).round().astype(np.uint8)


def _uri(image: np.ndarray) -> str:
    return images.jpeg_uri(image, _LONG_SIDE, _QUALITY)
