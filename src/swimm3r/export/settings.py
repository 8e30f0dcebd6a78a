"""The formats that a run is exported to; torch-free."""

from dataclasses import dataclass
from typing import Annotated, Literal

from swimm3r.settings import ClipSecond, Range, Settings

FormatName = Literal[
    "ply",
    "compressed-ply",
    "splat",
    "spz",
    "glb",
    "colmap",
    "nerfstudio",
    "tum",
    "kitti",
    "rosbag",
    "rosbag2",
    "depth",
    "cameras",
]


ImagesBeside = Literal["filmed", "restored", "none"]


@dataclass(frozen=True)
class _SplatSettings(Settings):
    """A map as Gaussians without the water."""

    time: ClipSecond | None = None
    """Second of the clip at which a dynamic map is exported; half way by default."""
    colors: Literal["shown", "physical"] = "shown"
    """White-balanced like the restored frames (shown), or the map's own clear colors (physical)."""

    def _named(self, suffix: str) -> str:
        return f"splat/gaussians{'' if self.colors == 'shown' else '_physical'}{suffix}"


@dataclass(frozen=True)
class SplatPlySettings(_SplatSettings):
    """A PLY file of Gaussians, as 3DGS wrote it first and most viewers read it."""

    @property
    def file_name(self) -> str:
        """Place in the run folder where none is given."""
        return self._named(".ply")


@dataclass(frozen=True)
class CompressedPlySettings(_SplatSettings):
    """PlayCanvas's compressed PLY: 16 bytes per Gaussian."""

    @property
    def file_name(self) -> str:
        """Place in the run folder where none is given."""
        return self._named(".compressed.ply")


@dataclass(frozen=True)
class SplatFileSettings(_SplatSettings):
    """The .splat of web viewers: 32 bytes per Gaussian, one color for all directions."""

    @property
    def file_name(self) -> str:
        """Place in the run folder where none is given."""
        return self._named(".splat")


@dataclass(frozen=True)
class SpzSettings(_SplatSettings):
    """Niantic's SPZ, version 3, with its axes: x right, y up, z back."""

    @property
    def file_name(self) -> str:
        """Place in the run folder where none is given."""
        return self._named(".spz")


@dataclass(frozen=True)
class GlbSettings(Settings):
    """The dense cloud as binary glTF."""

    colors: Literal["shown", "physical", "raw"] = "shown"
    """White-balanced like the restored frames (shown), restored (physical), or as filmed (raw)."""
    point_limit: Annotated[int, Range(1)] = 1_000_000
    """Largest number of points; of more, evenly chosen ones are kept."""

    @property
    def file_name(self) -> str:
        """Place in the run folder where none is given."""
        return f"sfm/points{'' if self.colors == 'shown' else f'_{self.colors}'}.glb"


@dataclass(frozen=True)
class _DatasetSettings(Settings):
    """Cameras, sparse points and images for another trainer."""

    with_images: ImagesBeside = "filmed"
    """Images beside the model: as filmed, without the water as shown, or none."""


@dataclass(frozen=True)
class ColmapExportSettings(_DatasetSettings):
    """A COLMAP data set: sparse/0 and images."""

    text: bool = False
    """Text files in the place of binary ones."""

    @property
    def file_name(self) -> str:
        """Place in the run folder where none is given."""
        return "export/colmap"


@dataclass(frozen=True)
class NerfstudioSettings(_DatasetSettings):
    """A nerfstudio data set: transforms.json, sparse_pc.ply and images."""

    @property
    def file_name(self) -> str:
        """Place in the run folder where none is given."""
        return "export/nerfstudio"


@dataclass(frozen=True)
class _TrajectorySettings(Settings):
    """Poses of the frames that were placed."""

    refined: bool = False
    """Poses as refined with the map, in whose axes exported splats are, in the place of those by structure from motion.
    """


@dataclass(frozen=True)
class TumSettings(_TrajectorySettings):
    """A TUM trajectory: time, position and quaternion (x, y, z, w) a line, camera to world."""

    @property
    def file_name(self) -> str:
        """Place in the run folder where none is given."""
        return "export/trajectory.tum"


@dataclass(frozen=True)
class KittiSettings(_TrajectorySettings):
    """A KITTI trajectory: the upper three rows of each pose a line, and the times in a file beside it."""

    @property
    def file_name(self) -> str:
        """Place in the run folder where none is given."""
        return "export/trajectory_kitti.txt"


@dataclass(frozen=True)
class RosbagSettings(_TrajectorySettings):
    """A ROS 1 bag: a PoseStamped per frame and a Path, at the times of the images."""

    @property
    def file_name(self) -> str:
        """Place in the run folder where none is given."""
        return "export/poses.bag"


@dataclass(frozen=True)
class Rosbag2Settings(_TrajectorySettings):
    """A ROS 2 bag: a PoseStamped per frame and a Path, at the times of the images."""

    storage: Literal["mcap", "sqlite3"] = "mcap"
    """Kind of file in the bag."""

    @property
    def file_name(self) -> str:
        """Place in the run folder where none is given."""
        return "export/poses"


@dataclass(frozen=True)
class CamerasSettings(_TrajectorySettings):
    """A cameras.json: lens, poses and times as plain numbers."""

    @property
    def file_name(self) -> str:
        """Place in the run folder where none is given."""
        return "export/cameras.json"


@dataclass(frozen=True)
class DepthSettings(Settings):
    """The depth maps of structure from motion as images."""

    type: Literal["png", "tiff"] = "png"
    """PNG of 16 bits with the unit of a level in depth.json, or TIFF of 32-bit floats in the unit of the run."""

    @property
    def file_name(self) -> str:
        """Place in the run folder where none is given."""
        return f"export/depth_{self.type}"


ExportSettings = (
    SplatPlySettings
    | CompressedPlySettings
    | SplatFileSettings
    | SpzSettings
    | GlbSettings
    | ColmapExportSettings
    | NerfstudioSettings
    | TumSettings
    | KittiSettings
    | RosbagSettings
    | Rosbag2Settings
    | CamerasSettings
    | DepthSettings
)
"""The union of all formats; `export.export_run` matches on it."""

FORMATS: dict[FormatName, ExportSettings] = {
    "ply": SplatPlySettings(),
    "compressed-ply": CompressedPlySettings(),
    "splat": SplatFileSettings(),
    "spz": SpzSettings(),
    "glb": GlbSettings(),
    "colmap": ColmapExportSettings(),
    "nerfstudio": NerfstudioSettings(),
    "tum": TumSettings(),
    "kitti": KittiSettings(),
    "rosbag": RosbagSettings(),
    "rosbag2": Rosbag2Settings(),
    "depth": DepthSettings(),
    "cameras": CamerasSettings(),
}

FOLDERS = (ColmapExportSettings, NerfstudioSettings, DepthSettings, Rosbag2Settings)
"""Those that are folders."""
