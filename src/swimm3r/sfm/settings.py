"""Settings of structure from motion, a type per back end; torch-free, so that --help is instant."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from swimm3r.errors import UsageError
from swimm3r.refraction.settings import HousingKind, PortSettings
from swimm3r.settings import (
    Count,
    CountOrZero,
    LensParameter,
    NetworkSide,
    NotNegative,
    Positive,
    Range,
    Settings,
    Share,
    Threads,
)
from swimm3r.sfm.colmap.settings import MappingSettings
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.mast3r.settings import AlignmentSettings, MatchingSettings
from swimm3r.sfm.medium.settings import MediumSettings
from swimm3r.sfm.plane_sweep.settings import PlaneSweepSettings

LENS_NUMBERS = ("focal", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")
"""Settings that give a lens number by number."""

BackendName = Literal["colmap", "mast3r", "swimm3r"]
MovingChoice = Literal["auto", "none"]
RectifyChoice = Literal["auto", "keep"]


@dataclass(frozen=True)
class LensSettings(Settings):
    """The one lens of a clip, as far as it is known (`sfm/lens.py`)."""

    focal: Positive | None = None
    """Focal length in pixels of the prepared frames, in water, or in air if `housing` is given: a start value, which
    `intrinsics` or `alignment.intrinsics` can fix. MASt3R always fixes a lens with distortion."""
    fy: Positive | None = None
    """Vertical focal length in pixels of the prepared frames; by default `focal`, which then is the horizontal one."""
    cx: Positive | None = None
    """Column of the principal point in pixels of the prepared frames, from the left border; by default the middle."""
    cy: Positive | None = None
    """Row of the principal point in pixels of the prepared frames, from the upper border; by default the middle."""
    k1: LensParameter | None = None
    """First radial distortion coefficient of the lens, in COLMAP's convention."""
    k2: LensParameter | None = None
    """Second radial distortion coefficient of the lens."""
    k3: LensParameter | None = None
    """Third radial distortion coefficient, for OPENCV_FISHEYE only."""
    k4: LensParameter | None = None
    """Fourth radial distortion coefficient, for OPENCV_FISHEYE only."""
    p1: LensParameter | None = None
    """First tangential distortion coefficient, for OPENCV only."""
    p2: LensParameter | None = None
    """Second tangential distortion coefficient, for OPENCV only."""
    calibration: Path | None = None
    """Calibration file: Kalibr, ROS camera_info, OpenCV YAML or XML, COLMAP cameras.txt, Agisoft XML, transforms.json.
    Its lens takes the place of `focal`, `k1` and their kin."""
    calibration_camera: str | None = None
    """Name of the camera to use of a calibration file that holds several."""
    calibration_size: tuple[Count, Count] | None = None
    """Width and height in pixels of the images of the calibration, where its file does not state them."""
    lens_from: Path | None = None
    """Run folder whose lens, found in water by the same camera in the same mode, is held; or a folder of such runs."""
    housing: HousingKind = "none"
    """Port of the camera housing: flat or dome, where `focal` or `calibration` are of the lens in air."""
    port: PortSettings = field(default_factory=PortSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        given = [name for name in LENS_NUMBERS if getattr(self, name) is not None]
        if self.calibration is not None and given:
            raise UsageError(
                f"--calibration and --{given[0]} exclude each other",
                cause="both say what the lens is",
                hint="leave out one of them; the lens of a calibration is changed in its file",
            )
        other = "calibration" if self.calibration is not None else given[0] if given else None
        if self.lens_from is not None and (other is not None or self.housing != "none"):
            raise UsageError(
                f"--lens-from and --{other or 'housing'} exclude each other",
                cause="the lens of a run is known as it is in water",
                hint="leave out one of them",
            )


@dataclass(frozen=True)
class ColmapSettings(MediumSettings, LensSettings):
    """Structure from motion without weights: pycolmap, plane sweep, Sea-Thru."""

    camera: Literal["auto", "SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"] = "auto"
    """Lens model of the whole clip; auto uses SIMPLE_RADIAL, or OPENCV where it explains the matches clearly better."""
    intrinsics: Literal["prior", "fixed"] = "prior"
    """Use of the given focal length and distortion: as a start to refine, or fixed."""
    rectify: RectifyChoice = "auto"
    """Images that no lens model explains, stretched by the camera or filmed through a curved window: drawn anew as a
    pinhole camera sees them (auto), or kept as filmed."""
    shutter: Literal["auto", "global", "rolling"] = "auto"
    """Exposure of a frame's rows: all at once (global), one after another along a smooth path (rolling), or in a camera
    that turns anew in every frame, where the tracks show it: rows are then drawn as exposed at once (auto)."""
    readout: Annotated[float, Range(-1, 1)] | None = None
    """Seconds between the first and the last row of a rolling shutter, negative where a film was turned upside down;
    estimated without it. Of stills without times, in intervals between them."""
    pairs: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Frames to match: every pair, or neighbors in time and similar frames; auto matches every pair up to
    `exhaustive_to` frames."""
    exhaustive_to: CountOrZero = 60
    """Number of frames up to which `auto` matches every pair."""
    overlap: CountOrZero = 10
    """Number of neighbors in time that each frame is matched with, followed by some at doubling distances."""
    loops: CountOrZero = 6
    """Number of most similar frames elsewhere in the clip (VLAD) that each frame is matched with, followed by as many
    at most beside those that match; five times as many for folders of images, which need at least 1."""
    threads: Threads = 0
    """Number of threads for features and matching; 0 uses all cores."""
    features: FeatureSettings = field(default_factory=FeatureSettings)
    mapping: MappingSettings = field(default_factory=MappingSettings)
    depth: PlaneSweepSettings = field(default_factory=PlaneSweepSettings)
    moving: MovingChoice = "auto"
    """Masks of moving objects: found where they hide surfaces that other frames measured (auto), or none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.readout is not None and self.shutter != "rolling":
            raise UsageError(
                "--readout needs --shutter rolling",
                cause="rows that are exposed all at once have no readout time",
                hint="add --shutter rolling, or leave it out",
            )
        if self.shutter == "rolling" and self.housing != "none":
            raise UsageError(
                "--shutter rolling and --housing exclude each other",
                cause="both move observations by the depth of what they show",
                hint="the one of them that matters more: refraction in slow dives, the shutter in shaky ones",
            )

    def of_frames_as_filmed(self) -> "ColmapSettings":
        """The same for frames that are not to be redrawn, whatever their lens and shutter."""
        shutter = "global" if self.shutter == "auto" else self.shutter
        return replace(self, rectify="keep", shutter=shutter)

    @property
    def backend(self) -> BackendName:
        """The back end as --backend names it."""
        return "colmap"


@dataclass(frozen=True)
class Mast3rSettings(MediumSettings, LensSettings):
    """Structure from motion by the MASt3R network: pointmaps and matches of pairs of frames, aligned; Sea-Thru."""

    weights: Path | None = None
    """MASt3R checkpoint (.pth or .safetensors); by default the one that `swimm3r weights path mast3r` prints."""
    adapter: Path | None = None
    """File adapter.safetensors of train-sfm; matches and depth then come from the student, the medium from its head."""
    graph: str = "video"
    """Pairs of frames to process: video[-WINDOW-CLOSURES], complete, swin-K, logwin-K, oneref-FRAME or
    retrieval-KEYS-K."""
    similarity: Literal["cosine", "asmk"] = "cosine"
    """Similarity of frames from the encoder's tokens; asmk needs the weights mast3r-retrieval and its codebook."""
    size: NetworkSide = 512
    """Longer side of the network's images in pixels; it was trained at 512."""
    square_ok: bool = False
    """Keep square images square; otherwise they are cropped to 4:3, as in training."""
    device: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Device that the network runs on; auto uses a GPU if one is present."""
    precision: Literal["float32", "bfloat16", "float16"] = "float32"
    """Number format of the network's trunk; its heads always use float32."""
    camera: Literal["PINHOLE", "SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"] = "PINHOLE"
    """Lens model of the whole clip; distortion is removed before the network sees an image."""
    known: Path | None = None
    """Known cameras: a cameras.json, a COLMAP model or another program's file. Frames in it keep their poses and unit;
    its lens replaces the options above."""
    min_matches: Count = 16
    """Smallest number of matches of a pair; pairs with fewer are treated as non-overlapping."""
    min_share: Share = 0.9
    """Smallest share of the frames that must be connected by matches; the others are left out with a warning."""
    max_matches: Count = 2_000_000
    """Largest number of matches of all pairs together in the alignment, which bounds its memory."""
    max_error: Positive = 3.0
    """Largest reprojection error, in pixels of the network's image, of a match in a track."""
    max_points: Annotated[int, Range(100)] = 200_000
    """Largest number of sparse points; those seen in most frames are kept."""
    min_confidence: NotNegative = 1.5
    """Smallest confidence (1 and up) at which the depth of a pixel is used."""
    bundle_adjustment: bool = False
    """Refine poses and points by COLMAP's bundle adjustment of the tracks at the end."""
    memory_mb: Count = 2048
    """Memory in MB for encodings and running sums; frames beyond it wait on disk."""
    cache: Path | None = None
    """Folder for encodings and pair results that several runs may share; by default the run's own, removed at its end.
    """
    matching: MatchingSettings = field(default_factory=MatchingSettings)
    alignment: AlignmentSettings = field(default_factory=lambda: AlignmentSettings(intrinsics="shared"))
    features: FeatureSettings = field(default_factory=FeatureSettings)
    """By which held-out frames find their place beside a finished reconstruction."""
    moving: MovingChoice = "auto"
    """Masks of moving objects: found where they hide surfaces that other frames measured (auto), or none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.adapter is not None and self.light == "lamp":
            raise UsageError(
                "--adapter and --light lamp exclude each other",
                cause="the water that an adapter's physics head predicts is that of daylight",
                hint="leave out one of them",
            )

    @property
    def backend(self) -> BackendName:
        """The back end as --backend names it."""
        return "mast3r" if self.adapter is None else "swimm3r"


@dataclass(frozen=True)
class ColmapModelSettings(MediumSettings):
    """Poses and points of a COLMAP model that exists; depth, water and cloud are found as without one."""

    model: Path
    """Folder with cameras, images and points3D (.bin or .txt), or one above its sparse/0; or another program's file
    (`swimm3r.io.imports.read.read_foreign`)."""
    features: FeatureSettings = field(default_factory=FeatureSettings)
    depth: PlaneSweepSettings = field(default_factory=PlaneSweepSettings)
    moving: MovingChoice = "auto"
    """Masks of moving objects: found where they hide surfaces that other frames measured (auto), or none."""

    @property
    def backend(self) -> BackendName:
        """The back end as --backend names it: the one whose depth and water these settings share."""
        return "colmap"


SfmSettings = ColmapSettings | Mast3rSettings | ColmapModelSettings

BACKENDS: dict[BackendName, type[ColmapSettings] | type[Mast3rSettings]] = {
    "colmap": ColmapSettings,
    "mast3r": Mast3rSettings,
    "swimm3r": Mast3rSettings,
}
"""Settings of the back ends that the command line offers by name."""
