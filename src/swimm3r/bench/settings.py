"""What the protocols are told besides the settings of their parts; torch-free, so that --help is instant."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from swimm3r.settings import Count, CountOrZero, Range, Settings

Seeds = Annotated[int, Range(1, 1000)]  # trainings of one method on one scene


@dataclass(frozen=True)
class JobSettings(Settings):
    """Scenes one after the other, in processes side by side, or as jobs of a Slurm cluster."""

    jobs: Annotated[int, Range(1, 1024)] = 1
    """Scenes computed at once, each in a process with its share of the cores."""
    slurm: bool = False
    """Each scene as a job through submitit (pip install 'swimm3r[slurm]'); all need the same disk."""
    partition: str = ""
    """Slurm's; its default where empty."""
    minutes: Count = 24 * 60
    """Most a Slurm job may take."""
    cpus: Count = 8
    """Of a Slurm job."""
    gpus: CountOrZero = 0
    """Of a Slurm job."""


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
    """Which ways of structure from motion are compared. One that lacks its files is reported as not run."""

    methods: tuple[SfmMethod, ...] = PEERS
    adapters: Path | None = None
    """Trainings of swimm3r train-sfm by the names of their recipes: ADAPTERS/dark3r/adapter.safetensors ..."""
    imports: Path | None = None
    """What other programs made of the same images: IMPORTS/vggt/SCENE or SCENE.npz, IMPORTS/gluemap/SCENE, ..."""
