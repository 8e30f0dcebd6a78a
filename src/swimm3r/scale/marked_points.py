"""Points that a person marked in frames: scale bars on the command line, and CSV files of named points.

FRAME:x,y FRAME:x,y ... LENGTH       in every frame first one end of the bar, then the other
name, frame, x, y                    --points
from, to, length[, std]              --distances
frame, x1, y1, x2, y2                --laser-dots
"""

import csv
import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import NoReturn

from swimm3r.errors import InputError, UsageError
from swimm3r.io.files.damage import Remedy, guard
from swimm3r.scale.triangulation import Sighting

_WORD = re.compile(r"(.+):(-?\d+(?:\.\d+)?),(-?\d+(?:\.\d+)?)")
_HINT = "in every frame both ends in the same order: a.png:10,20 a.png:300,22 b.png:14,25 b.png:305,28 0.5"


@dataclass(frozen=True)
class ScaleBar:
    """Both ends of a known length."""

    name: str
    ends: tuple[tuple[Sighting, ...], tuple[Sighting, ...]]
    length: float  # metres


@dataclass(frozen=True)
class KnownDistance:
    """A known distance of two named points."""

    one: str
    other: str
    length: float  # metres
    std: float | None


class FrameNames:
    """Registered frames by their names, with folder and suffix or without, where these tell one frame."""

    def __init__(self, names: Sequence[str], width: int, height: int, unregistered: Sequence[str] = ()) -> None:
        self.names, self.width, self.height = tuple(names), width, height
        self._index = {name: i for i, name in enumerate(names)}
        self._named: dict[str, list[str]] = defaultdict(list)  # frames by a name, with a pose or without
        for name in dict.fromkeys((*names, *unregistered)):
            for short in {name, *_shorter(name)}:
                self._named[short].append(name)

    def sighting(self, where: str, frame: str, x: float, y: float) -> Sighting:
        """A point in a frame. Raises InputError, which says `where`, for a frame or pixel that is not there."""
        name = self._frame(where, frame)
        if name is None or name not in self._index:
            known = name is not None
            raise InputError(
                f"{where} names the frame {frame}, which " + ("has no pose" if known else "this run does not have"),
                cause="it is a test frame, or could not be placed" if known else "a slip in the name",
                hint=f"frames with a pose: {', '.join(self.names[:4])}{' ...' if len(self.names) > 4 else ''}"
                " (sfm/cameras.json)",
            )
        if not (0 <= x <= self.width and 0 <= y <= self.height):
            raise InputError(
                f"{where}: pixel {x:g},{y:g} lies outside of the frame, {self.width} x {self.height}",
                cause="pixels of the original image, or x and y exchanged",
                hint="pixels of the prepared frame, RUN/prepare",
            )
        return Sighting(self._index[name], (x, y))

    def _frame(self, where: str, frame: str) -> str | None:
        """The whole name of a frame; None where the run has none. Raises InputError where several are called so."""
        path = PurePosixPath(frame)
        if frame in self._named.get(frame, ()):
            return frame
        for given in (frame, frame.removesuffix(path.suffix), path.stem):  # an original's suffix, a path to a frame
            found = self._named.get(given, [])
            if "/" in frame and given == path.stem:  # of another folder is another frame
                found = [name for name in found if "/" not in name]
            if len(found) > 1:
                raise InputError(
                    f"{where} names the frame {frame}, and several are called so: {', '.join(found[:4])}",
                    cause="frames of several cameras or folders have one name",
                    hint=f"the whole name, as {found[0]}",
                )
            if found:
                return found[0]
        return None


def _shorter(name: str) -> tuple[str, str, str]:
    """A name without its folder, without folder and suffix, and without its suffix."""
    path = PurePosixPath(name)
    return path.name, path.stem, str(path.with_suffix(""))


def read_scale_bars(words: Sequence[str], frames: FrameNames) -> list[ScaleBar]:
    """The scale bars of --scale-bar. Raises UsageError and InputError that name the bar and its fault."""
    bars: list[ScaleBar] = []
    seen: list[tuple[str, Sighting]] = []
    for word in words:
        found = _WORD.fullmatch(word)
        if found:
            where = f"scale bar {len(bars) + 1}"
            seen.append((found[1], frames.sighting(where, found[1], float(found[2]), float(found[3]))))
            continue
        bars.append(_bar(len(bars) + 1, seen, _length(word, len(bars) + 1)))
        seen = []
    if seen:
        raise UsageError(
            f"scale bar {len(bars) + 1} has no length", cause="the last word of a bar is its length", hint=_HINT
        )
    return bars


def _length(word: str, number: int) -> float:
    try:
        length = float(word)
    except ValueError:
        raise UsageError(
            f"scale bar {number}: {word!r} is neither FRAME:x,y nor a length in metres", cause="a slip", hint=_HINT
        ) from None
    if not 0 < length < 1000:
        raise UsageError(
            f"scale bar {number} is {length:g} m long", cause="another unit than metres", hint="0.5 for half a metre"
        )
    return length


def _bar(number: int, seen: list[tuple[str, Sighting]], length: float) -> ScaleBar:
    by_frame: dict[int, list[Sighting]] = defaultdict(list)
    for _, sighting in seen:
        by_frame[sighting.frame].append(sighting)
    names = {sighting.frame: name for name, sighting in seen}
    odd = [names[frame] for frame, both in by_frame.items() if len(both) != 2]
    if odd:
        raise UsageError(
            f"scale bar {number} has {len(by_frame[next(f for f, n in names.items() if n == odd[0])])} point(s) in"
            f" {odd[0]}, and two are expected, one per end",
            cause="an end was left out",
            hint=_HINT,
        )
    if len(by_frame) < 2:
        only = next(iter(names.values()), "no frame")
        raise InputError(
            f"scale bar {number} is marked in one frame only ({only})",
            cause="a bar in a single frame has no distance from the camera, and so no length in the run",
            hint=f"mark both ends in a second frame from another place: {_HINT}",
        )
    return ScaleBar(
        f"scale bar {number}",
        (tuple(both[0] for both in by_frame.values()), tuple(both[1] for both in by_frame.values())),
        length,
    )


def read_points(path: Path, frames: FrameNames) -> dict[str, list[Sighting]]:
    """The sightings of every named point."""
    points: dict[str, list[Sighting]] = defaultdict(list)
    for line, row in _rows(path, ("name", "frame", "x", "y")):
        x, y = _number(path, line, row, "x"), _number(path, line, row, "y")
        points[row["name"]].append(frames.sighting(f"{path}, line {line}", row["frame"], x, y))
    return dict(points)


def read_distances(path: Path) -> list[KnownDistance]:
    """Known distances between named points."""
    found = []
    for line, row in _rows(path, ("from", "to", "length")):
        length = _number(path, line, row, "length")
        std = _number(path, line, row, "std") if row.get("std") else None
        if length <= 0 or row["from"] == row["to"] or (std is not None and std <= 0):
            _refuse(path, f"line {line}: a distance is positive and between two points, got {row}")
        found.append(KnownDistance(row["from"], row["to"], length, std))
    return found


def read_laser_dots(path: Path, frames: FrameNames) -> list[tuple[str, Sighting, Sighting]]:
    """Both laser dots in frames: the frame's name and two sightings."""
    out = []
    for line, row in _rows(path, ("frame", "x1", "y1", "x2", "y2")):
        x1, y1, x2, y2 = (_number(path, line, row, name) for name in ("x1", "y1", "x2", "y2"))
        where = f"{path}, line {line}"
        out.append(
            (row["frame"], frames.sighting(where, row["frame"], x1, y1), frames.sighting(where, row["frame"], x2, y2))
        )
    return out


def _rows(path: Path, needed: tuple[str, ...]) -> list[tuple[int, dict[str, str]]]:
    """The rows of a CSV by the names of its columns, with their line numbers."""
    cause = "a slip in the name, or another kind of file"
    remedy = Remedy(f"a CSV with the columns {', '.join(needed)}", cause, fault="cannot be read")
    with guard(path, remedy):
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    separator = max(",;\t", key=(lines[0] if lines else "").count)
    rows = list(csv.reader(lines, delimiter=separator, skipinitialspace=True))
    titles = [title.strip().lower() for title in rows[0]] if rows else []
    missing = [name for name in needed if name not in titles]
    if missing:
        _refuse(path, f"it has no column {', '.join(missing)}; it has {', '.join(titles) or 'none'}")
    table = [
        (number, {title: cell.strip() for title, cell in zip(titles, row, strict=False)})
        for number, row in enumerate(rows[1:], 2)
        if any(cell.strip() for cell in row)
    ]
    if not table:
        _refuse(path, "it has no rows")
    for number, row in table:
        if any(not row.get(name) for name in needed):
            _refuse(path, f"line {number} is not complete")
    return table


def _number(path: Path, line: int, row: dict[str, str], name: str) -> float:
    try:
        value = float(row[name])
    except ValueError:
        _refuse(path, f"line {line}: {name} is {row[name]!r}, which is no number")
    if not abs(value) < 1e9:
        _refuse(path, f"line {line}: {name} is {row[name]}")
    return value


def _refuse(path: Path, why: str) -> NoReturn:
    raise InputError(f"{path} cannot be used: {why}", cause="another table, or a slip in it", hint="correct it there")
