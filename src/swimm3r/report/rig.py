"""The section on the cameras of a rig: where each is from the first, and how well their images were taken together."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from swimm3r.report.scale import plus_minus
from swimm3r.scene.frames import Frames


@dataclass(frozen=True)
class RigRow:
    """One camera beside the first."""

    name: str
    baseline: str
    known: str
    place: str  # right, down and forward
    turn: str  # about the same axes


@dataclass(frozen=True)
class RigSection:
    """Everything that the section shows."""

    lead: str
    unit: str
    rows: tuple[RigRow, ...]
    lines: tuple[str, ...]


def rig_section(summary: dict[str, Any], frames: Frames) -> RigSection | None:
    """The cameras of a run's rig; None of a single camera."""
    rig = summary.get("rig")
    if rig is None:
        return None
    first, *others = rig["cameras"]
    metric = summary["sfm"]["metric"]
    errors = f"{rig['rig_px']:.2f} px with one pose per instant, {rig['free_px']:.2f} px with one per image"
    kind = "are one rigid rig" if rig["rigid"] else "do not form a rigid rig: poses are as without one"
    lead = (
        f"{len(rig['cameras'])} cameras {kind}. Reprojection errors in the median are {errors}. Distances and angles"
        f" are those from {first['name']}."
    )
    rows = tuple(_row(camera, metric) for camera in others)
    lines = tuple(_together(camera, first["name"], frames) for camera in others)
    return RigSection(lead, "m" if metric else "scene units", rows, lines)


def _row(camera: dict[str, Any], metric: bool) -> RigRow:
    pose, length = np.array(camera["camera_from_rig"]), camera["baseline"]
    known = camera["known_baseline"]
    off = "" if known is None or not metric else f" ({100 * (length / known - 1):+.2f} %)"
    place = ", ".join(f"{value:.4g}" for value in (-pose[:3, :3].T @ pose[:3, 3]).tolist())
    turn = ", ".join(f"{value:.2f}" for value in np.degrees(Rotation.from_matrix(pose[:3, :3].T).as_rotvec()).tolist())
    return RigRow(
        camera["name"],
        plus_minus(length, length * camera["baseline_std"]),
        "not known" if known is None else f"{known:.4g} m{off}",
        place,
        turn,
    )


def _together(camera: dict[str, Any], first: str, frames: Frames) -> str:
    """Times by which the images of a camera are later than those of the first, by their stamps and by the path."""
    name, delay, std = camera["name"], camera["delay"], camera["delay_std"]
    times = {side: {one.instant: one.time for one in frames if one.camera == side} for side in (first, name)}
    gaps = [1000 * (time - times[first][i]) for i, time in times[name].items() if i in times[first]]
    told = f"{name} and {first} have poses together at {camera['instants']} instants"
    if any(gaps):
        told += (
            f"; by the times of its images {name} is {np.median(gaps):+.3g} ms later, at most {max(gaps, key=abs):+.3g}"
        )
    if delay is None:
        return f"{told}."
    step = float(np.median(np.diff(sorted(times[first].values()))))
    late = f"by {plus_minus(delay / step, std / step)} of the time between two images"
    if abs(delay) > 3 * std:
        return f"{told}. Along the path it is later {late}: the cameras were not triggered together."
    return f"{told}. Along the path it is later {late}, which is no sign of cameras that were not triggered together."
