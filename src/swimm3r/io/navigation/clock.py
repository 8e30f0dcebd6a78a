"""Moments as files write them -> seconds since 1970 UTC. Those without a zone are taken as UTC."""

import re
from datetime import UTC, datetime
from pathlib import PurePath

_COMPACT = re.compile(r"(?<!\d)(\d{4})(\d{2})(\d{2})[T_-]?(\d{2})(\d{2})(\d{2})(?:[.,](\d{1,9}))?Z?(?!\d)")
_LATE = 1e8  # seconds; numbers beyond count from 1970, smaller ones from the begin of the clip
_YEARS = (1990, 2100)


def seconds_of(text: str) -> float:
    """Seconds since 1970 of ISO 8601, or a number as it is. Raises ValueError for what is neither."""
    text = text.strip()
    try:
        return float(text)
    except ValueError:
        pass
    moment = datetime.fromisoformat(text.replace("/", "-").replace(",", "."))
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def seconds_of_date(date: str, time: str) -> float:
    """Seconds since 1970 of a date (2019-04-04, 04/04/2019 with the day first, 20190404) and a time of day."""
    date = date.strip()
    for form in ("%Y-%m-%d", "%Y/%m/%d", "%d/%m/%Y", "%d-%m-%Y", "%d.%m.%Y", "%Y%m%d"):
        try:
            day = datetime.strptime(date, form).replace(tzinfo=UTC)
        except ValueError:
            continue
        return day.timestamp() + seconds_of_day(time)
    raise ValueError(f"{date!r} is no date")


def seconds_of_day(time: str) -> float:
    """Seconds of hh:mm:ss.sss."""
    found = re.fullmatch(r"\s*(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,]\d+)?))?\s*Z?\s*", time)
    if not found or int(found[1]) > 24 or int(found[2]) > 59:
        raise ValueError(f"{time!r} is no time of day")
    return int(found[1]) * 3600 + int(found[2]) * 60 + float((found[3] or "0").replace(",", "."))


def is_date(seconds: float) -> bool:
    """Return whether a number of seconds counts from 1970 rather than from the begin of a clip."""
    return abs(seconds) > _LATE


def seconds_of_name(name: str) -> float | None:
    """Seconds since 1970 of a date and time in a file's name, as cameras and vehicles write them; None without one."""
    found = _COMPACT.search(PurePath(name).stem)
    if not found or not _YEARS[0] <= int(found[1]) <= _YEARS[1]:
        return None
    try:
        moment = datetime(*(int(found[i]) for i in range(1, 7)), tzinfo=UTC)
    except ValueError:
        return None
    return moment.timestamp() + (float(f"0.{found[7]}") if found[7] else 0.0)


def utc(seconds: float) -> str:
    """A moment for people."""
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
