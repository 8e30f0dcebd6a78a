"""A KITTI trajectory: the upper three rows of a pose (camera to world) in 12 numbers a line, in the order of the times.

The format has no times: FILE_times.txt beside it has them, seconds, one a line, as KITTI's own times.txt.
"""

from pathlib import Path

import numpy as np

from swimm3r.export.poses import unit_of, wanted_poses
from swimm3r.export.result import Exported, check_replaceable, has_numbers
from swimm3r.export.settings import KittiSettings
from swimm3r.io.files.atomic import write_text


def export_run(folder: Path, path: Path, settings: KittiSettings) -> Exported:
    """Write the poses of a run with finished structure from motion, and their times."""
    times_path = path.with_name(f"{path.stem}_times{path.suffix}")
    check_replaceable(path, has_numbers(12), "KITTI trajectory")
    check_replaceable(times_path, has_numbers(1), "list of times")
    table = wanted_poses(folder, refined=settings.refined)
    poses = table.cameras.cam2world.numpy()
    order = np.argsort(np.asarray(table.times), kind="stable")
    write_text(path, "".join(" ".join(f"{value:.9e}" for value in poses[i, :3].ravel()) + "\n" for i in order))
    write_text(times_path, "".join(f"{table.times[i]:.9f}\n" for i in order))
    return Exported(path, f"{len(table.names)} poses, {unit_of(table)}; seconds in {times_path.name}")
