"""The settings of a whole run, their file, and the three starting points users choose from; torch-free."""

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from swimm3r.errors import InputError
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
    SggSettings,
    SplatSettings,
    TrainingPoseSettings,
    UwbsSettings,
)

if TYPE_CHECKING:
    from cattrs import Converter

# in short runs, and faster without (benchmarks/README.md): SGG costs 0.1 dB on the synthetic dive, and poses refined
# along with the map 0.5 dB on ruie_green_rock, whose poses were good
WITHOUT_SGG, HELD_POSES = SggSettings(enabled=False), TrainingPoseSettings(enabled=False)
LAPTOP = UwbsSettings(  # the paper's settings are made for a GPU
    iterations=5000,
    long_side=640,
    initial=InitialSettings(primitives=50_000),
    densify=DensifySettings(max_primitives=100_000),
    sgg=WITHOUT_SGG,
    poses=HELD_POSES,
)


@dataclass(frozen=True)
class RunSettings:
    """Everything that decides what a run computes."""

    frames: FrameSettings = field(default_factory=FrameSettings)
    sfm: SfmSettings = field(default_factory=ColmapSettings)
    splat: SplatSettings = field(default=LAPTOP)
    test: PoseRefinementSettings = field(default_factory=PoseRefinementSettings)


def to_yaml(settings: RunSettings) -> str:
    """Every setting by name; the back end and the kind of map are named by `kind`."""
    import yaml

    return yaml.safe_dump(_converter().unstructure(settings), sort_keys=False)


def from_yaml(path: Path) -> RunSettings:
    """The settings that `to_yaml` wrote to a file. Raises InputError."""
    import yaml

    if not path.is_file():
        raise InputError(
            f"{path.parent} holds no run",
            cause="it is another folder, or was moved",
            hint="the folder that --out named when the run was made",
        )
    try:
        return _converter().structure(yaml.safe_load(path.read_text(encoding="utf-8")), RunSettings)
    except Exception as error:  # whatever a file of another version or another hand may cause, one by one unforeseeable
        raise InputError(
            f"{path} does not hold the settings of a run ({type(error).__name__})",
            cause="it was edited, or written by another version of swimm3r",
            hint="the same swimm3r run command again, which writes it anew",
        ) from error


@cache
def _converter() -> "Converter":
    from cattrs import Converter
    from cattrs.strategies import configure_tagged_union

    converter = Converter(forbid_extra_keys=True)
    converter.register_unstructure_hook(Path, str)
    converter.register_structure_hook(Path, lambda value, _: Path(value))
    configure_tagged_union(SfmSettings, converter, tag_name="kind")
    configure_tagged_union(SplatSettings, converter, tag_name="kind", default=UwbsSettings)  # the only kind there was
    return converter


PRESETS: dict[str, RunSettings] = {
    "fast": RunSettings(  # a look at a dive on a laptop
        frames=FrameSettings(long_side=960),
        sfm=ColmapSettings(depth=PlaneSweepSettings(long_side=480, sources=4)),
        splat=UwbsSettings(
            iterations=2000,
            long_side=480,
            initial=InitialSettings(primitives=25_000),
            densify=DensifySettings(max_primitives=50_000),
            # UBS's rates are made for ten times as many steps (benchmarks/README.md says what these are worth)
            rates=LearningRates(xyz=1e-3, query_mean=3e-3, rgb=1e-2, beta=4e-3, scale=1e-2, lower=4e-3, settle=0.1),
            sgg=WITHOUT_SGG,
            poses=HELD_POSES,
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
