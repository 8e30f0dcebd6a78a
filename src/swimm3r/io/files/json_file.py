"""JSON files read back into typed records, strictly: a file that is not what its record says is refused by name.

A record is a frozen dataclass defined beside the function that writes the file. Its fields are int, float, bool, str,
Literal, tuple, dict[str, ...], Optional or further records; a field with a default may be absent, keys that a record
does not have are ignored, so that files of later versions stay readable. Numbers are finite, no text or flag stands for
a number, and whatever else must hold is a ValueError of the record's `__post_init__`.
"""

import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from types import GenericAlias
from typing import TYPE_CHECKING, Any, Literal, TypeVar, cast, get_args, get_origin

from swimm3r.io.files.damage import Remedy, first_line, guard

if TYPE_CHECKING:
    from cattrs import Converter

T = TypeVar("T")


def read_json(path: Path, kind: type[T] | GenericAlias, remedy: Remedy) -> T:
    """The record that a JSON file holds. Raises the remedy's error, which names the file and the fault."""
    with guard(path, remedy):
        return parse_json(path.read_bytes(), kind)


def parse_json(text: str | bytes, kind: type[T] | GenericAlias) -> T:
    """The record that JSON text holds. Raises ValueError (or RecursionError) that names the place of the fault."""
    return structure(decode(text), kind)


def decode(text: str | bytes) -> Any:
    """JSON text as plain values. Raises ValueError for what is not JSON in UTF-8."""
    return json.loads(text if isinstance(text, str) else text.decode("utf-8"))


def structure(document: Any, kind: type[T] | GenericAlias) -> T:
    """The record that a decoded JSON document holds. Raises ValueError that names the place of the fault."""
    from cattrs.errors import BaseValidationError

    try:
        return _converter().structure(document, cast("type[T]", kind))
    except (BaseValidationError, _PlacedError, TypeError) as error:
        raise ValueError(_first_fault(error)) from error


class _PlacedError(ValueError):
    """A fault inside a list or an object, with its place there."""

    def __init__(self, place: str, fault: Exception) -> None:
        super().__init__(place)
        self.place, self.fault = place, fault


def _first_fault(error: BaseException, place: str = "") -> str:
    """The first of the collected faults, after its place in the document: frames[3].c2w[0]: ..."""
    from cattrs.errors import AttributeValidationNote, BaseValidationError

    if isinstance(error, _PlacedError):
        return _first_fault(error.fault, place + error.place)
    if isinstance(error, BaseValidationError):
        inner = error.exceptions[0]
        names = [note.name for note in getattr(inner, "__notes__", ()) if isinstance(note, AttributeValidationNote)]
        absent = isinstance(inner, KeyError) or not names
        return _first_fault(inner, place if absent else f"{place}.{names[0]}")
    said = f"there is no {error.args[0]}" if isinstance(error, KeyError) else first_line(error)
    return f"{place.lstrip('.')}: {said}" if place else said


@cache
def _converter() -> "Converter":
    from cattrs import Converter

    converter = Converter()
    for kind in (int, float, bool, str):
        converter.register_structure_hook(kind, _plain)
    converter.register_structure_hook_factory(is_dataclass, _record_hook)
    converter.register_structure_hook_func(lambda kind: get_origin(kind) is Literal, _one_of)
    converter.register_structure_hook_factory(lambda kind: get_origin(kind) is tuple, _tuple_hook)
    converter.register_structure_hook_factory(lambda kind: get_origin(kind) is dict, _dict_hook)
    return converter


def _plain(value: Any, kind: type) -> Any:
    if kind is float and type(value) in (int, float):
        if not abs(value) < math.inf or abs(value) > sys.float_info.max:  # whole numbers have no bound in JSON
            raise ValueError("a finite number is expected")
        return float(value)
    if type(value) is not kind:
        raise TypeError(f"{_SAID[kind]} is expected, got {_said(value)}")
    return value


def _one_of(value: Any, kind: Any) -> Any:
    if value not in get_args(kind):
        raise ValueError(f"one of {', '.join(map(str, get_args(kind)))} is expected, got {_said(value)}")
    return value


def _record_hook(kind: Any, converter: "Converter") -> Callable:
    from cattrs.gen import make_dict_structure_fn

    fill = make_dict_structure_fn(kind, converter)

    def hook(value: Any, _: Any) -> Any:
        return fill(_required(value, dict), kind)

    return hook


def _dict_hook(kind: Any, converter: "Converter") -> Callable:
    inner = get_args(kind)[1]

    def hook(value: Any, _: Any) -> Any:
        pairs = _required(value, dict)
        found = _each(pairs.values(), [inner] * len(pairs), (f".{key}" for key in pairs))
        return dict(zip(pairs, found, strict=True))

    return hook


def _tuple_hook(kind: Any, converter: "Converter") -> Callable:
    inner = get_args(kind)
    any_length = inner[-1] is Ellipsis

    def hook(value: Any, _: Any) -> Any:
        values = _required(value, list)
        if not any_length and len(values) != len(inner):
            raise ValueError(f"{len(inner)} values are expected, got {len(values)}")
        kinds = [inner[0]] * len(values) if any_length else list(inner)
        return tuple(_each(values, kinds, (f"[{i}]" for i in range(len(values)))))

    return hook


def _each(values: Iterable, kinds: Iterable, places: Iterable[str]) -> Iterator:
    """The structured values one by one; a fault bears its place."""
    converter = _converter()
    for value, kind, place in zip(values, kinds, places, strict=True):
        try:
            yield converter.structure(value, kind)
        except Exception as error:  # whatever it is, it is passed on with its place
            raise _PlacedError(place, error) from error


def _required(value: Any, kind: type[T]) -> T:
    if not isinstance(value, kind):
        raise TypeError(f"{_SAID[kind]} is expected, got {_said(value)}")
    return value


_SAID: dict[type, str] = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "a text",
    list: "a list",
    dict: "an object",
    type(None): "null",
}


def _said(value: Any) -> str:
    kind, shown = _SAID.get(type(value), type(value).__name__), json.dumps(value, default=str)
    if isinstance(value, bool):
        return shown
    return f"{kind} ({shown})" if isinstance(value, int | float | str) and len(shown) <= 40 else kind
