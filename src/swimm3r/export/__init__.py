"""Runs in the formats of other programs."""

from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from swimm3r.export.settings import (
    CamerasSettings,
    ColmapExportSettings,
    CompressedPlySettings,
    DepthSettings,
    ExportSettings,
    GlbSettings,
    KittiSettings,
    NerfstudioSettings,
    Rosbag2Settings,
    RosbagSettings,
    SplatFileSettings,
    SplatPlySettings,
    SpzSettings,
    TumSettings,
)

if TYPE_CHECKING:
    import swimm3r.export.result

__all__ = ["ExportSettings", "export_run"]


def export_run(
    folder: str | Path, path: str | Path | None = None, settings: ExportSettings | None = None
) -> "swimm3r.export.result.Exported":
    """Write a run in the format that the settings are of, and measure what is lost on the way.

    `path` is the file or the folder to write, by default one in the run folder. Raises InputError where the run has not
    come far enough, UsageError where `path` is a file of another kind, which would be replaced, StorageError where it
    is a folder with things in it, and DeviceError where a package is missing.
    """
    settings, folder = settings or SplatPlySettings(), Path(folder)
    path = folder / settings.file_name if path is None else Path(path)
    return _format(settings).export_run(folder, path, settings)


def _format(settings: ExportSettings) -> ModuleType:  # noqa: C901 - a branch per format
    """The module of a format: `export_run`."""
    match settings:
        case SplatPlySettings():
            from swimm3r.export.formats import splat_ply

            return splat_ply
        case CompressedPlySettings():
            from swimm3r.export.formats import compressed_ply

            return compressed_ply
        case SplatFileSettings():
            from swimm3r.export.formats import splat_file

            return splat_file
        case SpzSettings():
            from swimm3r.export.formats import spz

            return spz
        case GlbSettings():
            from swimm3r.export.formats import glb

            return glb
        case ColmapExportSettings():
            from swimm3r.export.formats import colmap

            return colmap
        case NerfstudioSettings():
            from swimm3r.export.formats import nerfstudio

            return nerfstudio
        case TumSettings():
            from swimm3r.export.formats import tum

            return tum
        case KittiSettings():
            from swimm3r.export.formats import kitti

            return kitti
        case RosbagSettings():
            from swimm3r.export.formats import rosbag

            return rosbag
        case Rosbag2Settings():
            from swimm3r.export.formats import rosbag2

            return rosbag2
        case CamerasSettings():
            from swimm3r.export.formats import cameras

            return cameras
        case DepthSettings():
            from swimm3r.export.formats import depth

            return depth
