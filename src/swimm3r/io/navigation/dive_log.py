"""Logs of dive computers -> depths over time: Subsurface's XML (.ssrf, .xml) and tables of times and depths.

A dive computer knows no position: east and north are zero with an infinite standard deviation. Its clock shows local
time, taken as UTC: the offset from the clip is found by the depths themselves, or given (--nav-offset). All dives of a
log are read; moments between them lie in no gap that is interpolated.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from swimm3r.errors import InputError
from swimm3r.io.navigation.clock import is_date, seconds_of_date
from swimm3r.io.navigation.record import Navigation

_DEPTH_STD = 0.1  # metres: the resolution of dive computers, which round to a decimeter or a foot
_FOOT = 0.3048
_ROOT = re.compile(r"<(divelog|dives|divecomputer|dive)\b")
_ENTITIES = re.compile(r"<!(DOCTYPE|ENTITY)", re.IGNORECASE)


def is_dive_log(begin: str) -> bool:
    """Return whether a file begins as Subsurface's XML does."""
    return begin.lstrip().startswith("<") and _ROOT.search(begin) is not None


def read_dive_log(path: Path) -> Navigation:
    """The depths of all dives in Subsurface's XML. Raises InputError where there are none."""
    text = path.read_text(encoding="utf-8-sig")
    if _ENTITIES.search(text):  # can name other files, or grow to any size
        raise ValueError("it defines entities, which no dive log does")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"its XML ends or breaks: {error}") from error
    samples = [sample for dive in root.iter("dive") for sample in _samples(dive)]
    if not samples:
        raise InputError(
            f"{path} holds no dive with a date and a depth profile",
            cause="its dives were written by hand, without the samples of a dive computer",
            hint="the log as downloaded from the dive computer: Subsurface's own file, or its export of dive profiles",
        )
    return depths_alone(path, *np.array(samples).T)


def depths_alone(path: Path, time: np.ndarray, depth: np.ndarray) -> Navigation:
    """Navigation that knows depths, metres, and nothing of east and north."""
    nothing = np.zeros_like(depth)
    return Navigation(
        path=path,
        frame="local",
        position=np.stack([nothing, nothing, -depth], -1),
        clock="utc" if is_date(float(time[0])) else "clip",
        time=time,
        std=np.tile([np.inf, np.inf, _DEPTH_STD], (len(depth), 1)),
    )


def _samples(dive: ElementTree.Element) -> Iterator[tuple[float, float]]:
    """Seconds since 1970 and depths of the first dive computer of a dive, the first at the surface."""
    date, clock = dive.get("date"), dive.get("time")
    computer = next(dive.iter("divecomputer"), dive)
    date, clock = computer.get("date") or date, computer.get("time") or clock
    if date is None or clock is None:
        return
    begin = seconds_of_date(date, clock)
    for sample in computer.iter("sample"):
        time, depth = sample.get("time"), sample.get("depth")
        if time is not None and depth is not None:  # samples may hold a temperature or an event alone
            yield begin + _minutes(time), _metres(depth)


def _minutes(text: str) -> float:
    """Seconds of "12:40 min" or "1:02:40". Raises ValueError."""
    parts = text.removesuffix("min").strip().split(":")
    if not 1 <= len(parts) <= 3 or not all(part.isdigit() for part in parts):
        raise ValueError(f"{text!r} is no time of a sample")
    seconds = 0
    for part in parts:
        seconds = 60 * seconds + int(part)
    return float(seconds if len(parts) > 1 else 60 * seconds)


def _metres(text: str) -> float:
    """Metres of "12.4 m" or "41 ft". Raises ValueError."""
    number, _, unit = text.strip().partition(" ")
    if unit.strip() not in ("", "m", "ft"):
        raise ValueError(f"{text!r} is no depth in metres or feet")
    return float(number) * (_FOOT if unit.strip() == "ft" else 1.0)
