"""The head of the page: the dive's name, its date, and the figures that say how far to trust the rest."""

import json
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from swimm3r.scene.frames import Frames


@dataclass(frozen=True)
class Figure:
    """One number with its name; a note says what it counts or how to read it."""

    value: str
    name: str
    note: str = ""


def dated(frames: Frames, folder: Path) -> str:
    """The date of the recording, or where the files do not tell it, that of the run, which is then said."""
    if frames.recorded is not None:
        return f"recorded on {_in_words(frames.recorded)} by the camera's clock"
    opened = _opened(folder / "log.jsonl")
    processed = "" if opened is None else f"processed on {_in_words(opened)}; "
    return f"{processed}the files do not state when they were recorded"


def size_of_dive(frames: Frames, *, rectified: bool) -> str:
    """Number, size and length of the frames, and how many of them are held back."""
    count = f"{len(frames):,} {'rectified ' * rectified}frames of {frames.width} \u00d7 {frames.height} pixels"
    span = frames.span[1] - frames.span[0]
    length = f" over {clock(span)}" if has_times(frames) and span > 0 else ""
    return f"{count}{length}; {len(frames.train):,} used, {len(frames.test):,} held back for testing" + (
        f", {len(frames.between):,} between keyframes" if len(frames.between) else ""
    )


def has_times(frames: Frames) -> bool:
    """Return whether the frames carry times; images without a clock are numbered instead."""
    return any(frame.time != i for i, frame in enumerate(frames))


def caption(frames: Frames, name: str) -> str:
    """The name of a frame with its time, where it has one."""
    if not has_times(frames):
        return name
    return f"{name}, {clock(frames.times_of([name])[0])}"


def clock(seconds: float) -> str:
    """Seconds as people read them: 4.2 s, 3:05 min, 1:02:03 h."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02} h" if hours else f"{minutes}:{rest:02} min"


def head_figures(summary: dict[str, Any]) -> list[Figure]:
    """The figures of structure from motion, and the map's score where there is one."""
    sfm = summary.get("sfm")
    if sfm is None:
        return []
    found = [Figure(f"{sfm['registered']:,} of {sfm['frames']:,}", "Frames placed")]
    if sfm["dense_points"]:
        found.append(Figure(f"{sfm['dense_points']:,}", "Points in the dense cloud"))
    if sfm["reprojection_px"] is not None:
        found.append(Figure(f"{sfm['reprojection_px']:.2f} px", "Reprojection error", "mean over the sparse points"))
    if sfm["epipolar_px"] is not None:
        within = f"{100 * sfm['inlier_1px']:.0f} % of matches within 1 px"
        found.append(Figure(f"{sfm['epipolar_px']:.2f} px", "Epipolar error", within))
    if sfm["metric"]:
        found.append(Figure("Metres", "Unit of length"))
    else:
        found.append(Figure("Scene units", "Unit of length", "the scale is not known"))
    return found


def _in_words(date: str) -> str:
    when = datetime.fromisoformat(date)
    return f"{when.day} {when:%B %Y, %H:%M}"


def _opened(log: Path) -> str | None:
    """The time of a run's first event; None where the log is missing or begins with something else."""
    if not log.is_file():
        return None
    with log.open(encoding="utf-8", errors="replace") as file:
        line = file.readline()
    try:
        stated = json.loads(line)["time"]
        datetime.fromisoformat(stated)
    except (ValueError, KeyError, TypeError):
        return None
    return stated
