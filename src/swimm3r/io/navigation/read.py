"""A navigation file of any format that is known, told apart by its content."""

import re
from pathlib import Path

from swimm3r.errors import InputError, UsageError
from swimm3r.io.bags.bag import is_bag
from swimm3r.io.files.damage import Remedy, guard
from swimm3r.io.image_folder import find_images
from swimm3r.io.navigation.bag import read_bag
from swimm3r.io.navigation.dive_log import is_dive_log, read_dive_log
from swimm3r.io.navigation.exif import read_exif
from swimm3r.io.navigation.formats import read_dim2, read_nmea, read_srt, read_tum
from swimm3r.io.navigation.record import Navigation, in_time_order
from swimm3r.io.navigation.table import read_table

_REMEDY = Remedy(
    "a CSV with named columns, NMEA, Matisse .dim2, TUM, .srt, Subsurface's XML, a ROS bag, or a folder of images with"
    " GPS in EXIF; see docs/guides/metric-scale.md",
    cause="a slip in the name, or it is cut off or of another format",
    fault="cannot be read as navigation",
)
_DIM2 = re.compile(r"[^;]*;\s*\d\d/\d\d/\d{4}\s*;\s*\d\d:\d\d:")
_BEGIN = 4096  # bytes that tell the format


def read_navigation(path: Path, topic: str | None = None) -> Navigation:
    """Positions in the order of time; `topic` is that of positions in a bag.

    Raises InputError that names what is wrong, as swapped columns, and UsageError where a topic is to be chosen.
    """
    if is_bag(path):
        with guard(path, _REMEDY):
            return in_time_order(read_bag(path, topic))
    if topic is not None:
        raise UsageError(
            f"{path} has no topics", cause="--nav-topic is for ROS bags alone", hint="leave out --nav-topic"
        )
    if path.is_dir():
        with guard(path, _REMEDY):
            return in_time_order(read_exif(path, find_images(path).paths))
    with guard(path, _REMEDY):
        with path.open("rb") as file:
            begin = file.read(_BEGIN).decode("utf-8-sig", errors="replace")
        if "\0" in begin:
            raise ValueError("it is no text")
        return in_time_order(_read(path, begin))


def _read(path: Path, begin: str) -> Navigation:
    lines = [line for line in begin.splitlines() if line.strip()]
    if not lines:
        raise InputError(f"{path} is empty", cause="the recording did not start", hint="another file")
    if is_dive_log(begin):
        return read_dive_log(path)
    if _DIM2.match(lines[0]):
        return read_dim2(path)
    if "-->" in begin:
        return read_srt(path)
    if any(line.lstrip().startswith(("$", "!")) or "$G" in line for line in lines[:5]):
        return read_nmea(path)
    words = [line.split() for line in lines if line[0] != "#"]
    if words and len(words[0]) == 8 and all(_is_number(word) for word in words[0]):
        return read_tum(path)
    return read_table(path)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
