"""A ROS 2 bag of the poses, a folder: the topics and times of `rosbag`, stored as MCAP or SQLite."""

from pathlib import Path

from swimm3r.export.poses import unit_of, wanted_poses
from swimm3r.export.result import Exported
from swimm3r.export.settings import Rosbag2Settings
from swimm3r.io.bags.write import write_poses
from swimm3r.io.files.atomic import atomic_folder
from swimm3r.io.files.outputs import check_empty


def export_run(folder: Path, path: Path, settings: Rosbag2Settings) -> Exported:
    """Write the poses of a run with finished structure from motion."""
    check_empty(path)
    table = wanted_poses(folder, refined=settings.refined)
    with atomic_folder(path) as draft:
        bag = draft / path.name  # files in a bag have its name
        write_poses(bag, settings.storage, table.nanoseconds, table.cameras.cam2world.numpy())
        for file in bag.iterdir():
            file.rename(draft / file.name)
        bag.rmdir()
    return Exported(path, f"{len(table.names)} poses, {unit_of(table)}, {table.clock}")
