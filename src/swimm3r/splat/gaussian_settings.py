"""The numbers of the peers, which splat Gaussians; torch-free.

Windows and cadences are fractions of `iterations`, exact at the length each was published with. Lengths are in working
units (`settings.py`). Every peer starts from the cloud, and from as many primitives, as UWBS does.
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from swimm3r.settings import (
    Cadence,
    Count,
    DecayingRate,
    LongSideOrOwn,
    MapSize,
    NotNegative,
    Opacity,
    Positive,
    PositiveShare,
    Range,
    Rate,
    Seed,
    Settings,
    Share,
)
from swimm3r.splat.shared_settings import MediumFieldSettings, RecipeName, TrainingPoseSettings


@dataclass(frozen=True)
class GaussianInitialSettings(Settings):
    """The Gaussians that training starts from."""

    primitives: MapSize = 400_000
    """Points of the cloud and its backdrop that become primitives, one per voxel."""
    backdrop: Share = 0.2
    """Largest share of them that lies on ground whose depth is a guess."""
    colors: Literal["restored", "raw"] = "raw"
    """As filmed, or without the water for maps that have one."""
    harmonics: Annotated[int, Range(0, 3)] = 3
    """Degree of the colors' spherical harmonics."""
    scale: Annotated[float, Range(1e-3, 1e3)] = 1.0
    """In root mean square distances to the 3 nearest neighbors."""
    opacity: Opacity = 0.1


@dataclass(frozen=True)
class GaussianRenderSettings(Settings):
    """How a Gaussian meets a camera."""

    depth: Literal["ray", "z"] = "z"
    """The depth that attenuates: along the ray, or along the optical axis as the peers have it."""
    alpha_min: Annotated[float, Range(0, 0.5)] = 1 / 255
    """Pairs fainter than this are skipped."""
    near: Annotated[float, Range(above=0, most=1e6)] = 0.01
    """Primitives nearer than this z depth are not drawn."""
    medium_depth_grad: Literal["full", "detach"] = "full"
    """Whether what the water takes and adds may move a primitive in depth."""


@dataclass(frozen=True)
class GaussianRates(Settings):
    """Of Adam (eps 1e-15); positions decay log-linearly over the run."""

    xyz: DecayingRate = 1.6e-4
    """Times the scene's radius, as is its end."""
    xyz_end: DecayingRate = 1.6e-6
    quaternion: Rate = 1e-3
    scale: Rate = 5e-3
    opacity: Rate = 5e-2
    color: Rate = 2.5e-3
    harmonics: Rate = 1.25e-4
    short_run_rate_exponent: Annotated[float, Range(0, 4)] = 0.5
    """In runs shorter than the published one the rates of positions, rotations and colors grow with its length over
    theirs to this power, at most fourfold; 0 keeps them. UWBS's `fast` preset has rates raised by as much, and 400
    steps of Gaussian MCMC on ruie_green_rock gain 1.2 dB by it on frames held back."""


@dataclass(frozen=True)
class GaussianSettings(Settings):
    """What all peers have."""

    iterations: Count = 30_000
    long_side: LongSideOrOwn = 1600
    """Longer side of the training images, pixels; they are never enlarged."""
    working_depth: Annotated[float, Range(1e-3, 1e6)] = 3.0
    """Median depth, working units, that a scene without metric scale is given while it is trained."""
    cap_max: MapSize = 800_000
    initial: GaussianInitialSettings = field(default_factory=GaussianInitialSettings)
    render: GaussianRenderSettings = field(default_factory=GaussianRenderSettings)
    rates: GaussianRates = field(default_factory=GaussianRates)
    degree_every: Cadence = 1 / 30
    """Share of the run between two degrees of the colors' harmonics."""
    poses: TrainingPoseSettings = field(default_factory=TrainingPoseSettings)
    seed: Seed = 0
    log_every: Cadence = 0.005
    checkpoint_every: Cadence = 0.1

    @property
    def depth_confidence(self) -> float | None:
        """No peer reads depth."""
        return None


@dataclass(frozen=True)
class McmcSettings(Settings):
    """Relocation, growth and noise (3DGS-MCMC), with its regularizers."""

    refine_start: Share = 1 / 60  # 500 of 30,000
    refine_stop: Share = 5 / 6  # 25,000 of 30,000
    refine_every: Cadence = 1 / 300  # 100 of 30,000
    min_refine_every: Count = 20
    """Fewest steps between two rounds, whatever `refine_every` says; growth is made up for."""
    growth: Annotated[float, Range(1, 2)] = 1.05
    """Per round at `refine_every`."""
    min_opacity: Opacity = 0.005
    noise: NotNegative = 5e5
    """Times the positions' learning rate, with every step."""


@dataclass(frozen=True)
class McmcWeights(Settings):
    """Of the losses, all the run."""

    ssim: Share = 0.2
    opacity: NotNegative = 0.01
    scale: NotNegative = 0.01


@dataclass(frozen=True)
class McmcGsSettings(GaussianSettings):
    """Gaussian MCMC without water: 3R-GS with the poses refined, 3DGS-MCMC without."""

    initial: GaussianInitialSettings = field(default_factory=lambda: GaussianInitialSettings(scale=0.1, opacity=0.5))
    weights: McmcWeights = field(default_factory=McmcWeights)
    densify: McmcSettings = field(default_factory=McmcSettings)
    poses: TrainingPoseSettings = field(
        default_factory=lambda: TrainingPoseSettings(rate=2.25e-4, epipolar_end=0.1)  # 1.5e-4 and 3,000 in 30,000
    )

    @property
    def recipe(self) -> RecipeName:
        """The name of the method."""
        return "threers_gs" if self.poses.enabled else "mcmc_gs"


@dataclass(frozen=True)
class AbsGradSettings(Settings):
    """Multiplication by absolute gradients, culls, and cuts of the opacities (WaterSplatting)."""

    refine_start: Share = 1 / 30  # 500 of 15,000
    refine_stop: Share = 2 / 3  # 10,000 of 15,000
    refine_every: Cadence = 1 / 150  # 100 of 15,000
    min_refine_every: Count = 40
    """Fewest steps between two rounds, whatever `refine_every` says: a round needs its views."""
    grow_grad2d: NotNegative = 8e-4
    """Least mean gradient of a projected center, in half images."""
    grow_scale3d: NotNegative = 1e-3
    """Scale from which on a Gaussian is split instead of doubled, in radii of the cameras' path."""
    prune_opacity: Share = 0.5
    """Fainter Gaussians are culled by a round,"""
    prune_opacity_late: Share = 0.1
    """and these after the last."""
    prune_scale3d: Positive = 10.0
    """Scale above which they are culled, in radii of the cameras' path."""
    reset_every: Share = 1 / 30  # 500 of 15,000
    """Share of the run between two cuts of the opacities; 0 for none."""
    reset_opacity: Opacity = 0.5
    """What they are cut to."""


@dataclass(frozen=True)
class RelativeWeights(Settings):
    """Of reg-L1 and reg-SSIM."""

    ssim: Share = 0.2
    floor: PositiveShare = 1e-3
    """Added to the rendered value that errors are divided by."""


@dataclass(frozen=True)
class WaterSplattingSettings(GaussianSettings):
    """Gaussians in water that a network knows for every direction."""

    iterations: Count = 15_000
    initial: GaussianInitialSettings = field(default_factory=lambda: GaussianInitialSettings(colors="restored"))
    medium: MediumFieldSettings = field(
        default_factory=lambda: MediumFieldSettings(layers=1, activation="sigmoid", biases=False, begin=0.0)
    )
    medium_rate: DecayingRate = 1e-3
    medium_rate_end: DecayingRate = 1.5e-4
    rates: GaussianRates = field(default_factory=lambda: GaussianRates(xyz_end=5e-5))
    weights: RelativeWeights = field(default_factory=RelativeWeights)
    densify: AbsGradSettings = field(default_factory=AbsGradSettings)
    degree_every: Cadence = 1 / 15
    first_divisor: Annotated[int, Range(1, 64)] = 4
    """By how much the training images are smaller at first,"""
    double_every: Cadence = 0.2  # 3,000 of 15,000
    """and the share of the run after which they double."""

    @property
    def recipe(self) -> RecipeName:
        """The name of the method."""
        return "watersplatting"


@dataclass(frozen=True)
class GradientSettings(Settings):
    """Multiplication by gradients, culls, and cuts of the opacities (3DGS)."""

    refine_start: Share = 1 / 60  # 500 of 30,000
    refine_stop: Share = 0.5  # 15,000 of 30,000
    refine_every: Cadence = 1 / 300  # 100 of 30,000
    min_refine_every: Count = 40
    """Fewest steps between two rounds, whatever `refine_every` says: a round needs its views."""
    grow_grad2d: NotNegative = 2e-4
    """Least mean gradient of a projected center, in half images."""
    grow_scale3d: NotNegative = 0.01
    """Scale from which on a Gaussian is split instead of doubled, in radii of the cameras' path."""
    prune_opacity: Share = 0.005
    """Fainter Gaussians are culled,"""
    prune_scale3d: Positive = 0.1
    """and, after the first cut, those of larger scales, in radii of the cameras' path,"""
    largest_radius: Positive = 20.0
    """or of larger radius in a training image, pixels."""
    reset_every: Share = 0.1  # 3,000 of 30,000
    """Share of the run between two cuts of the opacities; 0 for none."""
    reset_opacity: Opacity = 0.01
    """What they are cut to."""


@dataclass(frozen=True)
class SeaSplatWeights(Settings):
    """Of the losses; those on J, and the dark channel's, begin with the water."""

    ssim: Share = 0.2
    far: NotNegative = 1.0
    """Of the error in proportion to depth."""
    background: NotNegative = 0.01
    """Of what covers pixels that have the color of the open water."""
    background_distance: Positive = 0.2 * 3**0.5
    """Largest distance in RGB of a color that counts as such."""
    smooth_depth: NotNegative = 2.0
    gray: NotNegative = 0.1
    saturation: NotNegative = 2.0
    saturated: NotNegative = 0.7
    """Clear colors are to be darker than this."""
    dark: NotNegative = 1.0
    """Of the light left when the backscatter is taken away,"""
    negative: NotNegative = 1000.0
    """and of backscatter beyond the image, in units of the former."""


@dataclass(frozen=True)
class SceneWaterSettings(Settings):
    """When the water comes, and how often it learns."""

    begin: Share = 1 / 3  # 10,000 of 30,000
    """Share of the run before which there is a background instead."""
    rate: Rate = 1e-2
    """Of Adam, for water and background."""
    first_burst: Annotated[float, Range(0, 10)] = 1 / 30
    """Steps of the water alone when it comes, 1,000, as a share of the run, which does not count them;"""
    color_burst: Annotated[float, Range(0, 10)] = 1 / 15
    """then of the colors alone, 2,000."""
    every: Cadence = 1 / 300
    """Share of the run between two more bursts of the water, 100 steps,"""
    burst: Annotated[float, Range(0, 10)] = 0.5
    """and how long they are, 50 steps, as a share of that."""


@dataclass(frozen=True)
class SeaSplatSettings(GaussianSettings):
    """Gaussians, and one set of water coefficients for the scene."""

    initial: GaussianInitialSettings = field(default_factory=lambda: GaussianInitialSettings(harmonics=0))
    weights: SeaSplatWeights = field(default_factory=SeaSplatWeights)
    densify: GradientSettings = field(default_factory=GradientSettings)
    water: SceneWaterSettings = field(default_factory=SceneWaterSettings)

    @property
    def recipe(self) -> RecipeName:
        """The name of the method."""
        return "seasplat"
