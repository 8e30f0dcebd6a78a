"""The settings of a whole run, their file, and the presets users start from; torch-free."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from swimm3r.errors import InputError, Swimm3rError, UsageError
from swimm3r.io.files.damage import Remedy, first_line, guard
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scene.settings import FrameSettings
from swimm3r.settings import SettingError, Settings
from swimm3r.settings_document import from_document, to_document
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.mast3r.settings import AlignmentSettings
from swimm3r.sfm.medium.settings import RestoreSettings
from swimm3r.sfm.plane_sweep.settings import PlaneSweepSettings
from swimm3r.sfm.settings import ColmapSettings, Mast3rSettings, SfmSettings
from swimm3r.splat.settings import (
    DensifySettings,
    InitialSettings,
    LearningRates,
    LossWeights,
    MediumFieldSettings,
    MoverSettings,
    PoseRefinementSettings,
    RenderSettings,
    SggSettings,
    SplatSettings,
    TrainingPoseSettings,
    UwbsSettings,
)
from swimm3r.splat.shared_settings import MapAppearanceSettings

_REMEDY = Remedy(
    cause="it was edited, or written by another version of swimm3r",
    hint="correct it there; or the same swimm3r run command with its --preset, which writes it anew",
)
_CONFIG_REMEDY = Remedy(
    cause="it is another file, or was cut off",
    hint="the settings.yaml of a run folder, or a part of one",
    fault="cannot be used",
)

# better without in short runs, and faster (docs/experiments/sgg.md, docs/experiments/training-poses.md): SGG costs
# 0.1 dB on the synthetic dive, and poses refined along with the map 0.5 dB on ruie_green_rock
WITHOUT_SGG, HELD_POSES = SggSettings(enabled=False), TrainingPoseSettings(enabled=False)
LAPTOP = UwbsSettings(  # the paper's settings are made for a GPU
    iterations=5000,
    long_side=640,
    full_area=6.0,  # most clips have no more ground; twice as much shows sand in strokes
    initial=InitialSettings(primitives=50_000),
    densify=DensifySettings(cap_max=100_000),
    sgg=WITHOUT_SGG,
    poses=HELD_POSES,
)


@dataclass(frozen=True)
class RunSettings(Settings):
    """Everything that decides what a run computes."""

    frames: FrameSettings = field(default_factory=FrameSettings)
    """Frames taken from the input, and their size."""
    sfm: SfmSettings = field(default_factory=ColmapSettings)
    """Structure from motion, depth, medium and restoration; the class is the back end."""
    splat: SplatSettings = field(default=LAPTOP)
    """Training of the map; the class is the renderer."""
    test: PoseRefinementSettings = field(default_factory=PoseRefinementSettings)
    """Refinement of the test frames' poses before they are scored."""
    scale: ScaleSettings = field(default_factory=ScaleSettings)
    """Sources of the unit and the place of the run, applied to whatever is finished."""


def to_yaml(settings: RunSettings) -> str:
    """Every setting by name; the back end and the kind of map are named by `kind`."""
    import yaml

    return yaml.safe_dump(to_document(settings), sort_keys=False)


def from_yaml(path: Path) -> RunSettings:
    """The settings that `to_yaml` wrote to a file of a run folder. Raises InputError."""
    if not path.is_file():
        raise InputError(
            f"{path.parent} holds no run",
            cause="it is another folder, or was moved",
            hint="the folder that --out named when the run was made",
        )
    with guard(path, _REMEDY):
        return from_document(_document(path), RunSettings)


def read_config(path: Path) -> RunSettings:
    """The settings in a file that a user wrote or copied; those that it leaves out have their defaults.

    Raises InputError where the file cannot be read, and UsageError, which a SettingError is, where it holds a setting
    that does not exist or a value that is not allowed.
    """
    with guard(path, _CONFIG_REMEDY):
        document = _document(path)
    try:
        return from_document({} if document is None else document, RunSettings)
    except SettingError as error:
        raise SettingError(f"{path}: {error.name}", error.expected, error.got) from error
    except Swimm3rError as error:
        raise UsageError(f"{path}: {error.what}", cause=error.cause, hint=error.hint) from error
    except ValueError as error:
        raise UsageError(
            f"{path}: {first_line(error)}",
            cause="a slip in the file, or another version of swimm3r wrote it",
            hint="correct it there; the settings.yaml of any run folder shows every setting",
        ) from error


def _document(path: Path) -> Any:
    import yaml

    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ValueError(f"no YAML: {first_line(error)}") from error


Preset = Literal["fast", "default", "best", "paper"]

_PAPER_POINTS = 2_190_000  # of the restored cloud (Tab. sfm_metrics)
PAPER = UwbsSettings(  # Eq. 18 and nothing else; where the paper is silent UBS's choices, as it says it follows UBS
    initial=InitialSettings(backdrop=0.0, directions="uniform", time_scale=1.0),
    render=RenderSettings(alpha_min=0.0, antialiasing="dilation", covariance="upper"),
    medium=MediumFieldSettings(stride=1, begin=0.0),  # evaluated at every pixel, trained from the first step
    weights=LossWeights(
        depth_edges=1.0,  # DN-Splatter's edge-aware weight: no scale is printed
        max_radius_width=0,  # 256 pixels are printed, of no particular width
        medium_prior=0.0,
        in_front=0.0,
        guess=0.0,
        coverage=0.0,
        open_water=0.0,
        gamut=0.0,
        hidden=0.0,
    ),
    densify=DensifySettings(noise_dynamic=1.0),
    movers=MoverSettings(at=0.0),
    appearance=MapAppearanceSettings(mode="off"),
)

PRESETS: dict[Preset, RunSettings] = {
    "fast": RunSettings(  # a look at a dive on a laptop
        frames=FrameSettings(long_side=960),
        sfm=ColmapSettings(depth=PlaneSweepSettings(long_side=480, sources=4)),
        splat=UwbsSettings(
            iterations=2000,
            long_side=480,
            full_area=LAPTOP.full_area,
            coarse_until=0.4,  # a fifth of the training time for 0.07 dB of the demo
            initial=InitialSettings(primitives=40_000),  # docs/experiments/short-runs.md: dB against time
            densify=DensifySettings(cap_max=80_000),
            # UBS's rates are made for ten times as many steps (docs/experiments/short-runs.md)
            rates=LearningRates(
                xyz=1e-3, query_mean=3e-3, rgb=1e-2, beta=4e-3, scale=1e-2, lower=4e-3, final_rate_factor=0.1
            ),
            sgg=WITHOUT_SGG,
            poses=HELD_POSES,
        ),
        test=PoseRefinementSettings(steps=60),  # the demo's test frames score alike after 60, 120 and 300
    ),
    "default": RunSettings(),
    "best": RunSettings(  # hours rather than minutes for a long dive
        frames=FrameSettings(long_side=0),
        sfm=ColmapSettings(
            features=FeatureSettings(count=4096, long_side=1600),
            depth=PlaneSweepSettings(long_side=1280, sources=8),
            restore=RestoreSettings(max_points=2_000_000),
        ),
        splat=UwbsSettings(long_side=0),
        test=PoseRefinementSettings(long_side=0),
    ),
    "paper": RunSettings(  # the paper's numbers, to compare with it; its structure from motion is --backend swimm3r
        frames=FrameSettings(pick="uniform", long_side=0),
        sfm=ColmapSettings(
            features=FeatureSettings(count=4096, long_side=1600),
            depth=PlaneSweepSettings(long_side=1280, sources=8),
            light="sun",
            restore=RestoreSettings(max_points=_PAPER_POINTS, max_points_area=0.0),
        ),
        splat=PAPER,
        test=PoseRefinementSettings(long_side=0, halvings=0, pixels="edges", min_gain=0.0),
    ),
}
"""Settings to start from: `PRESETS["fast"].frames`, `.sfm` and `.splat` are those of `read_frames`, `reconstruct` and
`train`, the whole is that of `run_pipeline`; `dataclasses.replace` changes single ones.
"""

MAST3R_PRESETS: dict[Preset, Mast3rSettings] = {  # the same aims with --backend mast3r
    "fast": Mast3rSettings(
        graph="video-2-1",
        alignment=AlignmentSettings(intrinsics="shared", coarse_iterations=150, fine_iterations=150),
    ),
    "default": Mast3rSettings(),
    "best": Mast3rSettings(graph="video-6-4", bundle_adjustment=True, restore=RestoreSettings(max_points=2_000_000)),
    "paper": Mast3rSettings(light="sun", restore=RestoreSettings(max_points=_PAPER_POINTS, max_points_area=0.0)),
}
