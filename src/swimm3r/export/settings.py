"""The formats that a map is exported to; torch-free."""

from dataclasses import dataclass

from swimm3r.settings import ClipSecond, Settings


@dataclass(frozen=True)
class GaussiansSettings(Settings):
    """A PLY file of Gaussians, as 3DGS viewers read it, without the water."""

    time: ClipSecond | None = None
    """Second of the clip at which a dynamic map is exported; half way by default."""

    @property
    def file_name(self) -> str:
        """Name of the file in RUN/splat where none is given."""
        return "gaussians.ply"


ExportSettings = GaussiansSettings
"""The union of all formats; `export.export_run` matches on it."""
