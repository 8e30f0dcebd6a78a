"""CSV tables of dives: one per line, with settings of its own in the other columns.

    dive,name,preset,fps,splat.iterations
    tapes/reef.mp4,reef,fast,2,
    stills/wall,,,,8000

`dive` is a video or a folder of images. Settings stand under their names in settings.yaml, those of frames and of scale
also alone; an empty cell leaves the command's value. Paths are relative to the table.
"""

import csv
import difflib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from swimm3r.batch.dive import Dive, check_names
from swimm3r.errors import Swimm3rError, UsageError
from swimm3r.io.files.damage import Remedy, first_line, guard
from swimm3r.pipeline.presets import Preset, RunSettings
from swimm3r.pipeline.run_settings import starting_settings
from swimm3r.scale.settings import ScaleSettings, resolved
from swimm3r.scene.settings import FrameSettings
from swimm3r.settings import SettingError, Settings, accepted, declarations
from swimm3r.settings_document import from_document, to_document
from swimm3r.sfm.settings import BackendName
from swimm3r.splat.settings import RecipeName

_OWN = ("dive", "name", "preset", "backend", "recipe", "reference")
_SHORT: Mapping[str, type[Settings]] = {"frames": FrameSettings, "scale": ScaleSettings}  # whose names may stand alone
_KINDS: Mapping[str, Any] = {"preset": Preset, "backend": BackendName, "recipe": RecipeName}
_REMEDY = Remedy(
    cause="it is no table, or not saved as UTF-8",
    hint="a CSV file whose first line names the columns, one of them `dive`",
    fault="cannot be used",
)


def read_sheet(path: Path, settings: RunSettings, reference: Path | None = None) -> list[Dive]:
    """The dives of a table. A row's `preset` replaces the settings of the command, its other columns single ones.

    Raises InputError where the file cannot be read as a table, and UsageError where a column or a cell cannot be used.
    """
    with guard(path, _REMEDY), _csv_faults():
        text = path.read_text(encoding="utf-8-sig")
        head = (text.splitlines() or [""])[0]
        comma = ";" if head.count(";") > head.count(",") else ","  # spreadsheets of some countries
        rows = csv.DictReader(text.splitlines(), delimiter=comma, strict=True)
        columns = [name.strip() for name in rows.fieldnames or ()]
        rows.fieldnames = columns
        cells = [(rows.line_num, row) for row in rows]
    _check_columns(path, columns)
    dives = [
        _dive(path, line, {name: (value or "").strip() for name, value in row.items() if name}, settings, reference)
        for line, row in cells
        if any(isinstance(value, str) and value.strip() for value in row.values())
    ]
    check_names(dives)
    return dives


@contextmanager
def _csv_faults() -> Iterator[None]:
    try:
        yield
    except csv.Error as error:
        raise ValueError(str(error)) from error


def _check_columns(path: Path, columns: list[str]) -> None:
    if "dive" not in columns:
        raise UsageError(
            f"{path} has no column `dive`",
            cause=f"its columns are {', '.join(columns) or 'none'}",
            hint="a first line that names the columns: dive, and such settings as preset, fps or splat.iterations",
        )
    if len(set(columns)) < len(columns):
        raise UsageError(f"{path} has two columns of one name", cause=", ".join(columns), hint="one column for each")
    known = [*_OWN, *(name for kind in _SHORT.values() for name in declarations(kind))]
    unknown = [name for name in columns if name not in known and name.split(".")[0] not in declarations(RunSettings)]
    if unknown:
        near = [match for name in unknown for match in difflib.get_close_matches(name, known, 1)]
        raise UsageError(
            f"{path} has columns that are no settings: {', '.join(map(repr, unknown))}",
            cause=f"a slip in the name (similar: {', '.join(near)})" if near else "settings have a dotted name",
            hint="a name as in settings.yaml of a run folder (splat.iterations), without dots one of "
            + ", ".join(known),
        )


def _dive(path: Path, line: int, cells: dict[str, str], settings: RunSettings, reference: Path | None) -> Dive:
    given = {name: text for name, text in cells.items() if text}
    try:
        if "dive" not in given:
            raise ValueError("it names no dive")
        chosen = {name: accepted(name, given.get(name), kind | None) for name, kind in _KINDS.items()}
        own = starting_settings(chosen["preset"], chosen["backend"], chosen["recipe"], settings)
        own = replace(own, scale=settings.scale)  # presets say nothing of it
        texts = {_dotted(name): text for name, text in given.items() if name not in _OWN}
        own = with_settings(own, texts, path.parent)
    except SettingError as error:
        raise SettingError(f"{path}, line {line}: {error.name}", error.expected, error.got) from error
    except Swimm3rError as error:
        raise UsageError(f"{path}, line {line}: {error.what}", cause=error.cause, hint=error.hint) from error
    except ValueError as error:
        raise UsageError(
            f"{path}, line {line}: {first_line(error)}",
            cause="a slip in the table",
            hint="correct it there; the settings.yaml of any run folder shows every setting",
        ) from error
    source = path.parent / Path(given["dive"]).expanduser()
    stem = source.stem if source.suffix and not source.is_dir() else source.resolve().name
    known = path.parent / Path(given["reference"]).expanduser() if "reference" in given else reference
    return Dive(given.get("name", stem), source, own, known)


def _dotted(name: str) -> str:
    """The name in settings.yaml of a column."""
    return next((f"{part}.{name}" for part, kind in _SHORT.items() if name in declarations(kind)), name)


def with_settings(settings: RunSettings, texts: Mapping[str, str], folder: Path) -> RunSettings:
    """The settings with some of them, by their dotted names, as texts say; paths are relative to a folder.

    Raises ValueError where there is no such setting, and SettingError where it cannot have that value.
    """
    document = to_document(settings)
    for name, text in texts.items():
        *above, last = name.split(".")
        record: Any = settings
        place: Any = document
        for part in above:
            record, place = getattr(record, part, None), place.get(part)
            if not isinstance(record, Settings):
                raise ValueError(f"there is no setting {name}")
        if last not in place or isinstance(place[last], dict):
            raise ValueError(f"there is no setting {name}")
        value = _value(name, text, declarations(type(record))[last])
        place[last] = folder / value.expanduser() if isinstance(value, Path) else value
    changed = from_document(document, RunSettings)
    return replace(changed, scale=resolved(changed.scale))


def _value(name: str, text: str, hint: Any) -> Any:
    """The first reading of a text that a setting can have: a value of YAML, several side by side, texts, one text."""
    words = text.split()
    readings: tuple[Any, ...] = (_plain(text), [_plain(word) for word in words], words, text)
    refused = None
    for reading in readings:
        try:
            return accepted(name, reading, hint)
        except SettingError as error:
            refused = refused or error
    assert refused is not None
    raise refused


def _plain(text: str) -> Any:
    import yaml

    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return text
