"""Every number of the structure-from-motion stage, with its reason; torch-free, so that --help is instant."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from swimm3r.errors import UsageError
from swimm3r.refraction.settings import HousingKind, PortSettings
from swimm3r.settings import (
    Count,
    CountOrZero,
    LensParameter,
    LongSide,
    NetworkSide,
    NotEmpty,
    NotNegative,
    Positive,
    PositiveShare,
    Range,
    Settings,
    Share,
    Threads,
)
from swimm3r.sfm.mast3r.settings import AlignmentSettings, MatchingSettings

LENS_NUMBERS = ("focal", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")
"""Settings that give a lens number by number."""

BackendName = Literal["colmap", "mast3r", "swimm3r"]


@dataclass(frozen=True)
class PlaneSweepSettings(Settings):
    """Dense depth of posed frames (`sfm/plane_sweep/estimate.py`)."""

    long_side: LongSide = 640
    """Longer side in pixels at which depth is computed; for larger frames it is upsampled along image edges."""
    sources: Annotated[int, Range(1, 16)] = 5
    """Number of neighboring frames that each frame is compared with."""
    angle_deg: Annotated[float, Range(above=0, most=90)] = 8.0
    """Preferred triangulation angle in degrees: smaller angles are imprecise, larger ones hide surfaces."""
    planes: Annotated[int, Range(32, 1024)] = 128
    """Largest number of planes of the coarse sweep, uniform in inverse depth; close views use fewer, one per pixel of
    motion."""
    window: Annotated[int, Range(1, 16)] = 3
    """Half width of the coarse sweep's NCC window, in pixels of the half-size image."""
    noise: PositiveShare = 0.8 / 255
    """Standard deviation of gray values below which a window is too uniform to be matched."""
    smooth: NotNegative = 0.15
    """Penalty for one plane of disagreement between neighboring pixels in the semi-global step; a jump costs eight
    times as much."""
    rounds: Annotated[int, Range(0, 32)] = 3
    """Number of slanted-plane refinement rounds at full working size."""
    smooth_fine: NotNegative = 0.05
    """Penalty in the refinement for one source pixel of disagreement with neighboring pixels."""
    min_ncc: Annotated[float, Range(0, below=1)] = 0.4
    """Smallest correlation with the sources at which a depth is kept."""
    min_peak: NotNegative = 0.12
    """Smallest share by which 1 - NCC must rise 2.5 pixels beside a match; flatter peaks are dropped as undetermined.
    """
    tolerance: Share = 0.015
    """Largest relative difference in depth at which two frames agree; the reprojection error may allow more."""
    agreeing: Annotated[int, Range(0, 16)] = 2
    """Number of other frames that must agree with a depth; of ground that fewer of them see, all."""
    speck: CountOrZero = 48
    """Size in working pixels below which connected patches of depth are dropped; up to eight times that, patches that
    few frames share have to fit the depth around them."""
    threads: Threads = 0
    """Number of frames computed at once; 0 uses all cores, at most 8."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Processor of the sweep; "auto" uses a CUDA device where there is one."""


@dataclass(frozen=True)
class TrackSettings(Settings):
    """Pixels of several depth maps grouped into surface points (`sfm/medium/dense_tracks.py`)."""

    tolerance: Share = 0.02
    """Largest relative difference in z depth at which two frames show the same point."""
    max_color_change: Share = 0.3
    """Largest change of a color channel between two observations of a point."""
    max_views: Count = 12
    """Number of other frames in which the points of one frame are looked up."""
    min_overlap: Share = 0.1
    """Overlap above which another frame is searched for the points of a frame."""
    max_tracks: Count = 1_000_000
    """Approximate largest number of surface points that the water is fitted to; more are thinned on a regular grid."""


@dataclass(frozen=True)
class RestoreSettings(Settings):
    """Images and points with the water removed (`sfm/medium/restore.py`). Values are 0..1."""

    noise: PositiveShare = 0.01
    """Standard deviation of a pixel value caused by the sensor and compression."""
    texture: PositiveShare = 0.1
    """Standard deviation of clear colors within a small window."""
    veil_error: PositiveShare = 0.006
    """Assumed error of the backscatter B(z); where T_D is not clearly larger, color is taken from the other channels.
    """
    color_error: PositiveShare = 0.12
    """Largest error of a clear color that is accepted."""
    window: Annotated[float, Range(0.001, 0.25)] = 0.02
    """Standard deviation of the local windows, as a share of the longer side."""
    max_points: Annotated[int, Range(100)] = 500_000
    """Largest number of points of the restored cloud, thinned by voxels, of a surface of `max_points_area`."""
    max_points_area: Annotated[float, Range(0, 1e6)] = 12.0
    """Area in images above which a surface has points in proportion to it; 0 keeps to `max_points`."""
    white_balance: bool = True
    """Apply gray-world gains, one triple per dive, to all that is shown: restored/, points.ply, clear views, exports.
    The colors in restored_physical/ and points_physical.ply, and all scores, stay physical."""


LightChoice = Literal["auto", "sun", "lamp"]
MovingChoice = Literal["auto", "none"]
FlickerChoice = Literal["auto", "keep"]
RectifyChoice = Literal["auto", "keep"]


@dataclass(frozen=True)
class SeathruSettings(Settings):
    """The water from images and depth (`sfm/medium/seathru.py`); values are 0..1, standard deviations without unit."""

    tracks: TrackSettings = field(default_factory=TrackSettings)
    max_pixels: Count = 300_000
    """Number of single pixels drawn from all frames together."""
    open_water_pixels: Count = 2_000
    """Largest number of open-water pixels taken from one frame."""
    patch_pixels: Positive = 12.0
    """Edge length of a surface patch in pixels of its farthest observation; at most 1/32 of the longer side."""
    patch_observations: Count = 6
    """Smallest number of pixels of a patch in a frame."""
    patch_offset: NotNegative = 0.15
    """Largest distance, in edge lengths, between the centroid of a patch and that of its visible part."""
    range_bins: Annotated[int, Range(1, 1000)] = 10
    """Number of range bins that the darkest pixels are taken from."""
    dark_fraction: PositiveShare = 0.01  # Sea-Thru: the darkest 1 % of each range bin
    """Share of darkest pixels in each range bin that stand for backscatter (1 % in Sea-Thru)."""
    min_bin_pixels: Count = 50
    """Smallest number of pixels of a range bin that is used."""
    dark_std: PositiveShare = 0.015
    """Standard deviation of the dark envelope of one range bin."""
    dark_reflectance: Share = 0.02
    """Expected clear color of the darkest pixels, as black surfaces are rarely fully black."""
    dark_reflectance_std: PositiveShare = 0.03
    """Standard deviation of the clear color of the darkest pixels."""
    lsac_f: Positive = 2.0
    """Sea-Thru's f: the illuminant is f times the local average color, so that surfaces reflect 1/f on average."""
    mean_reflectance_std: Positive = 0.5
    """Standard deviation of ln(1/f) over a whole dive, which weights the gray-world assumption."""
    average_std: Positive = 0.3
    """Relative standard deviation of one range bin's average color."""
    slope_std: Positive = 0.1
    """Standard deviation of b times the median depth in beta_D(z) = a exp(b z)."""
    open_water_std: PositiveShare = 0.01
    """Standard deviation of Binf from open-water pixels, beyond their spread."""
    far_color_std: PositiveShare = 0.2
    """Standard deviation of Binf about the mean color of the farthest tenth, if no open water is visible."""
    min_open_water: Count = 200
    """Smallest number of open-water pixels that determine Binf."""
    min_samples: Count = 500
    """Smallest number of pixels with a depth that a fit needs."""
    min_tracks: Count = 100
    """Smallest number of surface points seen in several frames that a fit needs."""
    min_depth_ratio: Annotated[float, Range(1)] = 1.05
    """Smallest ratio of the farthest to the nearest observation of a point in the fit."""
    black: Share = 0.002
    """Pixel value at or below which a pixel counts as underexposed."""
    saturated: Share = 0.98
    """Pixel value from which a pixel counts as overexposed."""
    max_observations: Count = 200_000
    """Largest number of observations in the fit; points with the largest ratio of depths are kept."""
    start_observations: Count = 5_000
    """Number of observations in the search for the fit's initial values."""
    min_redundancy: Positive = 3.0
    """Smallest number of observations that share one error term."""
    loss_scale: PositiveShare = 0.02
    """Residual, in pixel values, beyond which observations count as outliers."""
    reweightings: Annotated[int, Range(1, 100)] = 6
    """Number of robust reweighting rounds of the fit."""
    depth_error: Share = 0.01
    """Relative error of one observation's ray depth, beyond the error that all observations of a point share."""
    gain_std: Share = 0.1
    """Initial standard deviation of exposure and white balance between frames, which is then estimated."""
    gain_evidence: Share = 0.85
    """Share of the residuals below which gains per frame must bring them to be used."""
    lamp_explained: Share = 0.4
    """Smallest share of the variance of points' light, after distance, that their places in the images explain under a
    lamp, with `light auto`."""
    lamp_change: NotNegative = 0.1
    """Smallest standard deviation, over the images, of the logarithm of a lamp's light, with `light auto`."""
    std_inflation: Positive = 2.0
    """Factor on the standard deviations beyond that of the residuals (benchmarks/seathru_calibration.py)."""
    identifiable_std: NotNegative = 0.065
    """Relative standard deviation below which a coefficient counts as identifiable (benchmarks/seathru_calibration.py).
    """


@dataclass(frozen=True)
class FeatureSettings(Settings):
    """SIFT and its matching (`sfm/features/sift.py`)."""

    count: Annotated[int, Range(1, 1_000_000)] = 2048
    """Largest number of keypoints per frame; one with two orientations counts once."""
    peak_threshold: PositiveShare = 0.003
    """Smallest contrast of a keypoint, of 1; hazy images need less than COLMAP's 0.0067."""
    faint_threshold: PositiveShare = 0.001
    """Smallest contrast of a keypoint in frames that yield fewer than `count` with `peak_threshold`."""
    equalize: Annotated[float, Range(0, 1000)] = 0.0
    """Clip limit of the local contrast equalization (CLAHE) before detection; 0 leaves images unchanged."""
    long_side: LongSide = 1000
    """Longer side in pixels to which larger frames are reduced for detection."""
    max_ratio: PositiveShare = 0.8
    """Largest ratio of the nearest to the second nearest descriptor distance (angles) of a match."""


@dataclass(frozen=True)
class MappingSettings(Settings):
    """From verified matches to cameras and points (`sfm/colmap/mapping.py`)."""

    method: Literal["auto", "incremental", "global"] = "auto"
    """Mapper of a clip or a chunk: incremental, global (GLOMAP), or both and the better result (auto)."""
    chunk_frames: Annotated[int, Range(8)] = 48
    """Largest number of frames of a chunk; `auto` maps clips with more than twice as many in chunks that are joined."""
    chunk_overlap: Annotated[int, Range(2)] = 8
    """Number of frames that neighboring chunks share."""
    focal_ladder: Annotated[tuple[Annotated[float, Range(0.1, 20)], ...], NotEmpty()] = (0.75, 1.1, 0.6, 1.5)
    """Focal lengths, as multiples of the image width, tried in turn if the lens is unknown and frames are not
    registered."""
    k1: Annotated[float, Range(-1, 1)] = 0.03
    """Radial distortion that the trials of focal lengths start from."""
    enough: Share = 1.0
    """Share of registered frames at which no further focal lengths are tried."""
    retry_ratio: PositiveShare = 0.9
    """Ratio test of the second matching of frames that were not registered."""
    navigation: bool = True
    """Use the navigation that is given (`--nav`): its positions as priors of those of the cameras, and to join parts
    that share no ground."""
    min_frames: Annotated[int, Range(2)] = 3
    """Smallest number of registered frames of a result."""
    min_share: Share = 0.2
    """Smallest share of registered frames of a result."""
    thin_points: CountOrZero = 150
    """Mean number of points per frame below which a model may be a passing animal; it is refused unless it holds
    `thin_share` of the frames."""
    thin_share: Share = 0.6
    """Share of the frames from which a model with few points is accepted."""
    opencv_gain: Share = 0.03
    """Relative decrease of the reprojection error from which camera `auto` compares lenses on frames that they were not
    fitted to, and by which one with more freedom must be better there."""


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
class ColmapSettings(LensSettings):
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
    """Number of most similar frames elsewhere in the clip (VLAD) that each frame is matched with; five times as many
    for folders of images."""
    threads: Threads = 0
    """Number of threads for features and matching; 0 uses all cores."""
    features: FeatureSettings = field(default_factory=FeatureSettings)
    mapping: MappingSettings = field(default_factory=MappingSettings)
    depth: PlaneSweepSettings = field(default_factory=PlaneSweepSettings)
    moving: MovingChoice = "auto"
    """Masks of moving objects: found where they hide surfaces that other frames measured (auto), or none."""
    light: LightChoice = "sun"
    """Light of the dive: the sun, a lamp on the camera, or the one of them that the frames tell (auto)."""
    flicker: FlickerChoice = "auto"
    """Sunlight that flickers over the ground (caustics): evened out where the frames show it (auto), or kept as filmed.
    """
    water: SeathruSettings = field(default_factory=SeathruSettings)
    restore: RestoreSettings = field(default_factory=RestoreSettings)

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
class Mast3rSettings(LensSettings):
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
    light: LightChoice = "sun"
    """Light of the dive: the sun, a lamp on the camera, or the one of them that the frames tell (auto)."""
    flicker: FlickerChoice = "auto"
    """Sunlight that flickers over the ground (caustics): evened out where the frames show it (auto), or kept as filmed.
    """
    water: SeathruSettings = field(default_factory=SeathruSettings)
    restore: RestoreSettings = field(default_factory=RestoreSettings)

    @property
    def backend(self) -> BackendName:
        """The back end as --backend names it."""
        return "mast3r" if self.adapter is None else "swimm3r"


@dataclass(frozen=True)
class ColmapModelSettings(Settings):
    """Poses and points of a COLMAP model that exists; depth, water and cloud are found as without one."""

    model: Path
    """Folder with cameras, images and points3D (.bin or .txt), or one above its sparse/0; or another program's file
    (`swimm3r.io.imports.read.read_foreign`)."""
    features: FeatureSettings = field(default_factory=FeatureSettings)
    depth: PlaneSweepSettings = field(default_factory=PlaneSweepSettings)
    moving: MovingChoice = "auto"
    """Masks of moving objects: found where they hide surfaces that other frames measured (auto), or none."""
    light: LightChoice = "sun"
    """Light of the dive: the sun, a lamp on the camera, or the one of them that the frames tell (auto)."""
    flicker: FlickerChoice = "auto"
    """Sunlight that flickers over the ground (caustics): evened out where the frames show it (auto), or kept as filmed.
    """
    water: SeathruSettings = field(default_factory=SeathruSettings)
    restore: RestoreSettings = field(default_factory=RestoreSettings)

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
