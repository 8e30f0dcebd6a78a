"""Coded markers found in frames (ArUco, AprilTag, ChArUco boards), and the scale that their sizes and distances give.

A marker file is YAML, lengths in metres:

    family: aruco-4x4-50
    size: 0.10                    # outer side of the black square of every marker
    sizes: {3: 0.15}              # of single ones
    distances: [[1, 2, 0.80]]     # between the centers of two markers
    board: {columns: 7, rows: 5, square: 0.04, marker: 0.03}      # a ChArUco board instead of single markers
"""

import logging
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras
from swimm3r.errors import InputError
from swimm3r.io.files.damage import Remedy, guard
from swimm3r.io.files.json_file import structure
from swimm3r.medium import linear_from_srgb
from swimm3r.progress import Progress, silent
from swimm3r.scale.marker_registration import registered_corners
from swimm3r.scale.settings import MarkerFamily, ScaleSettings
from swimm3r.scale.solve import ScaleEstimate
from swimm3r.scale.triangulation import ScenePoint, Sighting, scale_of_shape, triangulate_all
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction

log = logging.getLogger(__name__)

_DICTIONARIES: dict[MarkerFamily, str] = {
    "aruco-4x4-50": "DICT_4X4_50",
    "aruco-4x4-250": "DICT_4X4_250",
    "aruco-5x5-250": "DICT_5X5_250",
    "aruco-6x6-250": "DICT_6X6_250",
    "aruco-7x7-250": "DICT_7X7_250",
    "aruco-original": "DICT_ARUCO_ORIGINAL",
    "apriltag-16h5": "DICT_APRILTAG_16h5",
    "apriltag-25h9": "DICT_APRILTAG_25h9",
    "apriltag-36h10": "DICT_APRILTAG_36h10",
    "apriltag-36h11": "DICT_APRILTAG_36h11",
}
_CORNER_PX = 0.1  # standard deviation of a corner's place; 0.01 in rendered frames, without noise and swell
_OFF_PX = 3.0  # mean reprojection error of a corner from which a marker is not one thing at one place
_REMEDY = Remedy(
    "family, size, sizes, distances or board; see docs/guides/metric-scale.md",
    cause="a slip in its name or in its lines",
    fault="cannot be used",
)


@dataclass(frozen=True)
class Board:
    """A ChArUco board; lengths in metres."""

    columns: int
    rows: int
    square: float
    marker: float

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 2 or not 0 < self.marker < self.square:
            raise ValueError("a board has at least 2 x 2 squares, and markers smaller than its squares")


@dataclass(frozen=True)
class MarkerSizes:
    """A marker file."""

    family: MarkerFamily
    size: float | None = None
    sizes: dict[str, float] = field(default_factory=dict)
    distances: tuple[tuple[int, int, float], ...] = ()
    board: Board | None = None

    def __post_init__(self) -> None:
        lengths = [*self.sizes.values(), *(length for _, _, length in self.distances)]
        lengths += [self.size] if self.size is not None else []
        if any(not 0 < length < 1000 for length in lengths):
            raise ValueError("sizes and distances are positive, in metres")
        if not lengths and self.board is None:
            raise ValueError("it states no size, no distance and no board")

    def size_of(self, marker: int) -> float | None:
        """The side of a marker, metres; None where it is not known."""
        return self.sizes.get(str(marker), self.size)


def marker_sizes(settings: ScaleSettings) -> MarkerSizes | None:
    """The markers that are looked for; None for none. Raises InputError for a file that cannot be used."""
    if settings.marker_file is None:
        return None if settings.markers is None else MarkerSizes(settings.markers, settings.marker_size)
    import yaml

    with guard(settings.marker_file, _REMEDY):
        try:
            document: Any = yaml.safe_load(settings.marker_file.read_text(encoding="utf-8"))
        except yaml.YAMLError as error:
            raise ValueError(f"no YAML: {str(error).splitlines()[0]}") from error
        if not isinstance(document, dict):
            raise ValueError("family and sizes are expected")
        document.setdefault("family", settings.markers)
        document.setdefault("size", settings.marker_size)
        document["sizes"] = {str(key): value for key, value in (document.get("sizes") or {}).items()}
        return structure(document, MarkerSizes)


def detect(
    light: Float[np.ndarray, "h w"], camera: Cameras, family: MarkerFamily, board: Board | None = None
) -> dict[int, Float[np.ndarray, "corners 2"]]:
    """Corners of the markers in a camera's image of linear light, 0..1, by id; pixels from the image's corner.

    Clockwise from the first corner, by all edges of the pattern. Of a board, corners of its squares by id, one each.
    """
    from cv2 import aruco

    dictionary = aruco.getPredefinedDictionary(getattr(aruco, _DICTIONARIES[family]))
    image = (light * 255).clip(0, 255).round().astype(np.uint8)
    if board is not None:
        charuco = aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, dictionary)
        corners, ids, _, _ = aruco.CharucoDetector(charuco).detectBoard(image)
        if ids is None:
            return {}
        return {int(i): xy.reshape(1, 2).astype(np.float64) + 0.5 for i, xy in zip(ids.ravel(), corners, strict=True)}
    parameters = aruco.DetectorParameters()
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_APRILTAG  # finds large squares, which thresholds miss
    corners, ids, _ = aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    if ids is None:
        return {}
    found: dict[int, Float[np.ndarray, "corners 2"]] = {}
    twice = {int(i) for i in ids.ravel() if (ids == i).sum() > 1}
    cells = dictionary.markerSize + 2
    for i, xy in zip(ids.ravel().tolist(), corners, strict=True):
        if i in twice:  # two markers of one id in a frame: neither is known to be the one
            continue
        bright = aruco.generateImageMarker(dictionary, int(i), cells) > 127
        registered = registered_corners(light, camera, xy.reshape(4, 2).astype(np.float64), bright)
        if registered is not None:
            found[int(i)] = registered
    return found


def _light(image: Float[Tensor, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """Gray linear light of a frame, relative to its brightest parts."""
    gray = linear_from_srgb(image).mean(-1)
    white = float(torch.quantile(gray[::4, ::4].flatten(), 0.995))
    return (gray / max(white, 1e-6)).clamp(0, 1).numpy()


def find_markers(
    rec: Reconstruction,
    frames: Frames,
    family: MarkerFamily,
    board: Board | None = None,
    progress: Progress = silent,
) -> dict[int, list[list[Sighting]]]:
    """Sightings of every corner of every marker, over the registered frames."""
    found: dict[int, list[list[Sighting]]] = defaultdict(lambda: [[] for _ in range(1 if board else 4)])
    for i, name in enumerate(rec.names):
        progress("looking for markers", i, len(rec.names))
        light = _light(frames.image(frames.index(name)))
        for marker, corners in detect(light, rec.cameras[i], family, board).items():
            for k, (x, y) in enumerate(corners.tolist()):
                found[marker][k].append(Sighting(i, (x, y)))
    progress("looking for markers", len(rec.names), len(rec.names))
    return dict(found)


def marker_estimates(
    rec: Reconstruction,
    sightings: Mapping[int, Sequence[Sequence[Sighting]]],
    sizes: MarkerSizes,
    settings: ScaleSettings,
    sigma_px: float,
) -> tuple[list[ScaleEstimate], list[str]]:
    """Scales by sizes and distances of markers, and notes on those that were left out.

    Raises InputError where none is found, or where the file speaks of markers that no two frames show.
    """
    if not sightings:
        raise InputError(
            f"no marker of {sizes.family} was found in the {len(rec.names)} frames with a pose",
            cause="another family was printed, the markers are too small (about 20 pixels are needed), or blurred",
            hint="--markers with the family that was printed; or larger frames (--long-side)",
        )
    placed, notes = placed_markers(rec, sightings, sigma_px)
    if sizes.board is not None:
        return [_board_estimate(placed, sizes.board, settings)], notes
    asked = {int(key) for key in sizes.sizes} | {marker for *both, _ in sizes.distances for marker in both}
    unknown = sorted(asked - set(placed))
    if unknown:
        seen = ", ".join(map(str, sorted(placed))) or "none"
        raise InputError(
            f"marker {', '.join(map(str, unknown))} of {settings.marker_file} is not in two frames of this run; markers"
            f" that are: {seen}",
            cause="a slip in an id, or a marker that was not filmed",
            hint="correct the id, or leave the marker out of the file",
        )
    estimates = []
    for marker, corners in sorted(placed.items()):
        size = sizes.size_of(marker)
        if size is not None:
            square = size * np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
            scale, std = scale_of_shape(corners, square, settings.marker_std / size)
            views = max(corner.frames for corner in corners)
            estimates.append(_estimate(f"marker {marker}", scale, std, settings, f"{size:g} m in {views} frames"))
    for one, other, length in sizes.distances:
        scale, std = scale_of_shape(
            (_center(placed[one]), _center(placed[other])), np.array([[0.0], [length]]), settings.length_std / length
        )
        estimates.append(_estimate(f"markers {one} to {other}", scale, std, settings, f"{length:g} m"))
    if not estimates:
        raise InputError(
            f"markers {', '.join(map(str, sorted(sightings)))} were seen, and no two frames place one of known size",
            cause="each was seen in one frame only, or from one place",
            hint="film a marker from several places; or --scale-bar",
        )
    return estimates, notes


def placed_markers(
    rec: Reconstruction, sightings: Mapping[int, Sequence[Sequence[Sighting]]], sigma_px: float
) -> tuple[dict[int, list[ScenePoint]], list[str]]:
    """Markers whose corners the frames determine, all at one place; and notes on the others.

    `sigma_px` is the standard deviation that poses and lens add to that of a corner.
    """
    placed, notes = {}, []
    sigma = float(np.hypot(_CORNER_PX, sigma_px))
    for marker, corners in sightings.items():
        points, failed = triangulate_all(rec.cameras, {str(k): seen for k, seen in enumerate(corners)}, sigma)
        if failed:
            notes.append(f"Marker {marker} is left out: {next(iter(failed.values()))}.")
        elif max(point.rms_px for point in points.values()) > _OFF_PX:
            notes.append(
                f"Marker {marker} is left out: its frames contradict each other by"
                f" {max(point.rms_px for point in points.values()):.1f} pixels; it moved, or its id was read wrongly."
            )
        else:
            placed[marker] = [points[str(k)] for k in range(len(corners))]
    return placed, notes


def _board_estimate(placed: Mapping[int, list[ScenePoint]], board: Board, settings: ScaleSettings) -> ScaleEstimate:
    if len(placed) < 4:
        raise InputError(
            f"{len(placed)} corners of the board are in two frames, and 4 are needed",
            cause="another board was printed than the file states, or it was filmed from one place",
            hint="columns, rows, square and marker as printed",
        )
    ids = np.array(sorted(placed))
    shape = np.stack(np.unravel_index(ids, (board.rows - 1, board.columns - 1)), -1) * board.square
    scale, std = scale_of_shape([placed[int(i)][0] for i in ids], shape, settings.marker_std / board.square / len(ids))
    return _estimate("board", scale, std, settings, f"{len(ids)} corners, squares of {board.square:g} m")


def _estimate(source: str, scale: float, std: float, settings: ScaleSettings, detail: str) -> ScaleEstimate:
    return ScaleEstimate(source, scale, float(np.hypot(std, settings.minimum_std)), detail)


def _center(corners: Sequence[ScenePoint]) -> ScenePoint:
    """The middle of a marker; errors of its corners taken as independent."""
    covariance = np.sum([corner.covariance for corner in corners], axis=0) / len(corners) ** 2
    xyz = np.mean([corner.xyz for corner in corners], axis=0)
    return ScenePoint(xyz, covariance, 0.0, 0, min(corner.frames for corner in corners))
