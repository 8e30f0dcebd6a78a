"""Settings records: frozen dataclasses whose fields carry the values they may have, checked when one is made.

    @dataclass(frozen=True)
    class FeatureSettings(Settings):
        count: Count = 2048
        max_ratio: Annotated[float, Range(above=0, most=1)] = 0.8

The check is the same for the command line, for files and for Python: types (whole numbers stand for floats, lists for
tuples, strings for paths, and are stored as such), the options of a Literal, and the declared ranges. Numbers are
finite. Combinations of fields are checked by the record's own `__post_init__`, after `super()`'s.
"""

import math
import os
import reprlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from swimm3r.errors import UsageError

_LARGEST = 1e9  # beyond any use, and no sum or power of it leaves float32 and int64


class SettingError(UsageError, ValueError):
    """A setting has a value that it cannot have."""

    def __init__(self, name: str, expected: str, got: str) -> None:
        super().__init__(
            f"{name} must be {expected}, got {got}".lstrip(),
            cause="a slip in the command, the file or the call that gave it",
            hint="leave it out for the default; swimm3r COMMAND --help-all shows the ranges",
        )
        self.name, self.expected, self.got = name, expected, got

    def __reduce__(self) -> tuple:
        return type(self), (self.name, self.expected, self.got)  # between processes


@dataclass(frozen=True)
class Range:
    """Numbers from `least` to `most`, both included, or strictly `above` and `below`; and 0 where it means "off"."""

    least: float | None = None
    most: float | None = None
    above: float | None = None
    below: float | None = None
    or_zero: bool = False

    def allows(self, value: float) -> bool:
        """Return whether a number lies in the range."""
        if self.or_zero and value == 0:
            return True
        return (
            (-_LARGEST if self.least is None else self.least) <= value
            and value <= (_LARGEST if self.most is None else self.most)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
        )

    def brief(self, kind: str) -> str:
        """The range as help shows it: `0..1`, `FLOAT>0`, `0|INT>=32`."""
        low, high = self._low(), self._high()
        if low and high:
            closed = (low[0], high[0]) == (">=", "<=")
            text = f"{low[1]}..{high[1]}" if closed else f"{low[1]}{low[0].replace('>', '<')}{kind}{''.join(high)}"
        else:
            text = f"{kind}{''.join(low or high or ())}"
        return f"0|{text}" if self.or_zero else text

    def _low(self) -> tuple[str, str] | None:
        if self.above is not None:
            return ">", _figure(self.above)
        return None if self.least is None else (">=", _figure(self.least))

    def _high(self) -> tuple[str, str] | None:
        if self.below is not None:
            return "<", _figure(self.below)
        return None if self.most is None else ("<=", _figure(self.most))

    def __str__(self) -> str:
        words = {">": "above", ">=": "at least", "<": "below", "<=": "at most"}
        bounds = [f"{words[bound[0]]} {bound[1]}" for bound in (self._low(), self._high()) if bound]
        if not self._high():
            bounds.append(f"at most {_figure(_LARGEST)}")
        return " and ".join(bounds) + (", or 0" if self.or_zero else "")


@dataclass(frozen=True)
class NotEmpty:
    """At least one element."""

    def allows(self, value: tuple) -> bool:
        """Return whether there is one."""
        return len(value) > 0

    def __str__(self) -> str:
        return "that is not empty"


Count = Annotated[int, Range(1)]
CountOrZero = Annotated[int, Range(0)]
ImageSide = Annotated[int, Range(8, 8192)]  # pixels, of a synthetic image
Seed = Annotated[int, Range(0, 2**32 - 1)]
Threads = Annotated[int, Range(0, 1024)]  # 0 is every core
LongSide = Annotated[int, Range(32, 65_536)]  # pixels; smaller images hold no neighborhood that scores look at
LongSideOrOwn = Annotated[int, Range(32, 65_536, or_zero=True)]  # 0 keeps images as they are
NetworkSide = Annotated[int, Range(64, 4096)]  # pixels of the network's images; less leaves wide ones no patch
MapSize = Annotated[int, Range(4)]  # primitives; each has 3 neighbors
ClipSecond = Annotated[float, Range(0, 1e6)]  # eleven days; beyond, containers cannot seek
LensParameter = Annotated[float, Range(-1e6, 1e6)]  # of distortion; k2 of a telephoto lens can be thousands
Share = Annotated[float, Range(0, 1)]
PositiveShare = Annotated[float, Range(above=0, most=1)]
Cadence = Annotated[float, Range(1e-6, 1)]  # share of a run between two events
Opacity = Annotated[float, Range(1e-6, 1 - 1e-6)]  # has a logit in float32
Positive = Annotated[float, Range(above=0)]
NotNegative = Annotated[float, Range(0)]
Rate = Annotated[float, Range(0, 1)]  # of an optimizer; 0 keeps what it moves
DecayingRate = Annotated[float, Range(above=0, most=1)]  # one end of a log-linear decay


class Settings:
    """Base of settings records: makes a frozen dataclass check its fields against their declarations."""

    def __post_init__(self) -> None:
        for name, hint in declarations(type(self)).items():
            given = getattr(self, name)
            value = accepted(f"{type(self).__name__}.{name}", given, hint)
            if value is not given:
                object.__setattr__(self, name, value)


def accepted(name: str, value: Any, hint: Any) -> Any:
    """The value as a type hint has it. Raises SettingError under that name where the hint does not allow it."""
    found = _accepted(value, hint)
    if found is _REFUSED:
        raise SettingError(name, description(hint), reprlib.repr(value))
    return found


@cache
def declarations(cls: type) -> dict[str, Any]:
    """The declared type of every field, ranges included."""
    hints = get_type_hints(cls, include_extras=True)
    return {field.name: hints[field.name] for field in fields(cls)}


def ranges_of(hint: Any) -> Iterator[Range]:
    """The ranges that a type hint declares, of elements and options too."""
    parts = get_args(hint)
    if get_origin(hint) is Annotated:
        yield from (rule for rule in parts[1:] if isinstance(rule, Range))
        parts = parts[:1]
    for part in parts:
        yield from ranges_of(part)


def description(hint: Any) -> str:
    """The values that a type hint allows, in words."""
    if get_origin(hint) is Annotated:
        kind, *rules = get_args(hint)
        return " ".join([description(kind), *(str(rule) for rule in _rules(rules))])
    match get_origin(hint), get_args(hint):
        case (origin, options) if origin is Literal:
            return f"one of {', '.join(map(str, options))}"
        case (origin, kinds) if origin in (Union, UnionType):
            return ", or ".join("None" if kind is NoneType else description(kind) for kind in kinds)
        case (origin, (kind, end)) if origin is tuple and end is Ellipsis:
            return f"a list ({description(kind)} each)"
        case (origin, kinds) if origin is tuple:
            return f"{len(kinds)} values ({' and '.join(dict.fromkeys(map(description, kinds)))} each)"
    return _WORDS.get(hint) or f"a {getattr(hint, '__name__', hint)}"


_WORDS = {int: "a whole number", float: "a number", bool: "True or False", str: "a text", Path: "a path"}
_REFUSED = object()


def _figure(number: float) -> str:
    return f"{number:d}" if isinstance(number, int) else f"{number:g}"


def _rules(metadata: Iterable[Any]) -> list[Range | NotEmpty]:
    return [rule for rule in metadata if isinstance(rule, Range | NotEmpty)]


def _accepted(value: Any, hint: Any) -> Any:
    """The value converted to what the hint names; `_REFUSED` where it is something else or outside its range."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        value = _accepted(value, parts[0])
        allowed = value is not _REFUSED and all(rule.allows(value) for rule in _rules(parts[1:]))
        return value if allowed else _REFUSED
    if origin is Literal:
        return value if any(type(value) is type(option) and value == option for option in parts) else _REFUSED
    if origin in (Union, UnionType):
        return next((found for part in parts if (found := _accepted(value, part)) is not _REFUSED), _REFUSED)
    if origin is tuple:
        return _accepted_tuple(value, parts)
    return _accepted_single(value, hint)


def _accepted_tuple(value: Any, parts: tuple[Any, ...]) -> Any:
    if not isinstance(value, tuple | list):
        return _REFUSED
    if parts[-1] is Ellipsis:
        parts = (parts[0],) * len(value)
    if len(parts) != len(value):
        return _REFUSED
    found = tuple(_accepted(element, part) for element, part in zip(value, parts, strict=True))
    if _REFUSED in found:
        return _REFUSED
    unchanged = isinstance(value, tuple) and all(a is b for a, b in zip(value, found, strict=True))
    return value if unchanged else found


def _accepted_single(value: Any, kind: type) -> Any:
    if kind is float:
        return _finite(value) if isinstance(value, Real) and not isinstance(value, bool) else _REFUSED
    if kind is int:
        if not isinstance(value, Integral) or isinstance(value, bool):
            return _REFUSED
        return value if type(value) is int else int(value)
    if kind is Path and isinstance(value, str | os.PathLike):
        return value if isinstance(value, Path) else Path(value)
    return value if isinstance(value, kind) else _REFUSED


def _finite(value: Any) -> Any:
    try:
        number = float(value)
    except OverflowError:  # a whole number beyond all floats
        return _REFUSED
    return number if math.isfinite(number) else _REFUSED
