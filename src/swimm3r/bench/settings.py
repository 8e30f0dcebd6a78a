"""What the protocols are told besides the settings of their parts; torch-free, so that --help is instant."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from swimm3r.errors import UsageError


@dataclass(frozen=True)
class JobSettings:
    """Scenes one after the other, in processes side by side, or as jobs of a Slurm cluster."""

    jobs: int = 1
    """Scenes computed at once, each in a process with its share of the cores."""
    slurm: bool = False
    """Each scene as a job through submitit (pip install 'swimm3r[slurm]'); all need the same disk."""
    partition: str = ""
    """Slurm's; its default where empty."""
    minutes: int = 24 * 60
    """Most a Slurm job may take."""
    cpus: int = 8
    """Of a Slurm job."""
    gpus: int = 0
    """Of a Slurm job."""

    def __post_init__(self) -> None:
        for name in ("jobs", "minutes", "cpus"):
            if getattr(self, name) < 1:
                raise UsageError(
                    f"{name} is at least 1, got {getattr(self, name)}",
                    cause="a slip in the command",
                    hint="leave it out for the default",
                )


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
class SfmMethods:
    """Which ways of structure from motion are compared. One that lacks its files is reported as not run."""

    methods: tuple[SfmMethod, ...] = PEERS
    adapters: Path | None = None
    """Trainings of swimm3r train-sfm by the names of their recipes: ADAPTERS/dark3r/adapter.safetensors ..."""
    imports: Path | None = None
    """What other programs made of the same pictures: IMPORTS/vggt/SCENE or SCENE.npz, IMPORTS/gluemap/SCENE, ..."""
