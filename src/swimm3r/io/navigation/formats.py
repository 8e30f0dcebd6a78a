"""Matisse's .dim2, NMEA 0183 sentences, TUM trajectories and .srt subtitles of drones -> navigation."""

import math
import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from swimm3r.io.navigation.clock import seconds_of_date, seconds_of_day
from swimm3r.io.navigation.record import PORT_UP, Navigation, vehicle_attitude

_DIM2 = ("latitude", "longitude", "depth", "altitude", "heading", "roll", "pitch")
_DIM2_FIRST = 6  # fields before them: a flag, date, time, camera, size, file
_BLOCK = re.compile(r"(\d\d):(\d\d):(\d\d)[,.](\d{1,3})\s*-->")
_NUMBER = r"\s*[:=]?\s*(-?\d+(?:\.\d+)?)"
_PLACE = re.compile(r"GPS\s*\(\s*(-?\d+(?:\.\d+)?)\s*,\s*(-?\d+(?:\.\d+)?)\s*(?:,\s*(-?\d+(?:\.\d+)?))?")
_KNOT_FREE = ("GGA", "GLL", "RMC")  # sentences with a position
_FIELDS = 10  # of a sentence that are looked at
_DAY, _LATE = 86400.0, 3600.0  # seconds


def read_dim2(path: Path) -> Navigation:
    """Matisse's navigation of images: a line per image, fields between semicolons."""
    rows, times, names = [], [], []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        fields = [field.strip() for field in line.split(";")]
        if len(fields) < 2:
            continue
        if len(fields) < _DIM2_FIRST + len(_DIM2):
            raise ValueError(f"line {number} has {len(fields)} fields, and 13 are expected")
        times.append(seconds_of_date(fields[1], fields[2]))
        names.append(fields[5])
        rows.append([float(field) for field in fields[_DIM2_FIRST : _DIM2_FIRST + len(_DIM2)]])
    table = np.array(rows).reshape(-1, len(_DIM2))
    values = dict(zip(_DIM2, table.T, strict=True))
    return Navigation(
        path=path,
        frame="geodetic",
        position=np.stack([values["latitude"], values["longitude"], -values["depth"]], -1),
        clock="utc",
        time=np.array(times),
        names=tuple(names),
        attitude=vehicle_attitude(values["heading"], values["pitch"], values["roll"]),
        altitude=np.where(values["altitude"] > 0, values["altitude"], np.nan),
    )


def read_tum(path: Path) -> Navigation:
    """A TUM trajectory: time, position and orientation (quaternion x, y, z, w) of the vehicle, metres, z up.

    A vehicle that lies level has its z up, too: its axes are ROS's, x forward and y to port (REP 103).
    """
    from scipy.spatial.transform import Rotation

    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.strip() and line[0] != "#"]
    table = np.array([[float(word) for word in line.replace(",", " ").split()] for line in lines])
    if table.ndim != 2 or table.shape[1] != 8:
        raise ValueError("a line of 8 numbers (time, x, y, z, qx, qy, qz, qw) is expected per pose")
    if (np.linalg.norm(table[:, 4:], axis=1) < 0.1).any():
        raise ValueError("a quaternion is zero")
    return Navigation(
        path=path,
        frame="local",
        position=table[:, 1:4],
        clock="utc" if table[0, 0] > 1e8 else "clip",
        time=table[:, 0],
        attitude=Rotation.from_quat(table[:, 4:]).as_matrix() @ PORT_UP,
    )


def read_srt(path: Path) -> Navigation:
    """Subtitles beside a drone's or towed camera's video that state latitude and longitude; times are the clip's."""
    times, rows = [], []
    for block in re.split(r"\n\s*\n", path.read_text(encoding="utf-8", errors="replace").replace("\r", "")):
        begin = _BLOCK.search(block)
        place = _srt_place(block)
        if begin is not None and place is not None and (place[0] or place[1]):  # zeros: no fix yet
            hours, minutes, seconds, fraction = begin.groups()
            times.append(int(hours) * 3600 + int(minutes) * 60 + int(seconds) + float(f"0.{fraction}"))
            rows.append(place)
    if not rows:
        raise ValueError("no block states latitude and longitude")
    position = np.array(rows)
    unknown = np.isnan(position[:, 2])
    position[unknown, 2] = 0.0
    std = np.full((len(rows), 3), np.nan)
    std[unknown, 2] = np.inf
    return Navigation(path, "geodetic", position, "clip", np.array(times), std=std if unknown.any() else None)


def _srt_place(block: str) -> tuple[float, float, float] | None:
    """Latitude, longitude and height (NaN where it is not told) of a subtitle."""
    latitude = re.search(r"latitude" + _NUMBER, block, re.IGNORECASE)
    longitude = re.search(r"longt?itude" + _NUMBER, block, re.IGNORECASE)
    if latitude and longitude:
        height = re.search(r"abs_alt" + _NUMBER, block) or re.search(r"altitude" + _NUMBER, block, re.IGNORECASE)
        depth = re.search(r"depth" + _NUMBER, block, re.IGNORECASE)
        up = -float(depth[1]) if depth else float(height[1]) if height else np.nan
        return float(latitude[1]), float(longitude[1]), up
    found = _PLACE.search(block)  # DJI: longitude first
    return (float(found[2]), float(found[1]), float(found[3] or "nan")) if found else None


def read_nmea(path: Path) -> Navigation:
    """NMEA 0183: positions of GGA, RMC or GLL, dates of RMC or ZDA, altitudes of DPT.

    Sentences whose checksum is wrong, or that are cut off, are left out. Heights are not taken from GGA: they are the
    antenna's. Times of GGA and GLL go on after midnight, where the sentence that names the new day comes later.
    """
    fixes: dict[float, tuple[float, float]] = {}
    altitudes: dict[float, float] = {}
    date: float | None = None
    wrong = count = 0
    latest: float | None = None  # moment of a sentence that names the day, or of a fix after it
    last: float | None = None  # moment of the last fix
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        start = line.find("$")
        if start < 0:
            continue
        count += 1
        fields = _sentence(line[start:])
        if fields is None:
            wrong += 1
            continue
        kind = fields[0][-3:]
        fields += [""] * (_FIELDS - len(fields))
        day, fix = _nmea_date(kind, fields), _nmea_fix(kind, fields) if kind in _KNOT_FREE else None
        if day is not None:
            date, latest = day, day + (_nmea_seconds(fields[1]) or 0.0)
        if fix is not None and date is not None:
            last = latest = _on_its_day(date + fix[0], latest)
            fixes[last] = fix[1:]
        if kind == "DPT" and last is not None and fields[1]:
            altitudes[last] = float(fields[1])
    if count and wrong > count / 2:
        raise ValueError(f"the checksums of {wrong} of {count} sentences are wrong")
    if not fixes:
        raise ValueError("no date (RMC or ZDA)" if date is None else "no position (GGA, RMC or GLL) after a date")
    times = np.array(sorted(fixes))
    position = np.array([[*fixes[time], 0.0] for time in times.tolist()])
    altitude = np.array([altitudes.get(time, np.nan) for time in times.tolist()])
    std = np.tile([np.nan, np.nan, np.inf], (len(times), 1))
    return Navigation(path, "geodetic", position, "utc", times, std=std, altitude=altitude)


def _on_its_day(moment: float, latest: float | None) -> float:
    """A moment whose date may be that of a day before or after: at most an hour before the latest one."""
    return moment if latest is None else moment + _DAY * math.ceil((latest - _LATE - moment) / _DAY)


def _sentence(text: str) -> list[str] | None:
    """The fields of a sentence; None where its checksum is wrong."""
    body, star, given = text[1:].strip().partition("*")
    total = 0
    for character in body.encode("latin-1", "replace"):
        total ^= character
    if star and given[:2].upper() != f"{total:02X}":
        return None
    return body.split(",")


def _nmea_date(kind: str, fields: list[str]) -> float | None:
    """Seconds since 1970 of the day that a sentence names."""
    if kind == "RMC" and len(fields[9]) == 6:
        return datetime.strptime(fields[9], "%d%m%y").replace(tzinfo=UTC).timestamp()
    if kind == "ZDA" and all(fields[2:5]) and len(fields[4]) == 4:
        return datetime(int(fields[4]), int(fields[3]), int(fields[2]), tzinfo=UTC).timestamp()
    return None


def _nmea_fix(kind: str, fields: list[str]) -> tuple[float, float, float] | None:
    """Seconds of the day, latitude and longitude; None without a fix."""
    at = {"GGA": (1, 2), "RMC": (1, 3), "GLL": (5, 1)}[kind]
    time, place = fields[at[0]], fields[at[1] : at[1] + 4]
    is_void = (kind == "RMC" and fields[2] != "A") or (kind == "GGA" and fields[6] == "0")
    seconds = _nmea_seconds(time)
    if is_void or seconds is None or not all(place):
        return None
    return seconds, _degrees(place[0], 2, place[1] == "S"), _degrees(place[2], 3, place[3] == "W")


def _nmea_seconds(time: str) -> float | None:
    """Seconds of the day of hhmmss.ss; None without them."""
    return None if len(time) < 6 else seconds_of_day(f"{time[:2]}:{time[2:4]}:{time[4:]}")


def _degrees(text: str, digits: int, negative: bool) -> float:
    """Degrees of ddmm.mmm."""
    value = float(text[:digits]) + float(text[digits:]) / 60
    return -value if negative else value
