"""The cameras of a run that trajectories and camera files are written from."""

from dataclasses import dataclass
from pathlib import Path

from swimm3r.cameras import Cameras, cameras_of
from swimm3r.errors import InputError
from swimm3r.io import cameras_json
from swimm3r.io.files.damage import remake
from swimm3r.scene.run_folder import open_run
from swimm3r.sfm.rectified.run import run_frames


@dataclass(frozen=True)
class TimedCameras:
    """Cameras with the names and times of their frames."""

    names: tuple[str, ...]
    times: tuple[float, ...]  # seconds of the clip
    cameras: Cameras
    units: str
    stamps: tuple[int, ...] | None = None  # nanoseconds since 1970 of the images' headers, of a run of a bag

    @property
    def nanoseconds(self) -> tuple[int, ...]:
        """The stamps of the images' headers, else the times of the clip."""
        return self.stamps or tuple(round(time * 1e9) for time in self.times)

    @property
    def clock(self) -> str:
        """The clock of `nanoseconds` in words."""
        return "seconds of the clip" if self.stamps is None else "times of the images' headers"


def wanted_poses(folder: Path, *, refined: bool) -> TimedCameras:
    """The poses by structure from motion, or those refined with the map. Raises InputError where there are none."""
    open_run(folder, "splat" if refined else "sfm")
    room = folder / ("splat" if refined else "sfm")
    if not (room / "cameras.json").is_file():
        raise InputError(
            f"the map in {folder} has no poses of its own",
            cause="its training held the poses that structure from motion found",
            hint="leave out --refined: they are the same",
        )
    table = cameras_json.read_own_cameras(room / "cameras.json", remake(room))
    frames = run_frames(folder)
    times = table.times or frames.times_of(table.names)
    return TimedCameras(table.names, times, cameras_of(table), table.units, frames.stamps_of(table.names))


def unit_of(table: TimedCameras) -> str:
    """Their unit of length in words."""
    return "in metres" if table.units == "metres" else "in scene units"
