"""CSV and other tables with named columns (`columns`) -> navigation; comma, semicolon or tab between the cells.

Tables with the columns source, target, x, y, z, qx, qy, qz, qw hold transforms between a world and a camera or vehicle,
X_target = R X_source + t. Positions are those of the camera's or vehicle's origin in the world, whose z is taken as up:
-R^T t where the source is the world, t where the target is.
"""

import csv
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Float

from swimm3r.errors import InputError
from swimm3r.io.navigation.clock import is_date, seconds_of, seconds_of_date, seconds_of_day
from swimm3r.io.navigation.columns import Column, column
from swimm3r.io.navigation.dive_log import depths_alone
from swimm3r.io.navigation.pressure import depth_of_pressure
from swimm3r.io.navigation.record import Clock, Frame, Navigation, vehicle_attitude

_HINT = (
    "columns such as time, latitude, longitude, depth, heading, pitch, roll, or time, easting, northing, depth, with"
    " units in brackets where they are not metres and degrees; see docs/guides/metric-scale.md"
)
_TURN = 2 * np.pi + 1e-6
_TEXTS = ("name", "date", "time", "role", "source", "target")
_TRANSFORM = ("easting", "northing", "height", "qx", "qy", "qz", "qw")
_WORLDS = ("world", "map", "odom", "earth", "enu", "local", "nav", "navigation")
_POSITIONS = ("latitude", "longitude", "easting", "northing")
_BESIDE = {"latitude": "longitude", "easting": "northing"}


def read_table(path: Path) -> Navigation:
    """The navigation in a table whose first line names the columns. Raises InputError that names line and column."""
    cells, columns = read_cells(path)
    values = _values(path, cells, columns)
    if "source" in cells and "target" in cells:
        count = len(cells["source"])
        clock, time = _times(path, cells, columns, count, None)
        return Navigation(path, "local", _origins_in_world(path, cells, values), clock, time)
    if not any(kind in values for kind in _POSITIONS) and any(kind in values for kind in ("depth", "pressure")):
        return _depths_alone(path, cells, columns, values)
    frame, position, std = read_positions(path, cells, columns)
    count = len(position)
    names = tuple(cells["name"]) if "name" in cells else None
    clock, time = _times(path, cells, columns, count, names)
    known = [kind in values for kind in ("heading", "pitch", "roll")]
    attitude = None
    if any(known):
        angles = [values.get(kind, np.zeros(count)) for kind in ("heading", "pitch", "roll")]
        attitude = vehicle_attitude(*angles) if all(known) else None
    return Navigation(
        path=path,
        frame=frame,
        position=position,
        clock=clock,
        time=time,
        names=names,
        std=std,
        attitude=attitude,
        attitude_std=_columns_of(values, ("std_heading", "std_pitch", "std_roll")),
        altitude=values.get("altitude"),
    )


def _origins_in_world(
    path: Path, cells: dict[str, list[str]], values: dict[str, np.ndarray]
) -> Float[np.ndarray, "n 3"]:
    """Origins of the camera or vehicle in the world, of transforms between both."""
    from scipy.spatial.transform import Rotation

    missing = [kind for kind in _TRANSFORM if kind not in values]
    ends = {(source.lower(), target.lower()) for source, target in zip(cells["source"], cells["target"], strict=True)}
    worlds = [(source in _WORLDS, target in _WORLDS) for source, target in ends]
    if missing:
        names: dict[str, str] = {"easting": "x", "northing": "y", "height": "z"}
        _refuse(path, f"it has transforms without {', '.join(names.get(kind, kind) for kind in missing)}")
    if len(ends) != 1 or worlds[0][0] == worlds[0][1]:
        stated = ", ".join(f"{source} to {target}" for source, target in sorted(ends)[:3])
        _refuse(path, f"its transforms are {stated}, and one end has to be the world",
                hint=f"rows of one camera or vehicle, with a source or target named {', '.join(_WORLDS)}")  # fmt: skip
    t = np.stack([values[kind] for kind in _TRANSFORM[:3]], -1)
    quaternion = np.stack([values[kind] for kind in _TRANSFORM[3:]], -1)
    if not (np.linalg.norm(quaternion, axis=1) > 0.1).all():
        _refuse(path, "a quaternion is zero or missing")
    if worlds[0][1]:
        return t
    return -Rotation.from_quat(quaternion).inv().apply(t)


def _depths_alone(
    path: Path, cells: dict[str, list[str]], columns: dict[str, Column], values: dict[str, np.ndarray]
) -> Navigation:
    """A table of times and depths, as dive computers and loggers write it; rows without a depth are left out."""
    count = len(cells["time"]) if "time" in cells else 0
    if not count:
        _refuse(path, "it has depths and no times")
    height, _ = _heights(path, values, count)
    _, time = _times(path, cells, columns, count, None)
    known = np.isfinite(height)
    if not known.any():
        _refuse(path, "none of its rows has a depth")
    return depths_alone(path, time[known], -height[known])


def read_positions(
    path: Path, cells: dict[str, list[str]], columns: dict[str, Column]
) -> tuple[Frame, np.ndarray, np.ndarray | None]:
    """The kind of coordinates, positions and their standard deviations, of rows of cells."""
    values = _values(path, cells, columns)
    count = len(next(iter(cells.values()), []))
    first = next((kind for kind in _BESIDE if kind in values and _BESIDE[kind] in values), None)
    if first is None:
        _refuse(path, f"its columns are {', '.join(cells) or 'none that is known'}, and no two give a position")
    _check_angles(path, values, columns)
    position = np.stack([values[first], values[_BESIDE[first]], np.zeros(count)], -1)
    position[:, 2], has_height = _heights(path, values, count)
    return "geodetic" if first == "latitude" else "projected", position, _stds(values, count, has_height)


def _values(path: Path, cells: dict[str, list[str]], columns: dict[str, Column]) -> dict[str, np.ndarray]:
    """The numbers of a table by the kind of their column, in the unit of the kind."""
    return {kind: _numbers(path, cells[kind], columns[kind]) for kind in cells if kind not in _TEXTS}


def read_cells(path: Path) -> tuple[dict[str, list[str]], dict[str, Column]]:
    """The cells of a table by the kind of their column, and the columns; unknown columns are left out."""
    try:
        lines = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    except UnicodeDecodeError:
        _refuse(path, "it is not UTF-8 text")
    while lines and lines[0].startswith("#") and "," not in lines[0]:
        lines.pop(0)
    if len(lines) < 2:
        _refuse(path, "it has no rows below a line of column names")
    titles = lines[0].lstrip("#").strip()
    separator = max(",;\t", key=titles.count)
    rows = list(csv.reader([titles, *lines[1:]], delimiter=separator))
    try:
        found = [column(title) for title in rows[0]]
    except ValueError as error:
        _refuse(path, str(error))
    columns, cells = {}, {}
    for k, known in enumerate(found):
        if known is None:
            continue
        if known.kind in cells:
            _refuse(path, f"two of its columns are the {known.kind}: {', '.join(rows[0])}")
        columns[known.kind] = known
        cells[known.kind] = [row[k].strip() if k < len(row) else "" for row in rows[1:]]
    return cells, columns


def _numbers(path: Path, cells: list[str], about: Column) -> np.ndarray:
    values = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        if cell:
            try:
                values[i] = float(cell)
            except ValueError:
                _refuse(path, f"line {i + 2}: the {about.kind} is {cell!r}, which is no number")
    return values * about.factor


def _check_angles(path: Path, values: dict[str, np.ndarray], columns: dict[str, Column]) -> None:
    """Refuse angles whose numbers contradict their unit."""
    for kind in ("latitude", "longitude", "heading", "pitch", "roll"):
        if kind in values and columns[kind].factor != 1.0 and (np.abs(values[kind]) > 2.001 * 180).any():
            largest = np.nanmax(np.abs(values[kind])) / columns[kind].factor
            cause = "degrees in a column that states radians"
            _refuse(path, f"its {kind} is stated in {columns[kind].unit} and is {largest:g}", cause=cause)
    if "latitude" in values and columns["latitude"].unit is None and columns["longitude"].unit is None:
        latitude, longitude = np.abs(values["latitude"]), np.abs(values["longitude"])
        if np.nanmax(latitude) <= np.pi / 2 and np.nanmax(longitude) <= np.pi:
            _refuse(path, "its latitudes and longitudes are all within half a turn in radians",
                    cause="radians in columns that should hold degrees",
                    hint="latitude [rad] and longitude [rad] state the unit; [deg], near 0 N 0 E")  # fmt: skip
    attitude = [kind for kind in ("heading", "pitch", "roll") if kind in values]
    if attitude == ["heading", "pitch", "roll"] and all(columns[kind].unit is None for kind in attitude):
        heading = values["heading"]
        if np.nanmax(np.abs(heading)) <= _TURN and np.nanmax(heading) - np.nanmin(heading) > 1.5:
            _refuse(path, f"its headings lie between {np.nanmin(heading):.2f} and {np.nanmax(heading):.2f}",
                    cause="radians in columns that should hold degrees",
                    hint="state the unit: heading [rad], pitch [rad], roll [rad], or [deg]")  # fmt: skip


def _heights(path: Path, values: dict[str, np.ndarray], count: int) -> tuple[np.ndarray, bool]:
    """Heights, and whether there are any; depths and pressures count downwards."""
    for kind in ("depth", "pressure"):
        if kind in values and (values[kind] < -1.0).mean() > 0.5:
            _refuse(path, f"its {kind} is negative in most rows, down to {np.nanmin(values[kind]):g}",
                    cause=f"heights in a column that is named {kind}: a {kind} grows downwards",
                    hint=f"name the column height, or give the {kind} with the other sign")  # fmt: skip
    if "depth" in values:
        return -values["depth"], True
    if "pressure" in values:
        middle = float(np.nanmedian(values["latitude"])) if "latitude" in values else 45.0
        return -depth_of_pressure(values["pressure"], middle), True
    return (values["height"], True) if "height" in values else (np.zeros(count), False)


def _times(
    path: Path, cells: dict[str, list[str]], columns: dict[str, Column], count: int, names: tuple[str, ...] | None
) -> tuple[Clock, np.ndarray]:
    if "time" not in cells:
        if names is None:
            _refuse(path, "it has neither times nor names of images")
        return "names", np.arange(count, dtype=np.float64)
    try:
        if "date" in cells:
            times = [seconds_of_date(d, t) for d, t in zip(cells["date"], cells["time"], strict=True)]
        elif all(":" in cell and len(cell) < 16 and "-" not in cell for cell in cells["time"]):
            times = [seconds_of_day(cell) for cell in cells["time"]]
            _refuse(path, f"its times ({cells['time'][0]}) have no date", hint="a column date beside the time")
        else:
            times = [seconds_of(cell) for cell in cells["time"]]
    except ValueError as error:
        _refuse(path, f"a time cannot be read: {error}", cause="another form than ISO 8601 or seconds")
    seconds = np.array(times) * columns["time"].factor
    return ("utc" if is_date(float(seconds[0])) else "clip"), seconds


def _stds(values: dict[str, np.ndarray], count: int, has_height: bool) -> np.ndarray | None:
    """Standard deviations per row; infinite upwards where no height is given."""
    both = values.get("std_position")
    kinds = ("std_east", "std_north", "std_up")
    if both is None and not any(kind in values for kind in kinds) and has_height:
        return None
    unknown = np.full(count, np.nan)
    out = np.stack([values.get(kind, unknown if both is None else both) for kind in kinds], -1)
    if not has_height:
        out[:, 2] = np.inf
    return out


def _columns_of(values: dict[str, np.ndarray], kinds: tuple[str, ...]) -> np.ndarray | None:
    return np.stack([values[kind] for kind in kinds], -1) if all(kind in values for kind in kinds) else None


def _refuse(
    path: Path, what: str, cause: str = "another table, or other names of columns", hint: str = _HINT
) -> NoReturn:
    raise InputError(f"{path} cannot be read as navigation: {what}", cause=cause, hint=hint)
