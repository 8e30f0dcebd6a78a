"""`swimm3r topics`: the topics of a ROS bag that can be used."""

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from swimm3r.io.bags.topics import Topics

Bag = Positional[Annotated[Path, arg(metavar="BAG")]]

_TITLES = ("topic", "type", "messages", "rate [Hz]", "first", "last", "used for")
_OPTIONS = {
    "images": "images: run, --rig",
    "positions": "positions: --nav",
    "depth": "depth: --nav",
    "lens": "lens of images",
    "transforms": "poses of cameras: --rig",
}
_DATES_FROM = 10**17  # nanoseconds; smaller stamps count from the begin of a simulation


def topics(bag: Bag, /) -> None:
    """List the topics of a ROS bag that can be used: images, lenses, positions, orientation, pressure.

    Args:
        bag: Bag of version 1 (.bag) or 2 (folder with metadata.yaml, .db3 or .mcap).
    """
    from swimm3r.io.bags.topics import read_topics

    for line in _lines(read_topics(bag)):
        print(line)


def _lines(found: "Topics") -> Iterator[str]:
    rows: list[tuple[str, ...]] = [_TITLES]
    for topic in found.known:
        use = _OPTIONS.get(topic.use or "", topic.use or "not used")
        use += f" ({topic.detail})" * bool(topic.detail)
        ends = (_shown(topic.first), _shown(topic.last))
        rows.append((topic.name, topic.type, str(topic.count), f"{topic.rate:.4g}", *ends, use))
    widths = [max(len(row[k]) for row in rows) for k in range(len(_TITLES))]
    for row in rows:
        yield "  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip()
    if found.others:
        names = ", ".join(f"{name} ({type_})" for name, type_ in found.others.items())
        yield f"Not used: {names}"


def _shown(stamp: int) -> str:
    """A stamp for people: date and time, or seconds of a clock that does not count from 1970."""
    if stamp < _DATES_FROM:
        return f"{stamp * 1e-9:.3f} s"
    moment = datetime.fromtimestamp(stamp // 10**9, UTC)
    return f"{moment:%Y-%m-%d %H:%M:%S}.{stamp % 10**9 // 10**6:03d}"
