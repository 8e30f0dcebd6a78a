"""Checkpoints on disk: the tensors of a training state under their names, and the step in the header."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from torch import Tensor

from swimm3r.io.files.damage import Remedy
from swimm3r.io.files.tensor_file import TensorFile, read_tensors, write_tensors

SCHEMA = 3  # 2: the water's layers are convolutions; 1: Swimm3R 0.1, whose settings have other names


@dataclass(frozen=True)
class StateHeader:
    """The header of a checkpoint."""

    step: int
    fingerprint: str

    def __post_init__(self) -> None:
        if self.step < 0:
            raise ValueError(f"steps count from 0, got {self.step}")


def write_state(path: Path, tensors: Mapping[str, Tensor], header: StateHeader) -> None:
    """Write a checkpoint, whole or not at all."""
    write_tensors(path, tensors, {"schema": SCHEMA, **asdict(header)})


def read_state(path: Path) -> TensorFile[StateHeader]:
    """Read what `write_state` wrote. Raises InputError for a file that is damaged or of another kind."""
    return read_tensors(path, StateHeader, state_remedy(path), SCHEMA)


def state_remedy(path: Path) -> Remedy:
    """Advice for a checkpoint that training cannot go on from."""
    return Remedy(f"remove {path.parent}; the same command then trains from the start")
