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
    MapSize,
    NotNegative,
    Opacity,
    Positive,
    PositiveShare,
    Range,
    Rate,
    Settings,
    Share,
)
from swimm3r.splat.shared_settings import (
    DILATION,
    MapSettings,
    MediumFieldSettings,
    RefineSettings,
    TrainingPoseSettings,
)


@dataclass(frozen=True)
class GaussianInitialSettings(Settings):
    """The Gaussians that training starts from."""

    primitives: MapSize = 400_000
    """Number of points of the cloud and its backdrop that become Gaussians, for as many pixels each."""
    backdrop: Share = 0.5
    """Largest share of the initial Gaussians on ground of guessed depth; 0 starts from measured points alone."""
    colors: Literal["restored", "raw"] = "raw"
    """Colors of the initial Gaussians: raw, or restored for maps with a medium."""
    harmonics: Annotated[int, Range(0, 3)] = 3
    """Degree of the colors' spherical harmonics."""
    scale: Annotated[float, Range(1e-3, 1e3)] = 1.0
    """Spatial scale of a Gaussian, in root mean square distances to its 3 nearest neighbors."""
    opacity: Opacity = 0.1
    """Opacity of the initial Gaussians, between 0 and 1."""


@dataclass(frozen=True)
class GaussianRenderSettings(Settings):
    """Projection and compositing of Gaussians."""

    depth: Literal["ray", "z"] = "z"
    """Depth that light is attenuated over: along the ray, or along the optical axis as published."""
    alpha_min: Annotated[float, Range(0, 0.5)] = 1 / 255
    """Smallest opacity of a Gaussian at a pixel that is drawn."""
    near: Annotated[float, Range(above=0, most=1e6)] = 0.01
    """Smallest z depth of a Gaussian that is drawn."""
    antialiasing: Literal["mip", "dilation"] = "dilation"
    """Filter of Gaussians: none smaller than a pixel of the training images, and averaged over the pixels of the view
    (mip, Mip-Splatting), or widened in every view (dilation), as in 3DGS."""
    dilation: Annotated[float, Range(0, 10)] = DILATION
    """Variance added to every Gaussian on the image plane, pixels^2 (dilation)."""
    medium_depth_grad: Literal["full", "detach"] = "full"
    """Gradient of the medium's terms to the Gaussians' depths: full, or detached."""


@dataclass(frozen=True)
class GaussianRates(Settings):
    """Adam's learning rates (eps 1e-15); positions decay log-linearly over the run."""

    xyz: DecayingRate = 1.6e-4
    """Initial learning rate of the positions, times the scene's radius."""
    xyz_end: DecayingRate = 1.6e-6
    """Final learning rate of the positions, times the scene's radius."""
    quaternion: Rate = 1e-3
    """Learning rate of the rotations."""
    scale: Rate = 5e-3
    """Learning rate of the scales."""
    opacity: Rate = 5e-2
    """Learning rate of the opacities."""
    color: Rate = 2.5e-3
    """Learning rate of the colors' constant part."""
    harmonics: Rate = 1.25e-4
    """Learning rate of the colors' higher harmonics."""
    short_run_rate_exponent: Annotated[float, Range(0, 4)] = 0.5
    """Exponent of the factor, published length over length of the run, on the rates of positions, rotations and colors
    in shorter runs; at most fourfold, 0 keeps the rates."""


@dataclass(frozen=True)
class GaussianSettings(MapSettings):
    """Settings that all renderers with Gaussians share."""

    iterations: Count = 30_000
    cap_max: MapSize = 800_000
    """Largest number of Gaussians in the map."""
    initial: GaussianInitialSettings = field(default_factory=GaussianInitialSettings)
    render: GaussianRenderSettings = field(default_factory=GaussianRenderSettings)
    rates: GaussianRates = field(default_factory=GaussianRates)
    degree_every: Cadence = 1 / 30
    """Share of the run between two degrees of the colors' spherical harmonics."""

    @property
    def reads_depth(self) -> bool:
        """True where training reads measured depth."""
        return False

    @property
    def guesses_depth(self) -> bool:
        """True where training asks for a guess at depth that was not measured."""
        return False


@dataclass(frozen=True)
class McmcSettings(RefineSettings):
    """Relocation, growth and noise (3DGS-MCMC), with its regularizers."""

    refine_start: Share = 1 / 60  # 500 of 30,000
    refine_stop: Share = 5 / 6  # 25,000 of 30,000
    refine_every: Cadence = 1 / 300  # 100 of 30,000
    growth: Annotated[float, Range(1, 2)] = 1.05
    """Factor by which the number of Gaussians grows in each densification round."""
    min_opacity: Opacity = 0.005
    """Opacity below which a Gaussian is relocated."""
    noise: NotNegative = 5e5
    """Scale of the noise on positions in every step, times their learning rate."""


@dataclass(frozen=True)
class McmcWeights(Settings):
    """Loss weights, constant over the run."""

    ssim: Share = 0.2
    """Weight of D-SSIM against L1 in the image loss."""
    opacity: NotNegative = 0.01
    """Weight of the Gaussians' opacities."""
    scale: NotNegative = 0.01
    """Weight of the Gaussians' scales."""


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
    def recipe(self) -> Literal["threers_gs", "mcmc_gs"]:
        """The name of the method."""
        return "threers_gs" if self.poses.enabled else "mcmc_gs"


@dataclass(frozen=True)
class AbsGradSettings(RefineSettings):
    """Multiplication by absolute gradients, culls, and cuts of the opacities (WaterSplatting)."""

    refine_start: Share = 1 / 30  # 500 of 15,000
    refine_stop: Share = 2 / 3  # 10,000 of 15,000
    refine_every: Cadence = 1 / 150  # 100 of 15,000
    min_refine_every: Count = 40
    """Fewest steps between two densification rounds, whatever `refine_every` says, so that gradients average over
    enough views."""
    grow_grad2d: NotNegative = 8e-4
    """Mean absolute gradient of a projected center, in half images, from which a Gaussian is split or duplicated."""
    grow_scale3d: NotNegative = 1e-3
    """Scale from which a Gaussian is split instead of duplicated, in radii of the cameras' path."""
    prune_opacity: Share = 0.5
    """Opacity below which Gaussians are culled in a densification round."""
    prune_opacity_late: Share = 0.1
    """Opacity below which Gaussians are culled after the last densification round."""
    prune_scale3d: Positive = 10.0
    """Scale above which Gaussians are culled, in radii of the cameras' path."""
    reset_every: Share = 1 / 30  # 500 of 15,000
    """Share of the run between two resets of the opacities; 0 for none."""
    reset_opacity: Opacity = 0.5
    """Largest opacity after a reset."""


@dataclass(frozen=True)
class RelativeWeights(Settings):
    """Weights of the losses that are relative to the rendered value (reg-L1 and reg-SSIM)."""

    ssim: Share = 0.2
    """Weight of reg-SSIM against reg-L1 in the image loss."""
    floor: PositiveShare = 1e-3
    """Constant added to the rendered value that errors are divided by."""


@dataclass(frozen=True)
class WaterSplattingSettings(GaussianSettings):
    """Gaussians in water that a network knows for every direction."""

    iterations: Count = 15_000
    """Number of training steps, one image each."""
    initial: GaussianInitialSettings = field(default_factory=lambda: GaussianInitialSettings(colors="restored"))
    medium: MediumFieldSettings = field(
        default_factory=lambda: MediumFieldSettings(layers=1, activation="sigmoid", biases=False, begin=0.0)
    )
    medium_rate: DecayingRate = 1e-3
    """Initial learning rate of the medium field."""
    medium_rate_end: DecayingRate = 1.5e-4
    """Final learning rate of the medium field."""
    rates: GaussianRates = field(default_factory=lambda: GaussianRates(xyz_end=5e-5))
    weights: RelativeWeights = field(default_factory=RelativeWeights)
    densify: AbsGradSettings = field(default_factory=AbsGradSettings)
    degree_every: Cadence = 1 / 15
    """Share of the run between two degrees of the colors' spherical harmonics."""
    first_divisor: Annotated[int, Range(1, 64)] = 4
    """Factor by which the training images are reduced at first."""
    double_every: Cadence = 0.2  # 3,000 of 15,000
    """Share of the run after which the size of the training images doubles."""

    @property
    def recipe(self) -> Literal["watersplatting"]:
        """The name of the method."""
        return "watersplatting"


@dataclass(frozen=True)
class OceanSplatWeights(RelativeWeights):
    """Loss weights of the image and of the geometry that the map is to have by itself."""

    trinocular: NotNegative = 0.1
    """Weight of the agreement of a view with views from beside and below it."""
    disparity_smoothness: NotNegative = 1e-3  # Monodepth2's; the sources at hand give none
    """Weight of the edge-aware smoothness of disparity, in units of `trinocular`."""
    epipolar: NotNegative = 0.4
    """Weight of the triangulated depth at the start of the run."""
    epipolar_end: NotNegative = 0.2
    """Weight of the triangulated depth at the end of the run; linear in between."""
    residual: NotNegative = 0.01
    """Weight of the distance of Gaussians from the rendered depth."""


@dataclass(frozen=True)
class VirtualViewSettings(Settings):
    """Virtual cameras beside and below a training camera; depths are in thirds of the scene's median depth."""

    baseline: Positive = 0.4
    """Largest vertical translation of a virtual camera, in thirds of the scene's median depth; drawn uniformly."""
    ratio: Positive = 1.5
    """Horizontal translation of a virtual camera, in vertical ones."""
    least_opacity: Share = 0.5  # WaterSplatting culls below it; the sources at hand give none
    """Opacity from which a Gaussian is triangulated."""
    least_alpha: Share = 0.5
    """Smallest rendered alpha of a pixel whose depth is used."""


@dataclass(frozen=True)
class AlphaAdjustmentSettings(Settings):
    """Opacities adjusted by depth and direction early in training; the sources at hand give no numbers."""

    end: Share = 0.2
    """Share of the run for which the adjusted opacities are drawn alone."""
    fade: Share = 0.2
    """Share of the run after that in which they give way to the Gaussians' own."""
    hidden: Annotated[int, Range(1, 4096)] = 128  # the width of the medium's network
    """Width of the hidden layer of the network that adjusts opacities."""


@dataclass(frozen=True)
class OceanSplatSettings(WaterSplattingSettings):
    """WaterSplatting with geometry that agrees between virtual views."""

    iterations: Count = 10_000
    """Number of training steps, one image each."""
    weights: OceanSplatWeights = field(default_factory=OceanSplatWeights)
    densify: AbsGradSettings = field(
        default_factory=lambda: AbsGradSettings(  # densified for 7,000 of 10,000, else WaterSplatting's steps
            refine_start=0.05, refine_stop=0.7, refine_every=0.01, reset_every=0.05
        )
    )
    degree_every: Cadence = 0.1  # 1,000 of 10,000
    """Share of the run between two degrees of the colors' spherical harmonics."""
    virtual: VirtualViewSettings = field(default_factory=VirtualViewSettings)
    alpha: AlphaAdjustmentSettings = field(default_factory=AlphaAdjustmentSettings)

    @property
    def recipe(self) -> Literal["oceansplat"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The name of the method."""
        return "oceansplat"


@dataclass(frozen=True)
class GradientSettings(RefineSettings):
    """Multiplication by gradients, culls, and cuts of the opacities (3DGS)."""

    refine_start: Share = 1 / 60  # 500 of 30,000
    refine_stop: Share = 0.5  # 15,000 of 30,000
    refine_every: Cadence = 1 / 300  # 100 of 30,000
    min_refine_every: Count = 40
    """Fewest steps between two densification rounds, whatever `refine_every` says, so that gradients average over
    enough views."""
    grow_grad2d: NotNegative = 2e-4
    """Mean gradient of a projected center, in half images, from which a Gaussian is split or duplicated."""
    grow_scale3d: NotNegative = 0.01
    """Scale from which a Gaussian is split instead of duplicated, in radii of the cameras' path."""
    prune_opacity: Share = 0.005
    """Opacity below which Gaussians are culled."""
    prune_scale3d: Positive = 0.1
    """Scale above which Gaussians are culled after the first reset, in radii of the cameras' path."""
    largest_radius: Positive = 20.0
    """Radius in a training image, in pixels, above which Gaussians are culled after the first reset."""
    reset_every: Share = 0.1  # 3,000 of 30,000
    """Share of the run between two resets of the opacities; 0 for none."""
    reset_opacity: Opacity = 0.01
    """Largest opacity after a reset."""


@dataclass(frozen=True)
class SeaSplatWeights(Settings):
    """Loss weights; the terms on clear colors and the dark channel start with the medium."""

    ssim: Share = 0.2
    """Weight of D-SSIM against L1 in the image loss."""
    far: NotNegative = 1.0
    """Weight of the image error in proportion to depth."""
    background: NotNegative = 0.01
    """Weight of Gaussians that cover pixels of the open water's color."""
    background_distance: Positive = 0.2 * 3**0.5
    """Largest RGB distance of a pixel to the color of the open water."""
    smooth_depth: NotNegative = 2.0
    """Weight of the edge-aware smoothness of depth."""
    gray: NotNegative = 0.1
    """Weight of the deviation of the clear image's channel means from 0.5."""
    saturation: NotNegative = 2.0
    """Weight of clear colors below 0 or above `saturated`."""
    saturated: NotNegative = 0.7
    """Value above which clear colors are penalized."""
    dark: NotNegative = 1.0
    """Weight of the light that is left after the backscatter is subtracted."""
    negative: NotNegative = 1000.0
    """Weight of backscatter brighter than the image, in units of `dark`."""


@dataclass(frozen=True)
class SceneWaterSettings(Settings):
    """Start of the medium's training, and its alternation with the Gaussians."""

    begin: Share = 1 / 3  # 10,000 of 30,000
    """Share of the run before which a background color stands for the medium."""
    rate: Rate = 1e-2
    """Learning rate of Adam for medium and background."""
    first_burst: Annotated[float, Range(0, 10)] = 1 / 30
    """Steps of the medium alone when it starts, as a share of the run, which does not count them."""
    color_burst: Annotated[float, Range(0, 10)] = 1 / 15
    """Steps of the colors alone after that, as a share of the run, which does not count them."""
    every: Cadence = 1 / 300
    """Share of the run between two bursts of steps of the medium alone."""
    burst: Annotated[float, Range(0, 10)] = 0.5
    """Length of a burst, as a share of the steps between two of them."""


@dataclass(frozen=True)
class SeaSplatSettings(GaussianSettings):
    """Gaussians, and one set of water coefficients for the scene."""

    initial: GaussianInitialSettings = field(default_factory=lambda: GaussianInitialSettings(harmonics=0))
    weights: SeaSplatWeights = field(default_factory=SeaSplatWeights)
    densify: GradientSettings = field(default_factory=GradientSettings)
    water: SceneWaterSettings = field(default_factory=SceneWaterSettings)

    @property
    def recipe(self) -> Literal["seasplat"]:
        """The name of the method."""
        return "seasplat"


@dataclass(frozen=True)
class UirWeights(Settings):
    """Loss weights; the sources at hand give none, so each is after another publication."""

    ssim: Share = 0.2  # after 3DGS
    """Weight of D-SSIM against L1 in the image loss."""
    depth: NotNegative = 1.0  # after the depth term of 3DGS
    """Weight of the error of inverse depth at the start of the run, times a third of the scene's median depth."""
    depth_end: Positive = 0.01  # likewise
    """Weight of the error of inverse depth at the end of the run; log-linear in between."""
    flat: NotNegative = 100.0  # after PGSR
    """Weight of the smallest scale of the Gaussians, in thirds of the scene's median depth."""
    depth_alpha: Share = 0.5
    """Smallest rendered alpha of a pixel whose depth is supervised."""


@dataclass(frozen=True)
class AffineColorSettings(Settings):
    """Affine colors of Gaussians by position and camera; widths and rate after WildGaussians."""

    octaves: Annotated[int, Range(1, 16)] = 4
    """Number of octaves of a Gaussian's position."""
    pose_octaves: Annotated[int, Range(1, 16)] = 4
    """Number of octaves of a camera's rotation and position."""
    embedding: Annotated[int, Range(1, 1024)] = 32
    """Width of a camera's appearance embedding."""
    hidden: Annotated[int, Range(1, 4096)] = 128
    """Width of the two hidden layers of the networks of the appearance."""
    rate: Rate = 5e-4
    """Learning rate of the networks of the appearance."""


@dataclass(frozen=True)
class UirSettings(GaussianSettings):
    """Gaussians whose colors change with the camera, in water whose two effects have networks of their own."""

    initial: GaussianInitialSettings = field(default_factory=lambda: GaussianInitialSettings(colors="restored"))
    medium: MediumFieldSettings = field(
        default_factory=lambda: MediumFieldSettings(layers=1, activation="sigmoid", biases=False, begin=0.0)
    )
    medium_rate: DecayingRate = 1e-3
    """Initial learning rate of the medium's networks."""
    medium_rate_end: DecayingRate = 1.5e-4
    """Final learning rate of the medium's networks."""
    affine_colors: AffineColorSettings = field(default_factory=AffineColorSettings)
    weights: UirWeights = field(default_factory=UirWeights)
    densify: GradientSettings = field(default_factory=GradientSettings)

    @property
    def recipe(self) -> Literal["3d-uir"]:
        """The name of the method."""
        return "3d-uir"

    @property
    def reads_depth(self) -> bool:
        """True where training reads measured depth."""
        return True
