"""The place where independent parts of a work are computed; torch-free, and without influence on any result."""

from dataclasses import dataclass
from typing import Annotated, Literal

from swimm3r.settings import Count, CountOrZero, NotNegative, Range, Settings

EngineName = Literal["local", "slurm", "ray"]

_CORES_OF_A_JOB = 8


@dataclass(frozen=True)
class EngineSettings(Settings):
    """Processes of this computer, jobs of a Slurm cluster, or tasks of Ray."""

    engine: EngineName = "local"
    """Place of parts that are computed side by side: processes of this computer, jobs of a Slurm cluster
    (pip install 'swimm3r[slurm]'), or tasks of Ray (pip install 'swimm3r[ray]')."""
    jobs: Annotated[int, Range(1, 1024)] | None = None
    """Number of parts computed at once. Without it, one on this computer and as many as there is room for elsewhere."""
    retries: CountOrZero = 1
    """Number of further attempts at a part that was killed, ran out of memory or failed for no known reason."""
    cpus: CountOrZero = 0
    """Number of CPU cores of each part; 0 for its share of this computer's cores, and for 8 on a cluster."""
    gpus: CountOrZero = 0
    """Number of GPUs of each part on a cluster."""
    memory: NotNegative = 0.0
    """Memory of each part on a cluster, GB; 0 for the cluster's default."""
    partition: str = ""
    """Slurm partition of the jobs; empty for the cluster's default."""
    minutes: Count = 24 * 60
    """Time limit of a Slurm job, minutes."""
    cluster: Literal["slurm", "local", "debug"] = "slurm"
    """Executor of submitit: slurm, or local and debug to try the same on this computer."""
    address: str = ""
    """Address of a running Ray cluster, or auto; empty for $RAY_ADDRESS, else a Ray of its own on this computer."""

    @property
    def is_elsewhere(self) -> bool:
        """Other computers do the work."""
        return (self.engine == "slurm" and self.cluster == "slurm") or (self.engine == "ray" and self.address != "")

    @property
    def is_in_this_process(self) -> bool:
        """No other process does any of the work."""
        return self.engine == "local" and self.jobs in (None, 1)

    def at_once(self, cores: int) -> int:
        """Number of parts computed at once, on a computer of so many cores."""
        if self.jobs is not None:
            return self.jobs
        if self.is_elsewhere:
            return 1024
        return 1 if self.engine == "local" else max(1, cores // max(1, self.cpus))

    def threads_of_each(self, cores: int, parts: int) -> int:
        """Number of threads that each of so many parts may use, on a computer of so many cores."""
        if self.cpus:
            return self.cpus
        return _CORES_OF_A_JOB if self.is_elsewhere else max(1, cores // min(self.at_once(cores), max(1, parts)))
