"""Lens, poses and times as plain numbers (layout: `io.cameras_json`)."""

from pathlib import Path

from swimm3r.errors import InputError
from swimm3r.export.poses import unit_of, wanted_poses
from swimm3r.export.result import Exported, check_replaceable
from swimm3r.export.settings import CamerasSettings
from swimm3r.io.cameras_json import read_cameras


def export_run(folder: Path, path: Path, settings: CamerasSettings) -> Exported:
    """Write the cameras of a run with finished structure from motion."""
    check_replaceable(path, _is_table, "cameras.json")
    table = wanted_poses(folder, refined=settings.refined)
    table.cameras.save(path, table.names, table.times, table.units)
    return Exported(path, f"{len(table.names)} cameras, {unit_of(table)} and seconds")


def _is_table(path: Path) -> bool:
    try:
        read_cameras(path)
    except InputError:
        return False
    return True
