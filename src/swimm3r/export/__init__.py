"""Maps in the formats of other programs."""

from pathlib import Path
from typing import TYPE_CHECKING

from swimm3r.export.settings import ExportSettings, GaussiansSettings

if TYPE_CHECKING:
    import swimm3r.export.gaussians

__all__ = ["ExportSettings", "GaussiansSettings", "export_run"]


def export_run(folder: Path, path: Path, settings: ExportSettings | None = None) -> "swimm3r.export.gaussians.Exported":
    """Write the map of a finished run in the format that the settings are of, and measure what is lost on the way.

    Raises InputError without a map, UsageError where `path` is a file of another kind: it would be replaced.
    """
    match settings or GaussiansSettings():
        case GaussiansSettings(time=time):
            from swimm3r.export import gaussians

            return gaussians.export_run(folder, path, time)
