"""A training's files while it runs: the state it goes on from and the rows of its metrics."""

import logging
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from swimm3r.errors import UsageError
from swimm3r.io.files import metrics_log
from swimm3r.io.files.damage import Remedy, damaged
from swimm3r.io.files.tensor_file import read_tensors, write_tensors
from swimm3r.sfm.student.adapter_file import trained_parameters
from swimm3r.sfm.student.student import Student

log = logging.getLogger(__name__)


def write_state(student: Student, optimizer: torch.optim.Optimizer, path: Path, about: dict[str, object]) -> None:
    """Trained parameters and the optimizer's moments, whole or not at all; `about` holds `step` and `fingerprint`."""
    stored: dict[str, Tensor] = {}
    for name, parameter in trained_parameters(student).items():
        stored[f"parameter/{name}"] = parameter
        stored |= {f"{key}/{name}": value for key, value in optimizer.state[parameter].items()}
    write_tensors(path, stored, about)


@dataclass(frozen=True)
class _Header:
    step: int
    fingerprint: str


def resume(student: Student, optimizer: torch.optim.Optimizer, path: Path, mark: str) -> int:
    """The steps done according to the state on disk, which is taken over; 0 where there is none.

    Raises InputError for a damaged state and for one of another `mark`.
    """
    if not path.is_file():
        return 0
    kept_state = read_tensors(path, _Header, _remedy(path), None)
    stored, about = kept_state.tensors, kept_state.about
    if about.fingerprint != mark:
        raise damaged(path, "it is of a training with other settings, data or base weights", _remedy(path))
    for name, parameter in trained_parameters(student).items():
        _check_shapes(stored, name, parameter, path)
        parameter.data.copy_(stored[f"parameter/{name}"])
        kept = {k: stored[f"{k}/{name}"] for k in ("step", "exp_avg", "exp_avg_sq") if f"{k}/{name}" in stored}
        if kept:  # a parameter that never had a gradient has no moments
            moments = {k: v if k == "step" else v.to(parameter.device) for k, v in kept.items()}
            optimizer.state[parameter] = moments
    log.info("going on from step %d", about.step)
    return about.step


def _check_shapes(stored: Mapping[str, Tensor], name: str, parameter: Tensor, path: Path) -> None:
    """Raise InputError where a parameter or its moments are missing or of another shape."""
    moments = [f"{key}/{name}" for key in ("exp_avg", "exp_avg_sq") if f"step/{name}" in stored]
    for key in (f"parameter/{name}", *moments):
        if key not in stored or stored[key].shape != parameter.shape:
            raise damaged(path, f"{key} is not of the shape {tuple(parameter.shape)}", _remedy(path))


class MetricsSums:
    """Sums of the terms since the last row, and the file they go to."""

    def __init__(self, path: Path, tensorboard: Path | None = None) -> None:
        self._path = path
        self._writer = None if tensorboard is None else _tensorboard(tensorboard)
        self._sums: dict[str, float] = {}
        self._count = 0
        self._epoch = 0.0
        self._began = time.perf_counter()

    def add(self, terms: dict[str, float], epoch: float) -> None:
        """One step's numbers."""
        for name, value in terms.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        self._count += 1
        self._epoch = epoch

    def write(self, step: int) -> None:
        """The means since the last row."""
        now = time.perf_counter()
        row: dict[str, object] = {"step": step, "epoch": round(self._epoch, 4)}
        row |= {name: value / self._count for name, value in self._sums.items()}
        row["seconds_per_step"] = round((now - self._began) / self._count, 4)
        self.append(row)
        self._sums, self._count, self._began = {}, 0, now

    def append(self, row: dict[str, object]) -> None:
        """A row as given."""
        metrics_log.append_row(self._path, row)
        if self._writer is not None:
            step = row["step"]
            for name, value in _flat(row):
                self._writer.add_scalar(name, value, step)
            self._writer.flush()


def _flat(row: Mapping[str, object], under: str = "") -> Iterator[tuple[str, float]]:
    """The numbers of a row, those of a nested one as `validation/loss`."""
    for name, value in row.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{under}{name}/")
        elif isinstance(value, int | float) and name != "step":
            yield under + name, float(value)


def _tensorboard(folder: Path) -> Any:
    try:
        from torch.utils.tensorboard.writer import SummaryWriter
    except ImportError as error:
        raise UsageError(
            "--tensorboard needs the package tensorboard",
            cause="it is not installed; Swimm3R itself does without",
            hint="pip install tensorboard, or leave --tensorboard out: metrics.jsonl has every number",
        ) from error
    return SummaryWriter(str(folder))


def _remedy(path: Path) -> Remedy:
    return Remedy(
        f"another --out, or remove {path} to start anew",
        cause="the folder holds another training, or its state is damaged",
        fault="cannot go on",
    )
