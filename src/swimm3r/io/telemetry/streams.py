"""Payloads of a clip -> streams: scaled, in named axes, every sample with its time.

    value = MTRX number / SCAL          per channel; MTRX where the camera states it, then axes are those of ORIO
    time of sample i of n               begin of the payload + i / n (begin of the next payload - begin)

The begin of a payload is the camera's clock (STMP) where every payload of the stream states it, moved to the track's
time by the median difference of all; else the payload's own time in the track.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from swimm3r.io.telemetry.klv import Element, numbers, parse, text, texts
from swimm3r.io.telemetry.record import Stream

_ABOUT = {  # elements that describe a stream, and are none
    *("DVID", "DVNM", "STMP", "TSMP", "STNM", "ORIN", "ORIO", "MTRX", "SIUN", "UNIT", "SCAL", "TYPE", "TICK", "TOCK"),
    *("EMPT", "TIMO", "QUAN", "RMRK", "VERS", "FREE", "TMPC", "GPSF", "GPSU", "GPSP", "GPSA"),
}
_BEFORE_ORIN = "ZXY"  # of ACCL and GYRO of the cameras that do not state it, HERO5 to HERO7
_UNITS = {  # of streams that come without
    **{"GRAV": "1", "CORI": "1", "IORI": "1", "WRGB": "1", "WBAL": "K", "ISOE": "ISO", "ISOG": "1", "TMPC": "degC"},
    "SHUT": "s",
}
_GPS9 = ("deg", "deg", "m", "m/s", "m/s", "d", "s", "1", "1")
_GPS = ("latitude", "longitude", "height", "speed_2d", "speed_3d")
_CHANNELS = {
    "GRAV": ("X", "Z", "Y"),
    "CORI": ("w", "x", "y", "z"),
    "IORI": ("w", "x", "y", "z"),
    "WRGB": ("red", "green", "blue"),
    "GPS5": _GPS,
    "GPS9": (*_GPS, "days", "seconds", "dop", "fix"),
}


@dataclass(frozen=True)
class Payload:
    """One packet of the telemetry's track."""

    begin: float  # seconds of the clip
    seconds: float
    data: bytes


@dataclass
class _Parts:
    """A stream as its payloads come in."""

    device: str
    name: str = ""
    units: tuple[str, ...] = ()
    axes: str = ""
    payloads: list[Payload] = field(default_factory=list)
    clocks: list[float | None] = field(default_factory=list)
    blocks: list[Float[np.ndarray, "n k"]] = field(default_factory=list)


def streams_of(payloads: Sequence[Payload]) -> tuple[tuple[Stream, ...], tuple[str, ...], int]:
    """The streams of numbers, the keys of the others, and the number of payloads that are damaged."""
    found: dict[tuple[str, str], _Parts] = {}
    others: dict[str, None] = {}
    damaged = 0
    for payload in payloads:
        try:
            samples = _samples(parse(payload.data))
        except ValueError:
            damaged += 1
            continue
        for device, key, about, block in samples:
            if block is None:
                others[key] = None
                continue
            parts = found.setdefault((device, key), _Parts(device))
            if parts.blocks and parts.blocks[0].shape[1] != block.shape[1]:
                others[key] = None
                continue
            _describe(parts, key, about, block.shape[1])
            parts.payloads.append(payload)
            parts.clocks.append(_clock(about))
            parts.blocks.append(block)
    offset = _clock_offset(found.values())
    streams = tuple(_stream(key, parts, offset) for (_, key), parts in found.items())
    return tuple(stream for stream in streams if len(stream)), tuple(others), damaged


def _samples(
    elements: Sequence[Element],
) -> list[tuple[str, str, dict[str, Element], Float[np.ndarray, "n k"] | None]]:
    """Device, key, describing elements and values (None: no numbers) of every stream of a payload."""
    found = []
    for device in elements:
        if device.key != "DEVC":
            continue
        titles = [text(child) for child in device.children if child.key == "DVNM"]
        name = titles[0] if titles else ""
        for stream in device.children:
            if stream.key != "STRM" or not stream.children:
                continue
            about = {child.key: child for child in stream.children}
            key = stream.children[-1].key
            if "TMPC" in about and key != "TMPC":
                temperature = {k: about[k] for k in about.keys() & {"STMP"}}
                found.append((name, f"{key}.TMPC", temperature, numbers(about["TMPC"])))
            if key not in _ABOUT or key == "TMPC":
                data = [child for child in stream.children if child.key == key]
                found.append((name, key, about, _values(data, about)))
    return found


def _values(data: Sequence[Element], about: dict[str, Element]) -> Float[np.ndarray, "n k"] | None:
    """The values of a stream in one payload; None where they are no numbers, or lists of varying length."""
    types = text(about["TYPE"]) if "TYPE" in about else ""
    blocks = [numbers(element, types) for element in data]
    if any(block is None for block in blocks):
        return None
    rows = [block for block in blocks if block is not None]
    if "SCAL" in about:
        scale = numbers(about["SCAL"])
        if scale is None or not scale.all() or scale.size not in (1, rows[0].shape[1]):
            raise ValueError(f"SCAL of {data[0].key} is no divisor of its channels")
        rows = [block / scale.ravel() for block in rows]
    if len(rows) > 1:  # several elements: one sample each, a list of its rows
        if len({block.size for block in rows}) > 1 or not rows[0].size:
            return None
        return np.stack([block.ravel() for block in rows])
    return _turned(rows[0], about)


def _turned(values: Float[np.ndarray, "n k"], about: dict[str, Element]) -> Float[np.ndarray, "n k"]:
    """The values with the camera's matrix applied, in the order X, Y, Z where they have axes."""
    axes = _axes(about)
    if "MTRX" in about:
        matrix = numbers(about["MTRX"])
        if matrix is None or matrix.size != values.shape[1] ** 2:
            raise ValueError("MTRX does not fit the channels")
        values = values @ matrix.reshape(values.shape[1], -1).T
    if sorted(axes.upper()) != ["X", "Y", "Z"] or values.shape[1] != 3:
        return values
    places = [axes.upper().index(axis) for axis in "XYZ"]
    return values[:, places] * [-1.0 if axes[place].islower() else 1.0 for place in places]


def _axes(about: dict[str, Element]) -> str:
    """Letters of the channels' axes, lower case where they point the other way; "" where there are none."""
    if "MTRX" in about and "ORIO" in about:
        return text(about["ORIO"])
    if "ORIN" in about:
        return text(about["ORIN"])
    return _BEFORE_ORIN if about.keys() & {"ACCL", "GYRO"} else ""


def _describe(parts: _Parts, key: str, about: dict[str, Element], width: int) -> None:
    parts.name = parts.name or (text(about["STNM"]) if "STNM" in about else "")
    parts.axes = parts.axes or ("XYZ" if width == 3 and sorted(_axes(about).upper()) == ["X", "Y", "Z"] else "")
    stated = texts(about["SIUN"]) if "SIUN" in about else texts(about["UNIT"]) if "UNIT" in about else ()
    own = _GPS9 if key == "GPS9" else (_UNITS.get(key.rpartition(".")[2], ""),)
    parts.units = parts.units or (stated if any(stated) else own)


def _clock(about: dict[str, Element]) -> float | None:
    """Seconds on the camera's clock at the first sample."""
    stamp = numbers(about["STMP"]) if "STMP" in about else None
    return float(stamp.ravel()[0]) * 1e-6 if stamp is not None and stamp.size else None


def _clock_offset(streams: Iterable[_Parts]) -> float:
    """Track time less clock time, the median of all payloads that state both."""
    differences = [
        payload.begin - clock
        for parts in streams
        for payload, clock in zip(parts.payloads, parts.clocks, strict=True)
        if clock is not None
    ]
    return float(np.median(differences)) if differences else 0.0


def _stream(key: str, parts: _Parts, offset: float) -> Stream:
    begins = np.array([payload.begin for payload in parts.payloads])
    clocks = np.array([np.nan if clock is None else clock for clock in parts.clocks])
    if np.isfinite(clocks).all() and (np.diff(clocks) > 0).all():
        begins = clocks + offset
    counts = np.array([len(block) for block in parts.blocks])
    lengths = np.array([payload.seconds for payload in parts.payloads])
    spans = np.minimum(np.append(np.diff(begins), lengths[-1]), 1.5 * lengths)  # over a gap, the payload's own length
    rate = _rate(counts[:-1], spans[:-1]) or _rate(counts, spans)
    if rate:  # the last payload may end before its length
        spans[-1] = counts[-1] / rate
    time = [
        begin + span * np.arange(count) / max(count, 1)
        for begin, span, count in zip(begins, spans, counts, strict=True)
    ]
    values = np.concatenate(parts.blocks)
    width = values.shape[1]
    channels = tuple(parts.axes) or _CHANNELS.get(key, ())
    return Stream(
        key=key,
        device=parts.device,
        name=parts.name,
        units=parts.units if len(parts.units) == width else parts.units[:1] * width,
        channels=channels if len(channels) == width else tuple(f"value_{k}" for k in range(width)),
        time=np.concatenate(time),
        values=values,
        rate=rate,
    )


def _rate(counts: Int[np.ndarray, " p"], spans: Float[np.ndarray, " p"]) -> float:
    """Samples per second of some payloads; 0 where they have no length."""
    return float(counts.sum() / spans.sum()) if spans.sum() > 0 else 0.0
