"""A ROS 1 bag of the poses: geometry_msgs/PoseStamped on /swimm3r/pose, nav_msgs/Path on /swimm3r/path.

Cameras look along z, with x to the right; the frame `map` has the axes of the run. Times are those of the images'
headers where the run is of a bag, else seconds of the clip.
"""

from pathlib import Path

from swimm3r.export.poses import unit_of, wanted_poses
from swimm3r.export.result import Exported, begins_with, check_replaceable
from swimm3r.export.settings import RosbagSettings
from swimm3r.io.bags.write import write_poses
from swimm3r.io.files.atomic import atomic_path


def export_run(folder: Path, path: Path, settings: RosbagSettings) -> Exported:
    """Write the poses of a run with finished structure from motion."""
    check_replaceable(path, begins_with(b"#ROSBAG V"), "ROS 1 bag")
    table = wanted_poses(folder, refined=settings.refined)
    with atomic_path(path) as draft:
        draft.unlink()  # rosbags replaces no file
        write_poses(draft, "bag", table.nanoseconds, table.cameras.cam2world.numpy())
    return Exported(path, f"{len(table.names)} poses, {unit_of(table)}, {table.clock}")
