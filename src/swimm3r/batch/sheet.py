"""CSV tables of dives: one per line, with settings of its own in the other columns.

    dive,name,preset,fps,splat.iterations
    tapes/reef.mp4,reef,fast,2,
    stills/wall,,,,8000

`dive` is a video or a folder of images, relative to the table. Settings stand under their names in settings.yaml, those
of frames also alone; an empty cell leaves the command's value.
"""

import csv
import difflib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from swimm3r.batch.dive import Dive, check_names
from swimm3r.errors import Swimm3rError, UsageError
from swimm3r.io.files.damage import Remedy, first_line, guard
from swimm3r.pipeline.presets import Preset, RunSettings
from swimm3r.pipeline.run_settings import starting_settings
from swimm3r.scene.settings import FrameSettings
from swimm3r.settings import SettingError, accepted, declarations
from swimm3r.settings_document import from_document, to_document
from swimm3r.sfm.settings import BackendName
from swimm3r.splat.settings import RecipeName

_OWN = ("dive", "name", "preset", "backend", "recipe", "reference")
_PLACES = ("dive", "reference", "frames.masks")  # paths that are relative to the table
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
    known = [*_OWN, *declarations(FrameSettings)]
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
    given = {(f"frames.{name}" if name in declarations(FrameSettings) else name): v for name, v in cells.items() if v}
    for name in _PLACES:
        if name in given:
            given[name] = str(path.parent / Path(given[name]).expanduser())
    try:
        if "dive" not in given:
            raise ValueError("it names no dive")
        chosen = {name: accepted(name, given.get(name), kind | None) for name, kind in _KINDS.items()}
        own = starting_settings(chosen["preset"], chosen["backend"], chosen["recipe"], settings)
        for name, value in given.items():
            if name not in _OWN:
                own = with_setting(own, name, value)
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
    source = Path(given["dive"])
    stem = source.stem if source.suffix and not source.is_dir() else source.resolve().name
    known = Path(given["reference"]) if "reference" in given else reference
    return Dive(given.get("name", stem), source, own, known)


def with_setting(settings: RunSettings, name: str, text: str) -> RunSettings:
    """The settings with one of them, by its dotted name, as a text says; a text that is no other value stays a text.

    Raises ValueError where there is no such setting, and SettingError where it cannot have that value.
    """
    import yaml

    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        value = text
    try:
        return _replaced(settings, name, value)
    except SettingError:
        if isinstance(value, str):
            raise
        return _replaced(settings, name, text)


def _replaced(settings: RunSettings, name: str, value: object) -> RunSettings:
    document = to_document(settings)
    *above, last = name.split(".")
    place: Any = document
    for part in above:
        if not isinstance(place.get(part), dict):
            raise ValueError(f"there is no setting {name}")
        place = place[part]
    place[last] = value
    return from_document(document, RunSettings)
