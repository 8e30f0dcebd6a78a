"""How a benchmark's scenes are spread over processes; torch-free, so that --help is instant."""

from dataclasses import dataclass

from swimm3r.errors import UsageError


@dataclass(frozen=True)
class JobSettings:
    """Scenes one after the other, in processes side by side, or as jobs of a Slurm cluster."""

    jobs: int = 1
    """Scenes computed at once, each in a process with its share of the cores."""
    slurm: bool = False
    """Each scene as a job through submitit (pip install submitit); all need the same disk."""
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
