"""`swimm3r telemetry`: measurements that a GoPro wrote into a video."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from swimm3r.io.telemetry.record import Telemetry

Clip = Positional[Annotated[Path, arg(metavar="VIDEO")]]

_TITLES = ("stream", "unit", "samples", "rate [Hz]", "first", "last")
_SHOWN = 5  # channels of a sample; the CSV files hold all


def telemetry(video: Clip, /, csv: Path | None = None) -> None:
    """List the telemetry of a GoPro video: motion, gravity, exposure, white balance, position.

    Args:
        video: MP4 as the camera wrote it.
        csv: Folder for one CSV per stream, with the time of every sample in seconds of the clip.
    """
    from swimm3r.io.files.outputs import output_folder
    from swimm3r.io.telemetry.read import read_telemetry, write_csv

    found = read_telemetry(video)
    for line in _lines(found):
        print(line)
    if csv is not None:
        with output_folder(csv, "--csv"):
            written = write_csv(csv, found)
        print(f"{len(written)} files in {csv}")


def _lines(found: "Telemetry") -> Iterator[str]:
    """A table for each device, then what is not in it."""
    rows: dict[str, list[tuple[str, ...]]] = {}
    for stream in found.streams:
        ends = (_shown(stream.values[0].tolist()), _shown(stream.values[-1].tolist()))
        units = " ".join(dict.fromkeys(unit for unit in stream.units if unit))
        row = (stream.key, units, str(len(stream)), f"{stream.rate:.4g}", *ends)
        rows.setdefault(stream.device, [_TITLES]).append(row)
    widths = [max(len(row[k]) for table in rows.values() for row in table) for k in range(len(_TITLES))]
    for device, table in rows.items():
        yield device or "(a device without a name)"
        for row in table:
            yield "  " + "  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip()
    if found.not_numbers:
        yield f"Not numbers, or lists of varying length: {', '.join(found.not_numbers)}"
    for warning in found.warnings:
        yield f"Warning: {warning}"


def _shown(values: Sequence[float]) -> str:
    more = f" ... ({len(values)} values)" if len(values) > _SHOWN else ""
    return " ".join(f"{value:.5g}" for value in values[:_SHOWN]) + more
