"""Options of the protocols besides the settings of their parts; torch-free, so that --help is instant."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from swimm3r.settings import Count, ImageSide, Range, Seed, Settings

Seeds = Annotated[int, Range(1, 1000)]  # trainings of one method on one scene


@dataclass(frozen=True)
class SurveySettings(Settings):
    """Synthetic surveys of growing length."""

    counts: tuple[Count, ...] = (100, 300, 1000)
    """Numbers of frames; a frame every 10 cm of path."""
    width: ImageSide = 640
    """Width of the frames in pixels."""
    height: ImageSide = 360
    """Height of the frames in pixels."""
    seed: Seed = 0
    """Seed of seafloor, path and water."""
    last: Literal["mapping", "sfm", "splat", "eval"] = "eval"
    """Last part to run: poses alone (mapping), or a stage of the pipeline."""


@dataclass(frozen=True)
class RevisitSettings(Settings):
    """Synthetic repeat visits in pairs of waters."""

    water_pairs: Annotated[int, Range(1, 4)] = 4
    """Number of pairs of waters."""
    path_length: Annotated[float, Range(5, 100)] = 10.0
    """Length of the path of each visit in meters."""
    width: ImageSide = 320
    """Width of the frames in pixels."""
    height: ImageSide = 214
    """Height of the frames in pixels."""
    seed: Seed = 5
    """First seed that may be the first pair's; each further pair begins at the next one. Taken is the first of every
    fourth seed whose bleached, grown and moved corals both visits film."""


SfmMethod = Literal[
    "colmap-incremental",
    "colmap-global",
    "gluemap",
    "spann3r",
    "vggt",
    "mast3r",
    "dark3r",
    "distillation-only",
    "without-forward",
    "without-inverse",
    "without-saturation",
    "without-augmentation",
    "swimm3r",
]
IMPORTED: tuple[SfmMethod, ...] = ("gluemap", "spann3r", "vggt")
PEERS: tuple[SfmMethod, ...] = (
    *("colmap-incremental", "colmap-global"),
    *IMPORTED,
    *("mast3r", "dark3r", "distillation-only", "swimm3r"),
)
ABLATION: tuple[SfmMethod, ...] = (
    "swimm3r",
    "without-forward",
    "without-inverse",
    "without-saturation",
    "without-augmentation",
    "distillation-only",
)


@dataclass(frozen=True)
class SfmMethods(Settings):
    """Structure-from-motion methods to compare. A method whose files are missing is reported as not run."""

    methods: tuple[SfmMethod, ...] = PEERS
    """Methods to compare, by the names that the table shows."""
    adapters: Path | None = None
    """Folder with trainings of swimm3r train-sfm by recipe: ADAPTERS/dark3r/adapter.safetensors ..."""
    imports: Path | None = None
    """Folder with other programs' results on the same images: IMPORTS/vggt/SCENE or SCENE.npz, IMPORTS/gluemap/SCENE
    ..."""
