"""Every number of a map's training, with its reason; torch-free, so that --help is instant.

Windows and cadences are fractions of `iterations`, exact at the paper's 20,000. Lengths are in working units: metres,
or, where the reconstruction has no scale, a third of its median depth (`working_depth`).
"""

from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Literal, TypeVar, get_args

from swimm3r.settings import (
    Count,
    CountOrZero,
    DecayingRate,
    LongSideOrOwn,
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
from swimm3r.splat.gaussian_settings import (
    GaussianSettings,
    McmcGsSettings,
    OceanSplatSettings,
    SeaSplatSettings,
    UirSettings,
    WaterSplattingSettings,
)
from swimm3r.splat.shared_settings import (
    DILATION,
    MapSettings,
    MediumFieldSettings,
    RefineSettings,
    TrainingPoseSettings,
)


@dataclass(frozen=True)
class RenderSettings(Settings):
    """Projection and compositing of Beta primitives."""

    depth: Literal["ray", "z"] = "ray"
    """Depth that light is attenuated over: along the ray (exact), or along the optical axis as in WaterSplatting and
    UBS."""
    alpha_min: Annotated[float, Range(0, 0.5)] = 1 / 255
    """Smallest opacity of a primitive at a pixel that is drawn; 0 draws all, as the papers do."""
    near: Annotated[float, Range(above=0, most=1e6)] = 0.01
    """Smallest z depth of a primitive that is drawn."""
    covariance: Literal["symmetric", "upper"] = "symmetric"
    """Reduction of the conditional covariance, which is not symmetric: its mean with its transpose, or its upper
    triangle as in UBS."""
    antialiasing: Literal["mip", "dilation"] = "dilation"
    """Filter of primitives: widened in every view (dilation), as in 3DGS and UBS, or none smaller than a
    pixel of the training images and averaged over the pixels of the view (mip, Mip-Splatting), for other sizes."""
    dilation: Annotated[float, Range(0, 10)] = DILATION
    """Variance added to every primitive on the image plane, pixels^2 (dilation)."""
    rotation: Literal["first_order", "exponential"] = "first_order"
    """Rotation of a primitive from its parameters A: I + A as in UBS, or exp(A)."""
    medium_depth_grad: Literal["full", "detach"] = "full"
    """Gradient of the medium's terms to the primitives' depths: full, or detached as in WaterSplatting."""


@dataclass(frozen=True)
class InitialSettings(Settings):
    """The primitives and the water that training starts from."""

    primitives: MapSize = 400_000
    """Number of points of the restored cloud and its backdrop that become primitives, for as many pixels each."""
    backdrop: Share = 0.5
    """Largest share of the initial primitives on ground of guessed depth; 0 starts from measured points alone."""
    directions: Literal["mean", "uniform"] = "mean"
    """Mean of the conditioned direction: that of the frames that see the point, or uniform over a cube as in UBS."""
    view_exponent: Annotated[float, Range(-20, 10)] = 0.0
    """Stored exponent of the conditioned directions; a primitive fades toward other views as 4 exp of it."""
    time_exponent: Annotated[float, Range(-20, 10)] = 0.0
    """Stored exponent of the conditioned time, in dynamic maps; a primitive fades over time as 4 exp of it."""
    time_scale: Annotated[float, Range(1e-3, 1e3)] = 4.0
    """Scale of a primitive in time, in lengths of the clip, in dynamic maps (1 in UBS)."""
    scale: Annotated[float, Range(1e-3, 1e3)] = 1.0
    """Spatial scale of a primitive, in root mean square distances to its 3 nearest neighbors."""
    opacity: Opacity = 0.5
    """Opacity of the initial primitives, between 0 and 1."""
    colors: Literal["restored", "raw"] = "restored"
    """Colors of the initial primitives: restored, or raw for maps without a medium."""
    max_views: Count = 64
    """Number of frames that are tested for visibility of a point."""


@dataclass(frozen=True)
class LearningRates(Settings):
    """Adam's learning rates (eps 1e-15), UBS's values; positions and medium decay log-linearly over the run."""

    xyz: DecayingRate = 1.6e-4
    """Initial learning rate of the positions, times the scene's radius."""
    xyz_end: DecayingRate = 1.6e-6
    """Final learning rate of the positions, times the scene's radius."""
    query_mean: Rate = 1e-3
    """Learning rate of the means of the conditioned direction and time."""
    rgb: Rate = 1e-3
    """Learning rate of the colors."""
    opacity: Rate = 5e-2
    """Learning rate of the opacities."""
    beta: Rate = 1e-3
    """Learning rate of the Beta kernels' exponents."""
    scale: Rate = 5e-3
    """Learning rate of the scales."""
    lower: Rate = 1e-3
    """Learning rate of the covariances' off-diagonal entries."""
    medium: DecayingRate = 1e-3
    """Initial learning rate of the medium field."""
    medium_end: DecayingRate = 1.5e-4
    """Final learning rate of the medium field."""
    final_rate_factor: PositiveShare = 1.0
    """Factor that the other rates fall to at the end of the run, log-linearly from `rate_decay_start` on; 1 keeps them,
    as in UBS."""
    rate_decay_start: Annotated[float, Range(0, below=1)] = 0.5
    """Share of the run after which the other rates decay by `final_rate_factor`."""


@dataclass(frozen=True)
class LossWeights(Settings):
    """Weights of the objective (Eq. 18) and of seven terms beyond it."""

    ssim: Share = 0.2
    """Weight of D-SSIM against L1 in the image loss (Eq. 14)."""
    opacity: NotNegative = 0.01
    """Weight of the primitives' opacities (Eq. 15)."""
    scale: NotNegative = 0.01
    """Weight of the primitives' scales (Eq. 15)."""
    mcmc_begin: Share = 0.025
    """Share of the run before which opacities and scales are not regularized."""
    mcmc_end: Share = 0.5
    """Share of the run after which opacities and scales are not regularized."""
    ubs_scale_reg_bug: bool = False
    """Regularize all scales of the first three primitives, as UBS's code does, instead of the spatial scales of all."""
    depth: NotNegative = 0.1
    """Weight of the depth regularizer (Eq. 13)."""
    depth_edges: NotNegative = 10.0
    """Gradient scale k of the depth term's weights, the mean of e^(-k |dI/dx|) and e^(-k |dI/dy|), normalized to a sum
    of 1; 0 weights all pixels alike. The paper gives no scale."""
    medium_smoothness: NotNegative = 1.0
    """Weight of the medium's smoothness (Eq. 16)."""
    medium_prior: NotNegative = 0.01
    """Weight of the deviation from the reconstruction's medium, in its standard deviations; 0 is the paper's objective.
    """
    radius: NotNegative = 0.1
    """Weight of the radius regularizer (Eq. 17)."""
    max_radius: Positive = 256.0
    """Projected radius beyond which a primitive is penalized, in pixels of an image `max_radius_width` wide."""
    max_radius_width: CountOrZero = 1280
    """Image width in pixels that `max_radius` refers to; 0 is that of the training images."""
    in_front: NotNegative = 1.0
    """Weight of the squared relative distance of the map in front of measured depth; 0 is the paper's objective."""
    guess: NotNegative = 1.0
    """Weight of the map's distance from depth that is guessed where none is known; 0 is the paper's objective."""
    guess_slack: Annotated[float, Range(1, 10)] = 1.1
    """Factor by which the map may be off guessed depth at no cost."""
    coverage: NotNegative = 0.05
    """Weight of the light that passes a surface of known depth, which keeps surfaces opaque; 0 is the paper's
    objective."""
    open_water: NotNegative = 0.025
    """Weight of primitives drawn over open water, which would glare in clear images; 0 is the paper's objective."""
    gamut: NotNegative = 1.0
    """Weight of the squared excess of clear colors over 0..1; 0 is the paper's objective."""
    hidden: NotNegative = 0.05
    """Weight of the squared distance of clear colors, in channels that the water hides, from the hue that the dive has;
    0 is the paper's objective."""
    hidden_transmittance: PositiveShare = 0.01
    """T_D at which a channel's color is half hidden."""
    depth_alpha: Share = 0.5
    """Smallest rendered alpha of a pixel whose depth is regularized."""


@dataclass(frozen=True)
class DensifySettings(RefineSettings):
    """Relocation, growth and noise of the primitives (MCMC-GS, for Beta kernels as UBS has it)."""

    cap_max: MapSize = 800_000
    """Largest number of primitives in the map."""
    growth: Annotated[float, Range(1, 2)] = 1.02
    """Factor by which the number of primitives grows in each densification round."""
    min_opacity: Opacity = 0.005
    """Opacity below which a primitive is relocated."""
    noise: NotNegative = 1e6
    """Scale of the noise on positions, times their learning rate, in static maps (UBS's value)."""
    noise_dynamic: NotNegative = 1e6
    """Scale of the noise on positions, times their learning rate, in dynamic maps (1 in UBS)."""
    noise_gate: Literal["sigmoid", "power"] = "sigmoid"
    """Decrease of the noise with opacity o: 1 / (1 + exp(100 (o - min_opacity))) as in MCMC-GS (sigmoid), or (1 -
    o)^100 as in UBS (power)."""
    noise_cadence: Literal["round", "step"] = "round"
    """Steps that add noise: each densification round (UBS), or every step of the run (MCMC-GS, with a scale of 5e5)."""


@dataclass(frozen=True)
class MoverSettings(Settings):
    """Primitives created for moving objects in dynamic maps (beyond the paper)."""

    at: Share = 0.2
    """Share of the run after which frames are searched for moving objects; 0 turns the search off."""
    contrast: NotNegative = 3.0
    """Smallest ratio of a pixel's error in one frame to its usual error in other frames that see the same ground."""
    least: Share = 0.04
    """Smallest error of a pixel of a moving object, in pixel values averaged over texture."""
    nearness: PositiveShare = 0.85
    """Assumed distance of an object from the camera, as a share of that of the ground behind it, if its trajectory does
    not tell."""
    duration: Positive = 3.0
    """Scale in time of the created primitives, in intervals between training frames."""
    share: Share = 0.15
    """Largest share of the map's primitives that are created for moving objects."""


@dataclass(frozen=True)
class BlockSettings(Settings):
    """Large static maps in blocks: ground beyond what one block holds is trained in several."""

    largest: NotNegative = 12.0
    """Largest ground of a block, in the area that one image shows at the median depth; 0 trains one map however large.
    """
    margin: NotNegative = 0.25
    """Ground around a block that is trained with it and then left to its neighbors, in median depths."""
    steps: Annotated[float, Range(above=0, most=10)] = 1.5
    """Steps of a block, in those that show its ground as often as a map of one block is shown its own."""
    water_steps: PositiveShare = 0.5
    """Length of the training of the water that all blocks share, on parts of the dive, in `iterations`."""


@dataclass(frozen=True)
class SggSettings(Settings):
    """Scattering-aware geometric gradients (Alg. 1), with the options that the paper leaves open."""

    enabled: bool = True
    """Use scattering-aware geometric gradients in the first part of the run."""
    end: Share = 0.5  # tau_c, 10,000 of 20,000
    """Share of the run after which exact gradients are used (tau_c)."""
    residual: Share = 0.15
    """Share of the exact gradient that an uncertain center keeps (eta)."""
    split: Literal["clear", "direct"] = "clear"
    """Light that counts as geometry: that without water (clear), or the attenuated light that arrives (direct)."""
    depth: Literal["geometry", "apart"] = "geometry"
    """Treatment of the depth loss's gradient: filtered with the geometry's, or added unfiltered (apart)."""
    isolated: Literal["branch", "exact"] = "branch"
    """Computation of the depth loss's own gradient: by the adjoint's depth branch with fixed alpha, or by a second
    backward pass (exact)."""
    largest_step: Annotated[float, Range(1)] = 2.0
    """Largest factor on Adam's step (c_max)."""


@dataclass(frozen=True)
class UwbsSettings(MapSettings):
    """Underwater Beta Splatting; static, or with primitives and water that depend on the time, too."""

    coarse_until: Share = 0.0
    """Share of the steps, from the first, that train on images of half the size."""
    dynamic: bool = False
    """Condition primitives on time besides direction (D = 7), and let the medium change with time."""
    initial: InitialSettings = field(default_factory=InitialSettings)
    render: RenderSettings = field(default_factory=RenderSettings)
    medium: MediumFieldSettings = field(default_factory=MediumFieldSettings)
    rates: LearningRates = field(default_factory=LearningRates)
    weights: LossWeights = field(default_factory=LossWeights)
    densify: DensifySettings = field(default_factory=DensifySettings)
    movers: MoverSettings = field(default_factory=MoverSettings)
    sgg: SggSettings = field(default_factory=SggSettings)
    blocks: BlockSettings = field(default_factory=BlockSettings)

    @property
    def recipe(self) -> Literal["uwbs-static", "uwbs-dynamic", "ubs"]:
        """The name of the method."""
        if self.medium.model == "none":
            return "ubs"
        return "uwbs-dynamic" if self.dynamic else "uwbs-static"

    @property
    def reads_depth(self) -> bool:
        """True where training reads measured depth."""
        return True

    @property
    def guesses_depth(self) -> bool:
        """True where training asks for a guess at depth that was not measured."""
        return self.weights.guess > 0


@dataclass(frozen=True)
class PoseRefinementSettings(Settings):
    """A camera refined against a frozen map, by as many steps as the paper's test frames.

    The protocol of 3R-GS, which the paper follows, has `pixels` "edges" and `min_gain` 0.
    """

    steps: CountOrZero = 300
    """Number of refinement steps for the pose of each test frame; 0 keeps the first pose."""
    rate: Rate = 8e-4
    """Learning rate of Adam for a rotation in 6D form and a translation in working units; decays to 1 %."""
    long_side: LongSideOrOwn = 240
    """Longer side in pixels of the image that the pose is refined on; at most, and for 0, that of the training images.
    """
    halvings: Annotated[int, Range(0, 16)] = 2
    """Number of times that the image is halved at first; the smaller sizes share half of the steps and find poses that
    start several pixels off."""
    pixels: Literal["all", "edges"] = "all"
    """Pixels that tell the pose: all that training frames observed, in colors less their local mean, or those at edges,
    in colors as they are (3R-GS)."""
    min_gain: NotNegative = 2.0
    """Fall of the loss, in its standard errors, above which a refined pose replaces the first one; less is chance, and
    the map may hardly show what the frame shows."""


SplatSettings = (
    UwbsSettings | OceanSplatSettings | WaterSplattingSettings | UirSettings | SeaSplatSettings | McmcGsSettings
)
uwbs = UwbsSettings  # as the Python API calls it: swimm3r.train(rec, frames, swimm3r.uwbs(iterations=20_000))

MapDevice = Literal["auto", "cpu", "cuda"]
"""The device that trains and renders maps; no part of the settings, for a map can go from one to the other."""

RecipeName = Literal[
    "uwbs-static", "uwbs-dynamic", "ubs", "watersplatting", "seasplat", "threers_gs", "mcmc_gs", "oceansplat", "3d-uir"
]
RECIPES: tuple[RecipeName, ...] = get_args(RecipeName)
IN_BLOCKS: tuple[RecipeName, ...] = ("uwbs-static",)
"""The recipes that train large maps in blocks; those of the others are one block, however large."""


def with_recipe(settings: UwbsSettings, recipe: RecipeName) -> SplatSettings:
    """Settings of another method at the same size and length, on the same cloud; poses as that method has them."""
    match recipe:
        case "uwbs-static":
            return replace(settings, dynamic=False)
        case "uwbs-dynamic":
            return replace(settings, dynamic=True)
        case "ubs":  # Universal Beta Splatting as published, on the given cloud: no water or depth, poses held
            none = dict.fromkeys(_BEYOND_UBS, 0.0)
            return replace(
                settings,
                initial=replace(settings.initial, directions="uniform", colors="raw"),
                render=replace(settings.render, alpha_min=0.0, antialiasing="dilation", covariance="upper"),
                medium=replace(settings.medium, model="none"),
                weights=replace(settings.weights, **none),
                sgg=replace(settings.sgg, enabled=False),
                poses=replace(settings.poses, enabled=False),
            )
        case "watersplatting" | "oceansplat":
            water = _of_the_same_size(settings, watersplatting() if recipe == "watersplatting" else oceansplat())
            if water.iterations < _SHORT:
                gentle = replace(water.densify, reset_every=0.0, prune_opacity=water.densify.prune_opacity_late)
                water = replace(water, densify=gentle, initial=replace(water.initial, opacity=_SHORT_OPACITY))
            return water
        case "seasplat" | "3d-uir":
            peer = _of_the_same_size(settings, seasplat() if recipe == "seasplat" else uir())
            if peer.iterations < _SHORT:
                uncut = replace(peer.densify, reset_every=0.0)
                peer = replace(peer, densify=uncut, initial=replace(peer.initial, opacity=_SHORT_OPACITY))
            return peer
        case "threers_gs" | "mcmc_gs":
            peer = _of_the_same_size(settings, threers_gs() if recipe == "threers_gs" else mcmc_gs())
            if peer.iterations < _SHORT:
                peer = replace(peer, initial=replace(peer.initial, scale=_SHORT_SCALE))
            return peer


OfRecipe = TypeVar("OfRecipe", bound=SplatSettings)

FEWEST_PRIMITIVES = 4
"""A map or block of fewer is not trained."""


def with_primitives(settings: OfRecipe, share: float) -> OfRecipe:
    """The settings of a map with `share` of the primitives, at first and at most."""

    def part(number: int) -> int:
        return max(FEWEST_PRIMITIVES, round(share * number))

    initial = replace(settings.initial, primitives=part(settings.initial.primitives))
    if isinstance(settings, UwbsSettings):
        densify = replace(settings.densify, cap_max=part(settings.densify.cap_max))
        return replace(settings, initial=initial, densify=densify)
    return replace(settings, initial=initial, cap_max=part(settings.cap_max))


_BEYOND_UBS = (
    "depth", "medium_smoothness", "radius",
    "medium_prior", "in_front", "guess", "coverage", "open_water", "gamut", "hidden",
)  # fmt: skip
_SHORT = 10_000
"""Runs shorter than this give the peers what they would else lack the time for. WaterSplatting's Gaussians start at an
opacity of 0.1 and are culled below 0.5: of 4,000 on ruie_green_rock (160 px) 724 were left after 400 steps, at 23.6 dB
on frames held back; begun at 0.5, culled below 0.1 and not cut they are 7,500 at 30.3 dB. SeaSplat's gain 10 dB by not
being cut (benchmarks/short_runs.py)."""
_SHORT_OPACITY = 0.5
"""Of Gaussians that are multiplied by gradients in short runs, as UWBS begins; SeaSplat gains 0.5 dB by it."""
_SHORT_SCALE = 0.5
"""Of MCMC's Gaussians in short runs, in their spacing: from a tenth of it, as published, they would take 460 steps to
cover it. The same 400 steps gain 2.3 dB by it."""

Peer = TypeVar("Peer", bound=GaussianSettings)


def _of_the_same_size(settings: UwbsSettings, peer: Peer) -> Peer:
    """A peer's settings with the length, the sizes and the cloud of ours."""
    start = replace(peer.initial, primitives=settings.initial.primitives, backdrop=settings.initial.backdrop)
    same = {shared.name: getattr(settings, shared.name) for shared in fields(MapSettings) if shared.name != "poses"}
    return replace(peer, initial=start, cap_max=settings.densify.cap_max, **same)


def ubs(**changes: Any) -> UwbsSettings:
    """Beta splatting without the underwater part, as the Python API calls it."""
    found = with_recipe(UwbsSettings(**changes), "ubs")
    assert isinstance(found, UwbsSettings)
    return found


def watersplatting(**changes: Any) -> WaterSplattingSettings:
    """WaterSplatting, as the Python API calls it: on poses as they are."""
    changes.setdefault("poses", TrainingPoseSettings(enabled=False))
    return WaterSplattingSettings(**changes)


def seasplat(**changes: Any) -> SeaSplatSettings:
    """SeaSplat, as the Python API calls it: on poses as they are."""
    changes.setdefault("poses", TrainingPoseSettings(enabled=False))
    return SeaSplatSettings(**changes)


def oceansplat(**changes: Any) -> OceanSplatSettings:
    """OceanSplat, as the Python API calls it: on poses as they are."""
    changes.setdefault("poses", TrainingPoseSettings(enabled=False))
    return OceanSplatSettings(**changes)


def uir(**changes: Any) -> UirSettings:
    """3D-UIR, as the Python API calls it: on poses as they are."""
    changes.setdefault("poses", TrainingPoseSettings(enabled=False))
    return UirSettings(**changes)


def threers_gs(**changes: Any) -> McmcGsSettings:
    """3R-GS, as the Python API calls it: Gaussian MCMC with the training poses refined."""
    return McmcGsSettings(**changes)


def mcmc_gs(**changes: Any) -> McmcGsSettings:
    """3DGS-MCMC, as the Python API calls it: the same on poses as they are."""
    changes.setdefault("poses", TrainingPoseSettings(enabled=False))
    return McmcGsSettings(**changes)


def settings_of(recipe: RecipeName) -> type[SplatSettings]:
    """The settings that a recipe has."""
    return type(with_recipe(UwbsSettings(), recipe))
