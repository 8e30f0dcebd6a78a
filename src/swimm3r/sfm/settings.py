"""Every number of the structure-from-motion stage, with its reason; torch-free, so that --help is instant."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

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

BackendName = Literal["colmap", "mast3r", "swimm3r"]


@dataclass(frozen=True)
class PlaneSweepSettings(Settings):
    """Dense depth of posed frames (`sfm/plane_sweep/estimate.py`)."""

    long_side: LongSide = 640
    """Pixels of the longer side at which depth is computed; larger frames get it upsampled along their edges."""
    sources: Annotated[int, Range(1, 16)] = 5
    """Frames each frame is compared with."""
    angle_deg: Annotated[float, Range(above=0, most=90)] = 8.0
    """Triangulation angle at which a source counts most: less is imprecise, more hides surfaces and changes them."""
    planes: Annotated[int, Range(32, 1024)] = 128
    """Most planes of the coarse sweep, even in inverse depth; fewer where views are close: one per pixel of motion."""
    window: Annotated[int, Range(1, 16)] = 3
    """Half width of the coarse sweep's NCC window, in pixels of the half-size image."""
    noise: PositiveShare = 0.8 / 255
    """Standard deviation of gray below which a window says nothing."""
    smooth: NotNegative = 0.15
    """Price of one plane of disagreement between neighbors in the semi-global step; a jump costs eight times that."""
    rounds: Annotated[int, Range(0, 32)] = 3
    """Rounds of slanted-plane refinement at full working size."""
    smooth_fine: NotNegative = 0.05
    """Price there of one source pixel of disagreement with the neighbors."""
    min_ncc: Annotated[float, Range(0, below=1)] = 0.4
    """Correlation with the sources below which a depth is dropped."""
    min_peak: NotNegative = 0.12
    """Share by which 1 - NCC must rise 2.5 pixels beside a match; below, the depth is dropped as undetermined."""
    tolerance: Share = 0.015
    """Relative difference in depth up to which two frames agree; or what the reprojection error allows, if more."""
    agreeing: Annotated[int, Range(0, 16)] = 2
    """Other frames that must agree with a depth."""
    speck: CountOrZero = 48
    """Connected patches smaller than this are dropped, pixels at working size."""
    threads: Threads = 0
    """Frames computed at once; 0 takes every core, at most 8."""


@dataclass(frozen=True)
class TrackSettings(Settings):
    """Pixels of several depth maps grouped into surface points (`sfm/medium/dense_tracks.py`)."""

    tolerance: Share = 0.02
    """Relative difference in z depth up to which two frames show the same point."""
    max_color_change: Share = 0.3
    """Largest change of a channel between two observations; water alone changes less between neighboring distances."""
    max_views: Count = 12
    """Other frames in which the points of one frame are looked up."""
    min_overlap: Share = 0.1
    max_tracks: Count = 1_000_000


@dataclass(frozen=True)
class RestoreSettings(Settings):
    """Images and points with the water removed (`sfm/medium/restore.py`). Values are 0..1."""

    noise: PositiveShare = 0.01
    """Standard deviation of a pixel: sensor and compression."""
    texture: PositiveShare = 0.1
    """Standard deviation of J within a small window."""
    veil_error: PositiveShare = 0.006
    """What B(z) may be wrong by; where T_D is not well above it, J is taken from the channels that still see."""
    color_error: PositiveShare = 0.12
    """Error of J that would be accepted."""
    window: Annotated[float, Range(0.001, 0.25)] = 0.02
    """Standard deviation of the local windows, as a share of the long side."""
    max_points: Annotated[int, Range(100)] = 500_000
    """Of the restored cloud, thinned by voxels."""
    white_balance: bool = True
    """Gray-world gains, one triple per dive, on the images made for looking at (restored/, clear renders); points, the
    images in restored_physical/ and all scores stay physical."""


@dataclass(frozen=True)
class SeathruSettings(Settings):
    """The water from images and depth (`sfm/medium/seathru.py`); values are 0..1, standard deviations without unit."""

    tracks: TrackSettings = field(default_factory=TrackSettings)
    max_pixels: Count = 300_000
    """Single pixels drawn from all frames together."""
    open_water_pixels: Count = 2_000
    """Most pixels of open water taken from one frame."""
    patch_pixels: Positive = 12.0
    """Edge of a patch of surface, in pixels of its farthest observation; at most 1/32 of the image's long side."""
    patch_observations: Count = 6
    """Fewest pixels of a patch in a frame."""
    patch_offset: NotNegative = 0.15
    """Largest distance between the centroids of a patch and of what a frame shows of it, in edges."""
    range_bins: Annotated[int, Range(1, 1000)] = 10
    dark_fraction: PositiveShare = 0.01  # Sea-Thru: the darkest 1 % of each range bin
    min_bin_pixels: Count = 50
    dark_std: PositiveShare = 0.015
    """How far the dark envelope of one range bin may stray."""
    dark_reflectance: Share = 0.02
    """J of the darkest 1 %: black things are rarely quite black."""
    dark_reflectance_std: PositiveShare = 0.03
    lsac_f: Positive = 2.0
    """Sea-Thru's f: the illuminant is f times the local average color, so surfaces reflect 1 / f on average."""
    mean_reflectance_std: Positive = 0.5
    """Of ln(1 / f) for a whole dive: what the gray-world guess is worth."""
    average_std: Positive = 0.3
    """Of the ln of one range bin's average color."""
    slope_std: Positive = 0.1
    """Of b times the median depth in beta_D(z) = a exp(b z)."""
    open_water_std: PositiveShare = 0.01
    far_color_std: PositiveShare = 0.2
    """How far Binf may be from the mean color of the farthest tenth, where no open water is in view."""
    min_open_water: Count = 200
    min_samples: Count = 500
    min_tracks: Count = 100
    min_depth_ratio: Annotated[float, Range(1)] = 1.05
    """Farthest over nearest observation of a point that enters the fit."""
    black: Share = 0.002
    saturated: Share = 0.98
    max_observations: Count = 200_000
    start_observations: Count = 5_000
    min_redundancy: Positive = 3.0
    """At least so many observations share one error."""
    loss_scale: PositiveShare = 0.02
    """Residuals beyond it count as outliers."""
    reweightings: Annotated[int, Range(1, 100)] = 6
    depth_error: Share = 0.01
    """Relative error of one observation's ray depth, beyond what all observations of a point share."""
    gain_std: Share = 0.1
    """First guess of how much exposure and white balance vary between frames; then estimated."""
    gain_evidence: Share = 0.85
    """Gains are used where they shrink the residuals below this share."""
    std_inflation: Positive = 2.0
    """Of the standard deviations beyond what residuals show (benchmarks/seathru_calibration.py)."""
    identifiable_std: NotNegative = 0.065
    """A coefficient is identifiable below this relative standard deviation (benchmarks/seathru_calibration.py)."""


@dataclass(frozen=True)
class FeatureSettings(Settings):
    """SIFT and its matching (`sfm/features/sift.py`)."""

    count: Annotated[int, Range(1, 1_000_000)] = 2048
    """Most keypoints of a frame; one with two orientations counts once."""
    peak_threshold: PositiveShare = 0.003
    """Contrast a keypoint needs, of 1; COLMAP's 0.0067 starves in haze."""
    faint_threshold: PositiveShare = 0.001
    """The same for frames that yield fewer than `count`: it places 14 of ruie_murky's 14 frames, not 12."""
    equalize: Annotated[float, Range(0, 1000)] = 0.0
    """Clip limit of the local contrast equalization (CLAHE) before detection; 0 leaves images as they are."""
    long_side: LongSide = 1000
    """Larger frames are reduced to this many pixels for detection."""
    max_ratio: PositiveShare = 0.8
    """Nearest over second nearest descriptor, angles."""


@dataclass(frozen=True)
class MappingSettings(Settings):
    """From verified matches to cameras and points (`sfm/colmap/mapping.py`)."""

    method: Literal["auto", "incremental", "global"] = "auto"
    """Auto places clips below `global_from` frames both ways and keeps what explains more; above, globally (GLOMAP)."""
    global_from: CountOrZero = 100
    focal_ladder: Annotated[tuple[Annotated[float, Range(0.1, 20)], ...], NotEmpty()] = (0.75, 1.1, 0.6, 1.5)
    """Focal lengths per image width that are tried in turn while frames are left over; no lens is known better."""
    k1: Annotated[float, Range(-1, 1)] = 0.03
    """Radial distortion the ladder starts from: what a flat port leaves of a corrected lens."""
    enough: Share = 1.0
    """Share of the frames at which the ladder is left early."""
    retry_ratio: PositiveShare = 0.9
    """Ratio test of the second matching of frames that were left over."""
    min_frames: Annotated[int, Range(2)] = 3
    min_share: Share = 0.2
    """Share of the frames below which the result is refused."""
    thin_points: CountOrZero = 150
    """Points seen by the mean frame below which a model may well be a passing animal (dolphin_dynamic 93,
    ruie_murky 219); it is refused unless it holds `thin_share` of the frames."""
    thin_share: Share = 0.6
    opencv_gain: Share = 0.03
    """Relative drop of the reprojection error that buys OPENCV's further parameters where the model is "auto"."""


@dataclass(frozen=True)
class LensSettings(Settings):
    """The one lens of a clip, as far as it is known (`sfm/lens.py`)."""

    focal: Positive | None = None
    """Focal length, pixels of the prepared frames, measured in water, or in air where `housing` is flat: a start value,
    which `intrinsics` or `alignment.intrinsics` can hold. The MASt3R back end always holds a lens with distortion."""
    k1: LensParameter | None = None
    k2: LensParameter | None = None
    k3: LensParameter | None = None
    """OPENCV_FISHEYE only, as k4."""
    k4: LensParameter | None = None
    p1: LensParameter | None = None
    p2: LensParameter | None = None


@dataclass(frozen=True)
class ColmapSettings(LensSettings):
    """Structure from motion without weights: pycolmap, plane sweep, Sea-Thru."""

    camera: Literal["auto", "SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"] = "auto"
    """One lens for the whole clip. Auto: SIMPLE_RADIAL, or OPENCV where it explains the matches clearly better."""
    intrinsics: Literal["prior", "fixed"] = "prior"
    """Whether the numbers above are a start for refinement or the truth."""
    housing: Literal["none", "flat", "dome"] = "none"
    """A flat port lengthens the focal length by water's 1.333; given and assumed ones are multiplied by it."""
    pairs: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Auto: every pair up to `exhaustive_to` frames; above, neighbors in time (video) and frames that look alike."""
    exhaustive_to: CountOrZero = 60
    overlap: CountOrZero = 10
    """Neighbors in time each frame is matched with, and some at doubling distances."""
    loops: CountOrZero = 6
    """Frames elsewhere in the clip that look most alike (VLAD), matched with each frame; 5 times that for stills."""
    threads: Threads = 0
    """0: every core."""
    features: FeatureSettings = field(default_factory=FeatureSettings)
    mapping: MappingSettings = field(default_factory=MappingSettings)
    depth: PlaneSweepSettings = field(default_factory=PlaneSweepSettings)
    water: SeathruSettings = field(default_factory=SeathruSettings)
    restore: RestoreSettings = field(default_factory=RestoreSettings)

    @property
    def backend(self) -> BackendName:
        """The back end as --backend names it."""
        return "colmap"


@dataclass(frozen=True)
class Mast3rSettings(LensSettings):
    """Structure from motion by the MASt3R network: pointmaps and matches of pairs of frames, aligned; Sea-Thru."""

    weights: Path | None = None
    """The checkpoint (.pth or .safetensors); else the one that `swimm3r weights path mast3r` prints."""
    adapter: Path | None = None
    """An adapter.safetensors of train-sfm: matches and depth are then the student's, and the water its head's."""
    graph: str = "video"
    """Pairs to look at: video[-WINDOW-CLOSURES], complete, swin-K, logwin-K, oneref-FRAME, retrieval-KEYS-K."""
    similarity: Literal["cosine", "asmk"] = "cosine"
    """How frames that look alike are found, from the encoder's tokens; asmk needs mast3r-retrieval and its codebook."""
    size: NetworkSide = 512
    """Long side of the images the network sees; it was trained at 512."""
    square_ok: bool = False
    """Square images stay square; else they lose a quarter of their height, as in training."""
    device: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    precision: Literal["float32", "bfloat16", "float16"] = "float32"
    """Of the network's trunk; its heads are always float32."""
    camera: Literal["PINHOLE", "SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"] = "PINHOLE"
    """One lens for the whole clip; its distortion is removed before the network sees an image."""
    known: Path | None = None
    """Cameras that are known: a cameras.json, a COLMAP model or another program's file. Frames it names keep its poses
    (and its unit), the others find theirs; its lens takes the place of the numbers above."""
    min_matches: Count = 16
    """Pairs with fewer matches than this are taken for strangers: a few pixels agree by chance."""
    min_share: Share = 0.9
    """Share of the frames that must hang together through matches; the few others are left out, under a warning."""
    max_matches: Count = 2_000_000
    """Of all pairs together in the alignment, drawn evenly from each: what bounds its memory, not its accuracy."""
    max_error: Positive = 3.0
    """Pixels of the network's image that a match may miss its point by; others are no tracks and not exported."""
    max_points: Annotated[int, Range(100)] = 200_000
    """Sparse points that are kept, those seen in most frames first."""
    min_confidence: NotNegative = 1.5
    """Of the pointmaps (1 and up) below which a pixel's depth is unknown; the reference's viewer has it, too."""
    bundle_adjustment: bool = False
    """Poses and points once more by COLMAP's bundle adjustment of the tracks."""
    memory_mb: Count = 2048
    """For encodings and running sums of frames that are held at once; what does not fit waits on disk."""
    cache: Path | None = None
    """Folder of encodings and pair results, keyed by content, that several runs may share; else the run's own, removed
    at its end."""
    matching: MatchingSettings = field(default_factory=MatchingSettings)
    alignment: AlignmentSettings = field(default_factory=lambda: AlignmentSettings(intrinsics="shared"))
    features: FeatureSettings = field(default_factory=FeatureSettings)
    """By which held-out frames find their place beside a finished reconstruction."""
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
    """The folder with cameras, images and points3D (.bin or .txt), or one above its sparse/0; or another program's file
    (`swimm3r.io.imports.read.read_foreign`)."""
    features: FeatureSettings = field(default_factory=FeatureSettings)
    depth: PlaneSweepSettings = field(default_factory=PlaneSweepSettings)
    water: SeathruSettings = field(default_factory=SeathruSettings)
    restore: RestoreSettings = field(default_factory=RestoreSettings)

    @property
    def backend(self) -> BackendName:
        """The back end as --backend names it: the one whose depth and water these settings share."""
        return "colmap"


SfmSettings = ColmapSettings | Mast3rSettings | ColmapModelSettings
