"""Settings of scale and place; torch-free, so that --help is instant."""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from swimm3r.errors import UsageError
from swimm3r.settings import NotNegative, Positive, Range, Settings

Metres = Annotated[float, Range(-100, 100)]
MarkerFamily = Literal[
    "aruco-4x4-50",
    "aruco-4x4-250",
    "aruco-5x5-250",
    "aruco-6x6-250",
    "aruco-7x7-250",
    "aruco-original",
    "apriltag-16h5",
    "apriltag-25h9",
    "apriltag-36h10",
    "apriltag-36h11",
]
_CRS = re.compile(r"auto|local|(?:epsg:)?\d{4,6}", re.IGNORECASE)


NAVIGATION = (  # the settings that a path by navigation depends on
    "nav", "nav_topic", "nav_offset", "nav_window", "nav_latency_std", "nav_gap", "nav_std", "attitude_std",
    "clip_start", "lever_arm", "camera_mount", "mount_std",
)  # fmt: skip


@dataclass(frozen=True)
class ScaleSettings(Settings):
    """Sources of the unit and the place of a run; any number of them, solved together."""

    scale_bar: tuple[str, ...] = ()
    """Known distances: both ends as FRAME:x,y (pixels of the prepared frame) in at least two frames, in the same order
    in each, then the length in metres: `a.png:10,20 a.png:300,22 b.png:14,25 b.png:305,28 0.5`. Several bars follow
    each other."""
    points: Path | None = None
    """CSV of named points in frames: name, frame, x, y (pixels of the prepared frames), for --distances and
    --control."""
    distances: Path | None = None
    """CSV of known distances between the named points of --points: from, to, length, and optionally std, metres."""
    length_std: Positive = 0.001
    """Standard deviation of the lengths of scale bars and distances, in metres."""
    point_std: Positive = 1.0
    """Standard deviation of points given in frames, in pixels."""
    markers: MarkerFamily | None = None
    """Family of coded markers that are searched in all frames; needs --marker-size or --marker-file."""
    marker_size: Positive | None = None
    """Outer side of the black square of every marker, in metres."""
    marker_file: Path | None = None
    """YAML of markers: family, size, sizes per id, distances between ids, or a ChArUco board."""
    marker_std: Positive = 0.0005
    """Standard deviation of the printed size of markers, in metres."""
    baseline: Annotated[float, Range(0.001, 100)] | None = None
    """Distance of the first two cameras of a rig, in metres."""
    baseline_std: Positive = 0.0005
    """Standard deviation of --baseline, and of the baselines of --rig-calibration, in metres."""
    camera_height: Positive | None = None
    """Mean height of the camera above the ground, in metres."""
    camera_height_std: Positive = 0.1
    """Standard deviation of --camera-height, in metres."""
    laser_dots: Path | None = None
    """CSV of the dots of two parallel lasers that point where the camera does: frame, x1, y1, x2, y2 (pixels)."""
    laser_spacing: Positive | None = None
    """Distance of the two lasers, in metres."""
    laser_std: Positive = 0.001
    """Standard deviation of --laser-spacing, in metres."""
    nav: Path | None = None
    """Navigation of the vehicle: CSV with named columns, NMEA, Matisse .dim2, TUM, .srt, a dive computer's log as
    Subsurface's XML, a ROS bag, or a folder of images with GPS in EXIF."""
    nav_topic: str | None = None
    """Topic of positions of a ROS bag that holds several; `swimm3r topics BAG` lists them."""
    nav_offset: Annotated[float, Range(-1e10, 1e10)] | None = None
    """Seconds to add to the frames' times to get the navigation's; by default estimated, or not needed where the
    navigation names the images."""
    nav_window: Annotated[float, Range(0, 3600)] = 2.0
    """Largest offset that is searched where both clocks state the date, in seconds."""
    nav_latency_std: Annotated[float, Range(0, 10)] = 0.5
    """Standard deviation of the offset between the clocks of camera and vehicle where the navigation names the images,
    in seconds; 0 for none."""
    nav_gap: Positive = 5.0
    """Longest gap between positions that is bridged, in seconds."""
    nav_std: tuple[Positive, Positive, Positive] | None = None
    """Standard deviation of positions east, north and up in metres, where the file has none; by default found from the
    residuals."""
    attitude_std: tuple[Positive, Positive, Positive] = (2.0, 1.0, 1.0)
    """Standard deviation of heading, pitch and roll in degrees, where the file has none."""
    altimeter: bool = False
    """Use the navigation's altitude above the bottom as a source of scale."""
    altimeter_std: Positive = 0.1
    """Standard deviation of altitudes above the bottom, as a share of them."""
    clip_start: str | None = None
    """Date and time of the video's first frame (ISO 8601, UTC), where neither the file nor names state it."""
    lever_arm: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    """Place of the camera on the vehicle from the point whose positions the navigation holds: forward, starboard and
    down in metres."""
    camera_mount: Literal["free", "down", "forward"] = "free"
    """Direction of the camera on the vehicle: down (top of the image ahead), forward, or free to be found."""
    mount_std: Annotated[float, Range(0.01, 90)] = 5.0
    """Standard deviation of the mounting's angles in degrees, where it is not free."""
    crs: str = "auto"
    """Reference system of the results: auto for the UTM zone, EPSG:n, or local for metres east and north of the first
    position."""
    nav_crs: str | None = None
    """Reference system of easting and northing in the navigation and in --control, as EPSG:n."""
    control: Path | None = None
    """CSV of ground control points, seen in frames by --points: name, easting, northing, depth or latitude, longitude,
    depth (or height); optionally std in metres, and role, control or check."""
    control_std: Positive = 0.02
    """Standard deviation of ground control points in metres, where the file has none."""
    outlier: Annotated[float, Range(2, 20)] = 4.0
    """Residual in standard deviations from which a source is called an outlier."""
    minimum_std: NotNegative = 0.0005
    """Least relative standard deviation of any one source: errors of lens and poses that no source shows."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, crs in (("crs", self.crs), ("nav_crs", self.nav_crs)):
            if crs is not None and not _CRS.fullmatch(crs):
                raise UsageError(
                    f"{name} is {crs!r}", cause="a slip in the option", hint="auto, local, or a code such as EPSG:32632"
                )
        if self.markers is not None and self.marker_size is None and self.marker_file is None:
            raise UsageError(
                f"markers of {self.markers} are to be found, and their size is not given",
                cause="--markers without --marker-size or --marker-file",
                hint="--marker-size METRES, the outer side of the black square",
            )
        if self.marker_size is not None and self.markers is None and self.marker_file is None:
            raise UsageError(
                "a size of markers is given, and no family",
                cause="--marker-size without --markers",
                hint="--markers aruco-4x4-50, or the family that was printed",
            )
        for one, other in (("laser_dots", "laser_spacing"), ("distances", "points"), ("control", "points")):
            if getattr(self, one) is not None and getattr(self, other) is None:
                raise UsageError(
                    f"--{one.replace('_', '-')} needs --{other.replace('_', '-')}",
                    cause="one of the two options was left out",
                    hint="both, or neither",
                )

    @property
    def has_sources(self) -> bool:
        """Return whether anything is given that tells scale or place."""
        given = (self.nav, self.points, self.markers, self.marker_file, self.baseline, self.camera_height)
        given = (*given, self.laser_dots)
        return bool(self.scale_bar) or any(value is not None for value in given)


def resolved(settings: ScaleSettings) -> ScaleSettings:
    """The settings with absolute paths, as a run folder keeps them."""
    paths = {name: value.resolve() for name, value in vars(settings).items() if isinstance(value, Path)}
    return replace(settings, **paths)


def epsg_of(crs: str) -> int | None:
    """The EPSG code that a setting names; None for auto and local."""
    digits = crs.lower().removeprefix("epsg:")
    return int(digits) if digits.isdigit() else None
