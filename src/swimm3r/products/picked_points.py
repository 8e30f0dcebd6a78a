"""Points that are measured between, each with its covariance: a pixel of a frame, or map coordinates.

A pixel (FRAME:x,y) is on the surface that the frame's depth map shows there. Along its ray it is as uncertain as the
depth maps of other frames disagree about that place, across it by one pixel. Map coordinates without a height (@x,y)
take it from elevation.tif, with that map's standard deviation; with one (@x,y,z) they are exact.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from swimm3r.cameras import directions, project
from swimm3r.errors import InputError, UsageError
from swimm3r.products.habitat.tables import Lattice, sampled
from swimm3r.products.survey import Survey

CLICK = 1.0  # pixel, standard deviation of a place picked in an image
_AROUND = 1.5  # pixels from a picked one, within which depth is taken where the pixel itself has none
_AGREE = 0.15  # of the depth: beyond it, another frame's depth map shows another surface
_MAD = 1.4826
_LEAST_OTHERS = 2
_HINT = "FRAME:x,y for a pixel of a frame (0010.png:120.5,80), @x,y or @x,y,z for map coordinates"


@dataclass(frozen=True)
class PickedPoint:
    """A place, local, and its covariance."""

    text: str
    xyz: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    known: bool  # whether the covariance is all that is uncertain about it, but for the scale
    others: int  # depth maps that its uncertainty was taken from


def picked(survey: Survey, text: str, heights: Lattice | None) -> PickedPoint:
    """The point that a text names. Raises UsageError where it names none, InputError where nothing was measured."""
    if text.startswith("@"):
        return _on_map(survey, text, heights)
    name, colon, place = text.rpartition(":")
    if not colon:
        raise _no_point(text, "it names neither a frame nor map coordinates")
    if name not in survey.rec.names:
        raise UsageError(
            f"{name} is no frame with a pose",
            cause="a slip in the name, or a frame held back for testing, or not registered",
            hint=f"one of {', '.join(survey.rec.names[:3])}, ... ({len(survey.rec.names)} frames)",
        )
    return _in_frame(survey, text, survey.rec.index(name), np.array(_numbers(text, place, (2,))))


def _in_frame(survey: Survey, text: str, i: int, pixel: Float[np.ndarray, "2"]) -> PickedPoint:
    camera = survey.rec.cameras[i]
    if not (0 <= pixel[0] <= camera.width and 0 <= pixel[1] <= camera.height):
        raise _no_point(text, f"the frame has {camera.width} x {camera.height} pixels")
    z = _depth_at(survey, text, i, pixel)
    ray = directions(camera, torch.from_numpy(pixel)[None, None])[0, 0].double().numpy()
    pose = camera.cam2world[0].double().numpy()
    xyz = survey.place.to_local(pose[:3, :3] @ (ray * z) + pose[:3, 3])
    along = xyz - survey.centers[i]
    distance = float(np.linalg.norm(along))
    along /= distance
    disagreement = _disagreement(survey, i, xyz)
    focal = math.sqrt(float(camera.K[0, 0, 0] * camera.K[0, 1, 1]))
    across = CLICK * z * survey.scale / focal
    spread, others = disagreement if disagreement is not None else (0.0, 0)
    toward = np.outer(along, along)
    covariance = (spread * distance) ** 2 * toward + across**2 * (np.eye(3) - toward)
    return PickedPoint(text, xyz, covariance, disagreement is not None, others)


def _depth_at(survey: Survey, text: str, i: int, pixel: Float[np.ndarray, "2"]) -> float:
    """Median of the depths at and close to a pixel, in the unit of the run."""
    stored = survey.rec.depth[survey.rec.names[i]].z_depth.numpy() if i in survey.indices else np.zeros((1, 1))
    camera = survey.rec.cameras[i]
    scale = np.array([stored.shape[1] / camera.width, stored.shape[0] / camera.height])
    at = pixel * scale - 0.5
    row, column = np.indices(stored.shape)
    known = (stored > 0) & (np.hypot(column - at[0], row - at[1]) <= _AROUND)
    if not known.any():
        measured = np.argwhere(stored > 0)
        near = ""
        if len(measured):
            row, column = measured[np.hypot(measured[:, 1] - at[0], measured[:, 0] - at[1]).argmin()]
            x, y = (np.array([column, row]) + 0.5) / scale
            near = f"; the nearest pixel with depth is {survey.rec.names[i]}:{x:.1f},{y:.1f}"
        raise InputError(
            f"no depth was measured at {text}",
            cause="no second frame confirmed the surface there, or it is open water",
            hint=f"the same place in another frame{near}",
        )
    return float(np.median(stored[known]))


def _disagreement(survey: Survey, i: int, xyz: Float[np.ndarray, "3"]) -> tuple[float, int] | None:
    """Relative standard deviation of depth at a place, by the depth maps of other frames, and how many they are."""
    world = torch.from_numpy(survey.place.from_local(xyz)).reshape(1, 1, 3)
    found = []
    for k in survey.indices:
        if k == i:
            continue
        camera = survey.rec.cameras[k]
        at, z = project(camera, world)
        (x, y), depth = at[0, 0].tolist(), float(z)
        if not (depth > 0 and 0 <= x < camera.width and 0 <= y < camera.height):
            continue
        stored = survey.rec.depth[survey.rec.names[k]].z_depth
        row, column = int(y * stored.shape[0] / camera.height), int(x * stored.shape[1] / camera.width)
        other = float(stored[row, column])
        if other > 0 and abs(other / depth - 1) < _AGREE:
            found.append(other / depth - 1)
    if len(found) < _LEAST_OTHERS:
        return None
    return _MAD * float(np.median(np.abs(found))), len(found)


def _on_map(survey: Survey, text: str, heights: Lattice | None) -> PickedPoint:
    place = survey.place
    given = _numbers(text, text[1:], (2, 3))
    xy = (np.array(given[:2]) - place.origin[:2]) / place.grid_scale
    if len(given) == 3:
        return PickedPoint(text, np.array([*xy, given[2] - place.origin[2]]), np.zeros((3, 3)), True, 0)
    if heights is None:
        raise InputError(
            f"{text} has no height, and the run has no elevation map to take it from",
            cause="the map products were not made yet",
            hint=f"swimm3r products {survey.folder}; or @x,y,z",
        )
    height, std = (float(sampled(heights, xy[None], name)[0]) for name in ("elevation", "elevation_std"))
    if math.isnan(height):
        raise InputError(
            f"no height was measured at {text}",
            cause="the place lies in a hole or outside of the map",
            hint="a place inside the map: RUN/products/preview_elevation.png shows it",
        )
    covariance = np.diag([heights.spacing**2 / 12] * 2 + [0.0 if math.isnan(std) else std**2])
    return PickedPoint(text, np.array([*xy, height - place.origin[2]]), covariance, not math.isnan(std), 0)


def _numbers(text: str, place: str, counts: tuple[int, ...]) -> list[float]:
    try:
        found = [float(value) for value in place.split(",")]
    except ValueError as error:
        raise _no_point(text, "its coordinates are no numbers") from error
    if len(found) not in counts or not all(math.isfinite(value) for value in found):
        raise _no_point(text, f"it has {len(found)} coordinates" if len(found) not in counts else "one is not finite")
    return found


def _no_point(text: str, why: str) -> UsageError:
    return UsageError(f"{text!r} is no point to measure: {why}", cause="a slip in the command", hint=_HINT)
