"""Settings as documents of plain values (YAML files, headers of maps), and back.

A record is a mapping of its fields by name. Where a field may hold one of several records, the mapping says which by
`kind`, the name of its class; without it the record is of the kind that the field has by default. Fields that are
absent have their defaults; whatever else is not as declared is refused by its name in the document.
"""

import difflib
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any, TypeVar, get_args

from swimm3r.settings import Settings, accepted, declarations

_KIND = "kind"

Record = TypeVar("Record", bound=Settings)


def to_document(settings: Settings) -> dict[str, Any]:
    """The document of a record."""
    return {
        field.name: _plain(getattr(settings, field.name), len(_kinds(type(settings), field)) > 1)
        for field in fields(settings)  # pyright: ignore[reportArgumentType] - every record is a dataclass
    }


def from_document(document: Any, kind: type[Record], place: str = "") -> Record:
    """The record that a document describes. Raises ValueError, which names the place in the document."""
    known = {field.name: field for field in fields(kind)}  # pyright: ignore[reportArgumentType]
    document = _mapping(document, place)
    for key in document:
        if key not in known:
            near = difflib.get_close_matches(str(key), known, 1)
            raise ValueError(f"there is no setting {place}{key}" + "".join(f" (similar: {place}{n})" for n in near))
    values = {}
    for name, value in document.items():
        kinds, where = _kinds(kind, known[name]), f"{place}{name}"
        values[name] = (
            _record(value, kinds, known[name], where) if kinds else accepted(where, value, declarations(kind)[name])
        )
    for name, field in known.items():
        if name not in values and field.default is MISSING and field.default_factory is MISSING:
            raise ValueError(f"there is no {place}{name}")
    return kind(**values)


def _record(document: Any, kinds: tuple[type[Settings], ...], field: Field, place: str) -> Settings:
    document = dict(_mapping(document, place))
    by_name = {kind.__name__: kind for kind in kinds}
    name = kinds[0].__name__
    if len(by_name) > 1:
        default = field.default if field.default_factory is MISSING else field.default_factory()
        name = document.pop(_KIND, type(default).__name__)
        if name not in by_name:
            raise ValueError(f"{place}.{_KIND} must be one of {', '.join(by_name)}, got {name!r}")
    return from_document(document, by_name[name], f"{place}.")


def _mapping(document: Any, place: str) -> dict[str, Any]:
    if not isinstance(document, dict):
        raise ValueError(f"{place.rstrip('.') or 'the whole'} must be a mapping of settings, got {document!r:.60}")
    return document


def _kinds(owner: type[Settings], field: Field) -> tuple[type[Settings], ...]:
    """The records that a field may hold; none for a plain value."""
    hint = declarations(owner)[field.name]
    return tuple(kind for kind in get_args(hint) or (hint,) if isinstance(kind, type) and issubclass(kind, Settings))


def _plain(value: Any, tagged: bool) -> Any:
    if isinstance(value, Settings):
        return {_KIND: type(value).__name__, **to_document(value)} if tagged else to_document(value)
    if isinstance(value, tuple):
        return [_plain(element, False) for element in value]
    return str(value) if isinstance(value, Path) else value
