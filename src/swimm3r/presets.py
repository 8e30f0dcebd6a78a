"""The settings of a whole run, and the three starting points users choose from; torch-free."""

from dataclasses import dataclass, field

from swimm3r.frame_settings import FrameSettings
from swimm3r.sfm.mast3r.settings import AlignmentSettings
from swimm3r.sfm.settings import (
    ColmapSettings,
    FeatureSettings,
    Mast3rSettings,
    PlaneSweepSettings,
    RestoreSettings,
    SfmSettings,
)
from swimm3r.splat.settings import (
    DensifySettings,
    InitialSettings,
    LearningRates,
    PoseRefinementSettings,
    SplatSettings,
    UwbsSettings,
)

LAPTOP = UwbsSettings(  # the paper's settings are made for a GPU
    iterations=5000,
    long_side=640,
    initial=InitialSettings(primitives=50_000),
    densify=DensifySettings(max_primitives=100_000),
)


@dataclass(frozen=True)
class RunSettings:
    """Everything that decides what a run computes."""

    frames: FrameSettings = field(default_factory=FrameSettings)
    sfm: SfmSettings = field(default_factory=ColmapSettings)
    splat: SplatSettings = field(default=LAPTOP)
    test: PoseRefinementSettings = field(default_factory=PoseRefinementSettings)


PRESETS: dict[str, RunSettings] = {
    "fast": RunSettings(  # a look at a dive on a laptop
        frames=FrameSettings(long_side=960),
        sfm=ColmapSettings(depth=PlaneSweepSettings(long_side=480, sources=4)),
        splat=UwbsSettings(
            iterations=1500,
            long_side=480,
            initial=InitialSettings(primitives=25_000),
            densify=DensifySettings(max_primitives=50_000),
            # UBS's rates are made for 20 times as many steps; on ruie_green_rock these are worth 0.4 dB at equal cost
            rates=LearningRates(xyz=5e-4, query_mean=3e-3, rgb=5e-3, beta=4e-3, lower=4e-3),
        ),
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
    ),
}

MAST3R_PRESETS: dict[str, Mast3rSettings] = {  # the same aims with --backend mast3r
    "fast": Mast3rSettings(
        graph="video-2-1",
        alignment=AlignmentSettings(intrinsics="shared", coarse_iterations=150, fine_iterations=150),
    ),
    "default": Mast3rSettings(),
    "best": Mast3rSettings(graph="video-6-4", bundle_adjustment=True, restore=RestoreSettings(max_points=2_000_000)),
}
