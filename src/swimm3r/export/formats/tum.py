"""A TUM trajectory: `timestamp tx ty tz qx qy qz qw` a line, camera to world, in the order of the times.

Times are those of the images' headers where the run is of a bag, else seconds of the clip.
"""

from decimal import Decimal
from pathlib import Path

from swimm3r.export.poses import unit_of, wanted_poses
from swimm3r.export.result import Exported, check_replaceable, has_numbers
from swimm3r.export.settings import TumSettings
from swimm3r.io.trajectory import write_tum


def export_run(folder: Path, path: Path, settings: TumSettings) -> Exported:
    """Write the poses of a run with finished structure from motion."""
    check_replaceable(path, has_numbers(8), "TUM trajectory")
    table = wanted_poses(folder, refined=settings.refined)
    write_tum(path, [Decimal(stamp).scaleb(-9) for stamp in table.nanoseconds], table.cameras.cam2world.numpy())
    return Exported(path, f"{len(table.names)} poses, {unit_of(table)}, {table.clock}")
