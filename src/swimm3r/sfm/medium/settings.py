"""Numbers of the water and of restored images, each with its reason; torch-free."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from swimm3r.settings import Count, NotNegative, Positive, PositiveShare, Range, Settings, Share

LightChoice = Literal["auto", "sun", "lamp"]
FlickerChoice = Literal["auto", "keep"]
AppearanceChoice = Literal["auto", "keep"]


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
class SeathruSettings(Settings):
    """The water from images and depth (`sfm/medium/seathru.py`); values are 0..1, standard deviations without unit."""

    tracks: TrackSettings = field(default_factory=TrackSettings)
    max_pixels: Count = 300_000
    """Number of single pixels drawn from all frames together."""
    open_water_pixels: Count = 2_000
    """Largest number of open-water pixels taken from one frame."""
    patch_pixels: Positive = 20.0
    """Edge length of a surface patch in pixels of its farthest observation; at most 1/16 of the longer side."""
    patch_grids: Annotated[int, Range(1, 16)] = 4
    """Number of shifted grids of patches, each of which has every surface point in one of its patches."""
    patch_observations: Count = 6
    """Smallest number of pixels of a patch in a frame."""
    patch_share: Share = 0.6
    """Smallest share of a patch's surface points that a frame must show."""
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
    lamp_slope_std: Positive = 0.01
    """The same under a lamp, of whose fall-off with distance b is told by little."""
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
    """Smallest number of observations, for one grid of patches, that share one error term."""
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
    lamp_explained: Share = 0.25
    """Smallest share of the variance of points' light, after distance, that their places in the images explain under a
    lamp, with `light auto`; the light must fall with distance, too (`lamp_fall_off`)."""
    lamp_fall_off: NotNegative = 0.7
    """Smallest power of the distance that a lamp's light falls with, with `light auto`: 0.9 in clear water, more in
    any other."""
    lamp_alone: Share = 0.45
    """Share explained from which a lamp is assumed where the points' distances do not tell whether the power is larger
    or smaller than that, as over level ground seen from one height, with `light auto`."""
    lamp_change: NotNegative = 0.1
    """Smallest standard deviation, over the images, of the logarithm of a lamp's light, with `light auto`."""
    std_inflation: Positive = 2.0
    """Factor on the standard deviations beyond that of the residuals (benchmarks/seathru_calibration.py)."""
    identifiable_std: NotNegative = 0.065
    """Relative standard deviation below which a coefficient counts as identifiable (benchmarks/seathru_calibration.py).
    """


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


@dataclass(frozen=True, kw_only=True)
class MediumSettings(Settings):
    """The light, the water and all that is restored with them (`sfm/medium/apply.py`), the same for each back end."""

    light: LightChoice = "auto"
    """Light of the dive: the sun, a lamp on the camera, or the one of them that the frames tell (auto); with an
    adapter's water the sun."""
    flicker: FlickerChoice = "auto"
    """Sunlight that flickers over the ground (caustics): evened out where the frames show it (auto), or kept as filmed.
    """
    appearance: AppearanceChoice = "auto"
    """Exposure and white balance of single frames: restored frames and cloud as one exposure would show them where the
    frames tell that theirs differ (auto), or as filmed (keep)."""
    water: SeathruSettings = field(default_factory=SeathruSettings)
    restore: RestoreSettings = field(default_factory=RestoreSettings)
