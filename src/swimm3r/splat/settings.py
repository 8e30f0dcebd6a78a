"""Every number of a map's training, with its reason; torch-free, so that --help is instant.

Windows and cadences are fractions of `iterations`, exact at the paper's 20,000. Lengths are in working units: metres,
or, where the reconstruction has no scale, a third of its median depth (`working_depth`).
"""

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, TypeVar, get_args

from swimm3r.settings import (
    Cadence,
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
    Seed,
    Settings,
    Share,
)
from swimm3r.splat.gaussian_settings import GaussianSettings, McmcGsSettings, SeaSplatSettings, WaterSplattingSettings
from swimm3r.splat.shared_settings import MediumFieldSettings, RecipeName, TrainingPoseSettings


@dataclass(frozen=True)
class RenderSettings(Settings):
    """How a primitive meets a camera."""

    depth: Literal["ray", "z"] = "ray"
    """The depth that attenuates: along the ray (exact), or along the optical axis as WaterSplatting and UBS have it."""
    alpha_min: Annotated[float, Range(0, 0.5)] = 1 / 255
    """Pairs fainter than this are skipped; 0 for parity with the papers, which skip nothing."""
    near: Annotated[float, Range(above=0, most=1e6)] = 0.01
    """Primitives nearer than this z depth are not drawn."""
    covariance: Literal["symmetric", "upper"] = "symmetric"
    """The conditional covariance is not symmetric: its mean with its transpose, or its upper triangle as UBS has it."""
    rotation: Literal["first_order", "exponential"] = "first_order"
    """I + A as UBS has it, or the rotation exp(A)."""
    medium_depth_grad: Literal["full", "detach"] = "full"
    """Whether what the water takes and adds may move a primitive in depth; detach as WaterSplatting has it."""


@dataclass(frozen=True)
class InitialSettings(Settings):
    """The primitives and the water that training starts from."""

    primitives: MapSize = 400_000
    """Points of the restored cloud and its backdrop that become primitives, one per voxel."""
    backdrop: Share = 0.2
    """Largest share of them that lies on ground whose depth is a guess; 0 starts on measured points alone."""
    directions: Literal["mean", "uniform"] = "mean"
    """Mean of the conditioned direction: that of the frames which see the point, or drawn from a cube as UBS does,
    which hides 9 of 10 primitives in any one view."""
    view_exponent: Annotated[float, Range(-20, 10)] = 0.0
    """Stored exponent of the conditioned directions: how fast a primitive fades seen from elsewhere, as 4 exp of it."""
    time_exponent: Annotated[float, Range(-20, 10)] = 0.0
    """The same of time, in dynamic maps."""
    time_scale: Annotated[float, Range(1e-3, 1e3)] = 4.0
    """Scale of a primitive in time, in lengths of the clip; its mean time is drawn from all of the clip (UBS). UBS's 1
    lets still ground fade away from that moment: 4 is worth 0.2 dB on the synthetic dive with the fish."""
    scale: Annotated[float, Range(1e-3, 1e3)] = 1.0
    """Spatial scale, in root mean square distances to the 3 nearest neighbors."""
    opacity: Opacity = 0.5
    colors: Literal["restored", "raw"] = "restored"
    """Without the water, or as filmed for maps that have none."""
    max_views: Count = 64
    """Frames asked whether they see a point."""


@dataclass(frozen=True)
class LearningRates(Settings):
    """Of Adam (eps 1e-15), UBS's values; positions and the medium decay log-linearly over the run."""

    xyz: DecayingRate = 1.6e-4
    """Times the scene's radius, as is its end."""
    xyz_end: DecayingRate = 1.6e-6
    query_mean: Rate = 1e-3
    rgb: Rate = 1e-3
    opacity: Rate = 5e-2
    beta: Rate = 1e-3
    scale: Rate = 5e-3
    lower: Rate = 1e-3
    medium: DecayingRate = 1e-3
    medium_end: DecayingRate = 1.5e-4
    final_rate_factor: PositiveShare = 1.0
    """Share that the other rates have fallen to at the end of the run, log-linearly from `rate_decay_start` on; UBS
    holds them, and at rates high enough for a short run the primitives then never come to rest."""
    rate_decay_start: Annotated[float, Range(0, below=1)] = 0.5


@dataclass(frozen=True)
class LossWeights(Settings):
    """Of the objective, Eq. 18, and of four terms beyond it."""

    ssim: Share = 0.2
    opacity: NotNegative = 0.01
    scale: NotNegative = 0.01
    mcmc_begin: Share = 0.025
    """Share of the run before which opacity and scale are not regularized: UBS's window, MCMC-GS has 0 to 1."""
    mcmc_end: Share = 0.5
    ubs_scale_reg_bug: bool = False
    """Regularize all scales of the first three primitives, as UBS's code does, instead of the spatial ones of all."""
    depth: NotNegative = 0.1
    depth_edges: NotNegative = 10.0
    """Gradient scale k of the depth term's weights, the mean of e^(-k |dI/dx|) and e^(-k |dI/dy|) in pixel values per
    pixel, normalized to a sum of 1. 0 counts all pixels alike; the paper names no scale."""
    medium_smoothness: NotNegative = 1.0
    medium_prior: NotNegative = 0.01
    """Of the deviation from the reconstruction's water in its standard deviations; 0 is the paper's objective.
    Colors and water can trade places in a map, and without it they do."""
    radius: NotNegative = 0.1
    max_radius: Positive = 256.0
    """Projected radius, pixels of an image `max_radius_width` wide, beyond which a primitive counts as veil."""
    max_radius_width: CountOrZero = 1280
    """Width in pixels that `max_radius` refers to; 0 is that of the training images."""
    coverage: NotNegative = 0.05
    """Of the light that passes a surface whose depth is known; 0 is the paper's objective. A map may leave a surface
    half transparent and let the veil behind it fill in; its clear colors are then dark."""
    open_water: NotNegative = 0.025
    """Of what is drawn over pixels that look past every surface; 0 is the paper's objective. Painted on primitives,
    open water is part of the scene: in clear images it glares."""
    gamut: NotNegative = 1.0
    """Of the squared excess of clear colors over 0..1; 0 is the paper's objective. Where the water leaves little of a
    channel nearly any value of it explains the images, and Adam, whose steps know no scale, lets it stray."""
    depth_confidence: NotNegative = 0.3
    """Least confidence of a depth that regularizes."""
    depth_alpha: Share = 0.5
    """Least alpha of a pixel whose depth is regularized."""


@dataclass(frozen=True)
class DensifySettings(Settings):
    """Relocation, growth and noise of the primitives (MCMC-GS, for Beta kernels as UBS has it)."""

    cap_max: MapSize = 800_000
    refine_start: Share = 0.025  # 500 of 20,000
    refine_stop: Share = 0.5  # 10,000 of 20,000
    refine_every: Cadence = 0.005  # 100 of 20,000
    min_refine_every: Count = 20
    """Fewest steps between two rounds, whatever `refine_every` says; growth is made up for."""
    growth: Annotated[float, Range(1, 2)] = 1.02
    """Per round at `refine_every`."""
    min_opacity: Opacity = 0.005
    noise: NotNegative = 1e6
    """Rate times the positions' learning rate in static maps; UBS's."""
    noise_dynamic: NotNegative = 1e6
    """In dynamic ones; UBS has 1, with which still ground is 0.6 dB worse on the synthetic dive."""
    noise_gate: Literal["sigmoid", "power"] = "sigmoid"
    """How noise fades with opacity o: as 1 / (1 + exp(100 (o - dead_opacity))) (MCMC-GS), or as (1 - o)^100 (UBS)."""
    noise_cadence: Literal["round", "step"] = "round"
    """Noise with every round (UBS), or with every step from the first to the last (MCMC-GS, whose rate is 5e5)."""


@dataclass(frozen=True)
class MoverSettings(Settings):
    """Primitives born where a frame shows what a still scene cannot, in dynamic maps (beyond the paper)."""

    at: Share = 0.2
    """Share of the run after which the frames are searched for what moves; 0 leaves it to the densification."""
    contrast: NotNegative = 3.0
    """How much more a pixel must be off in one frame, from map and other frames, than its ground is in those."""
    least: Share = 0.04
    """And by how much at least, pixel values, with the texture of both averaged out."""
    nearness: PositiveShare = 0.85
    """Distance from the camera assumed where the course does not tell, as a share of the ground's behind it."""
    duration: Positive = 3.0
    """Scale in time, in intervals between training frames."""
    share: Share = 0.15
    """Of the largest number of primitives, born at most."""


@dataclass(frozen=True)
class SggSettings(Settings):
    """Scattering-aware geometric gradients (Alg. 1); names the readings of what the paper leaves open."""

    enabled: bool = True
    end: Share = 0.5  # tau_c, 10,000 of 20,000
    residual: Share = 0.15
    """eta: share of the exact gradient that an uncertain center keeps."""
    split: Literal["clear", "direct"] = "clear"
    """What counts as geometry: the light without water, or the light that arrives, attenuated ("direct")."""
    depth: Literal["geometry", "apart"] = "geometry"
    """Whether the depth loss's gradient is filtered with the geometry's, or added to it as it is."""
    isolated: Literal["branch", "exact"] = "branch"
    """The depth loss's own gradient: from the adjoint's depth branch, which takes alpha as given, or by a second
    backward pass."""
    largest_step: Annotated[float, Range(1)] = 2.0
    """c_max: bound of the multiplier of Adam's step."""


@dataclass(frozen=True)
class UwbsSettings(Settings):
    """Underwater Beta Splatting; static, or with primitives and water that depend on the time, too."""

    dynamic: bool = False
    """Condition primitives on time besides direction (D = 7), and let the water change with it."""
    iterations: Count = 20_000
    long_side: LongSideOrOwn = 1600
    """Longer side of the training images, pixels; they are never enlarged."""
    working_depth: Annotated[float, Range(1e-3, 1e6)] = 3.0
    """Median depth, working units, that a scene without metric scale is given while it is trained."""
    initial: InitialSettings = field(default_factory=InitialSettings)
    render: RenderSettings = field(default_factory=RenderSettings)
    medium: MediumFieldSettings = field(default_factory=MediumFieldSettings)
    rates: LearningRates = field(default_factory=LearningRates)
    weights: LossWeights = field(default_factory=LossWeights)
    densify: DensifySettings = field(default_factory=DensifySettings)
    movers: MoverSettings = field(default_factory=MoverSettings)
    sgg: SggSettings = field(default_factory=SggSettings)
    poses: TrainingPoseSettings = field(default_factory=TrainingPoseSettings)
    seed: Seed = 0
    log_every: Cadence = 0.005
    checkpoint_every: Cadence = 0.1

    @property
    def recipe(self) -> RecipeName:
        """The name of the method."""
        if self.medium.model == "none":
            return "ubs"
        return "uwbs-dynamic" if self.dynamic else "uwbs-static"

    @property
    def depth_confidence(self) -> float | None:
        """Least confidence of a depth that training reads; None reads no depth."""
        return self.weights.depth_confidence


@dataclass(frozen=True)
class PoseRefinementSettings(Settings):
    """A camera refined against a frozen map (3R-GS's protocol for test frames, with the paper's 300 steps)."""

    steps: CountOrZero = 300
    rate: Rate = 8e-4
    """Of Adam, for a rotation in the 6D form and a translation in working units; decays to 1 %."""
    long_side: LongSideOrOwn = 240
    """Longer side of the image the pose is refined on, pixels; at most, and for 0, that of the training images."""
    halvings: Annotated[int, Range(0, 16)] = 2
    """How often that image is halved at first; the smaller ones share half of the steps. A pose that starts 9 px off
    (of 400) is found from a quarter of the size, and not from the whole: on ruie_green_rock 24.0 instead of 20.2 dB."""
    edge: NotNegative = 4.0
    """Pixels count whose gradient exceeds this many medians."""
    min_edges: Share = 0.01
    """Share of the image below which every pixel counts instead."""


SplatSettings = UwbsSettings | WaterSplattingSettings | SeaSplatSettings | McmcGsSettings
uwbs = UwbsSettings  # as the Python API calls it: swimm3r.train(rec, frames, swimm3r.uwbs(iterations=20_000))

MapDevice = Literal["auto", "cpu", "cuda"]
"""Where maps are trained and rendered; no part of the settings, for a map can go from one to the other."""

RECIPES: tuple[RecipeName, ...] = get_args(RecipeName)


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
                render=replace(settings.render, alpha_min=0.0, covariance="upper"),
                medium=replace(settings.medium, model="none"),
                weights=replace(settings.weights, **none),
                sgg=replace(settings.sgg, enabled=False),
                poses=replace(settings.poses, enabled=False),
            )
        case "watersplatting":
            water = _of_the_same_size(settings, watersplatting())
            if water.iterations < _SHORT:
                gentle = replace(water.densify, reset_every=0.0, prune_opacity=water.densify.prune_opacity_late)
                water = replace(water, densify=gentle, initial=replace(water.initial, opacity=_SHORT_OPACITY))
            return water
        case "seasplat":
            sea = _of_the_same_size(settings, seasplat())
            if sea.iterations < _SHORT:
                uncut = replace(sea.densify, reset_every=0.0)
                sea = replace(sea, densify=uncut, initial=replace(sea.initial, opacity=_SHORT_OPACITY))
            return sea
        case "threers_gs" | "mcmc_gs":
            peer = _of_the_same_size(settings, threers_gs() if recipe == "threers_gs" else mcmc_gs())
            if peer.iterations < _SHORT:
                peer = replace(peer, initial=replace(peer.initial, scale=_SHORT_SCALE))
            return peer


_BEYOND_UBS = ("depth", "medium_smoothness", "medium_prior", "radius", "coverage", "open_water", "gamut")
_SHORT = 10_000
"""Runs shorter than this give the peers what they would else lack the time for. WaterSplatting's Gaussians start at an
opacity of 0.1 and are culled below 0.5: of 4,000 on ruie_green_rock (160 px) 724 were left after 400 steps, at 23.6 dB
on frames held back; begun at 0.5, culled below 0.1 and not cut they are 7,500 at 30.3 dB. SeaSplat's gain 10 dB by not
being cut (benchmarks/short_runs.py)."""
_SHORT_OPACITY = 0.5
"""Of WaterSplatting's and SeaSplat's Gaussians in short runs, as UWBS begins; SeaSplat gains 0.5 dB by it."""
_SHORT_SCALE = 0.5
"""Of MCMC's Gaussians in short runs, in their spacing: from a tenth of it, as published, they would take 460 steps to
cover it. The same 400 steps gain 2.3 dB by it."""

Peer = TypeVar("Peer", bound=GaussianSettings)


def _of_the_same_size(settings: UwbsSettings, peer: Peer) -> Peer:
    """A peer's settings with the length, the sizes and the cloud of ours."""
    start = replace(peer.initial, primitives=settings.initial.primitives, backdrop=settings.initial.backdrop)
    alike = ("iterations", "long_side", "working_depth", "seed", "log_every", "checkpoint_every")
    same = {name: getattr(settings, name) for name in alike}
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
