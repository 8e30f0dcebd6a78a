"""The telemetry of a GoPro video, from the GPMF track of its MP4.

The track is read by PyAV and its payloads by `klv`. telemetry-parser 0.3.0 (MIT or Apache-2.0) finds the same samples
in GoPro's own files and was not taken: it has no wheels for Python 3.13 and later, gives no times of payloads, leaves
samples of several types as bytes, and merges the devices that share a file.
"""

import csv
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

from swimm3r.errors import InputError
from swimm3r.io.files.atomic import atomic_path
from swimm3r.io.telemetry.record import Stream, Telemetry
from swimm3r.io.telemetry.streams import Payload, streams_of
from swimm3r.io.video import Video

_BEGIN = b"DEVC"  # of every GPMF payload


def read_telemetry(path: Path) -> Telemetry:
    """All streams of a video. Raises InputError where it is no video, or holds no telemetry that can be read."""
    video = Video(path)
    payloads, stated = gpmf_payloads(video)
    if not payloads:
        raise InputError(
            f"{path} holds no telemetry",
            cause="it was not recorded by a GoPro, or an editor or converter left the GPMF track out",
            hint="the file as the camera wrote it; of a copy, ffmpeg -i IN -map 0 -c copy OUT.mp4 keeps the track",
        )
    streams, not_numbers, damaged = streams_of(payloads)
    if not streams:
        raise InputError(
            f"the telemetry of {path} cannot be read: {damaged} of {len(payloads)} payloads are damaged",
            cause="the file is cut off or damaged, or its telemetry holds no measurements",
            hint="copy it from the camera again",
        )
    warnings = []
    if damaged:
        warnings.append(f"{damaged} of {len(payloads)} payloads of {path.name} are damaged and were passed over.")
    if stated > len(payloads):
        warnings.append(
            f"{path.name} should hold {stated} payloads of telemetry, and {len(payloads)} are there: it is cut off."
        )
    return Telemetry(path, streams, not_numbers, tuple(warnings))


def write_csv(folder: Path, telemetry: Telemetry) -> list[Path]:
    """One CSV per stream, with the time in seconds and a column per channel and its unit. The files, in order."""
    written: list[Path] = []
    for stream in telemetry.streams:
        name, number = stream.key, 1
        while folder / f"{name}.csv" in written:  # another device has a stream of that key
            number += 1
            name = f"{stream.key}-{number}"
        path = folder / f"{name}.csv"
        with atomic_path(path) as draft, draft.open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file)
            table.writerow(["time [s]", *_columns(stream)])
            for time, row in zip(stream.time, stream.values, strict=True):
                table.writerow([f"{time:.6f}", *(f"{value:.12g}" for value in row)])
        written.append(path)
    return written


def _columns(stream: Stream) -> Iterator[str]:
    units = stream.units or ("",) * len(stream.channels)
    for channel, unit in zip(stream.channels, units, strict=True):
        yield f"{channel} [{unit}]" if unit else channel


def gpmf_payloads(video: Video) -> tuple[list[Payload], int]:
    """The packets of the first GPMF track with times of the clip, and how many the file states."""
    import av
    from av.error import FFmpegError

    with av.open(f"file:{video.path}") as file:
        candidates = [stream.index for stream in file.streams.data]
    for index in candidates:
        found: list[Payload] = []
        with av.open(f"file:{video.path}") as file:
            stream = file.streams[index]
            for other in file.streams:  # or the images are read, too
                if other.index != index and hasattr(other, "discard"):  # older PyAV has none
                    other.discard = type(other.discard)["all"]
            tick = stream.time_base or Fraction(1)
            stated = stream.frames
            try:
                for packet in file.demux(stream):
                    if not packet.size or packet.pts is None:
                        continue
                    data = bytes(packet)
                    if not found and not data.startswith(_BEGIN):
                        break
                    begin = float(packet.pts * tick) - video.begin
                    found.append(Payload(begin, float((packet.duration or 0) * tick), data))
            except FFmpegError:
                pass  # the container is broken from here on: fewer payloads than it states
        if found:
            return found, stated
    return [], 0
