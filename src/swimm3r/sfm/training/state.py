"""A training's files while it runs: the state it goes on from and the rows of its metrics."""

import json
import logging
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from swimm3r.errors import InputError, UsageError
from swimm3r.io.atomic import atomic_path, write_text
from swimm3r.sfm.adapter_file import trained_parameters
from swimm3r.sfm.student import Student

log = logging.getLogger(__name__)


def write_state(student: Student, optimiser: torch.optim.Optimizer, path: Path, about: dict[str, object]) -> None:
    """Trained parameters and the optimiser's moments, whole or not at all; `about` holds `step` and `fingerprint`."""
    stored: dict[str, Tensor] = {}
    for name, parameter in trained_parameters(student).items():
        stored[f"parameter/{name}"] = parameter
        stored |= {f"{key}/{name}": value for key, value in optimiser.state[parameter].items()}
    stored = {key: value.detach().cpu().contiguous() for key, value in stored.items()}
    with atomic_path(path) as draft:
        save_file(stored, draft, {"swimm3r": json.dumps(about)})


def resume(student: Student, optimiser: torch.optim.Optimizer, path: Path, mark: str) -> int:
    """The steps done according to the state on disk, which is taken over; 0 where there is none.

    Raises InputError for a damaged state and for one of another `mark`.
    """
    if not path.is_file():
        return 0
    try:
        with safe_open(path, "pt") as file:
            about = json.loads((file.metadata() or {})["swimm3r"])
            stored = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError, ValueError, KeyError) as error:
        raise _foreign(path, str(error).splitlines()[0]) from error
    if about["fingerprint"] != mark:
        raise _foreign(path, "it is of a training with other settings, data or base weights")
    for name, parameter in trained_parameters(student).items():
        parameter.data.copy_(stored[f"parameter/{name}"])
        kept = {k: stored[f"{k}/{name}"] for k in ("step", "exp_avg", "exp_avg_sq") if f"{k}/{name}" in stored}
        if kept:  # a parameter that never had a gradient has no moments
            moments = {k: v if k == "step" else v.to(parameter.device) for k, v in kept.items()}
            optimiser.state[parameter] = moments
    log.info("going on from step %d", about["step"])
    return int(about["step"])


class Rows:
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
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
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


def forget_rows_after(metrics: Path, done: int) -> None:
    """Rows of steps that will be done again, and a row cut off in the middle, are dropped."""
    if metrics.is_file():
        rows = metrics.read_text(encoding="utf-8").splitlines()
        whole = [row for row in rows if row.endswith("}") and json.loads(row)["step"] <= done]
        write_text(metrics, "".join(row + "\n" for row in whole))


def _foreign(path: Path, why: str) -> InputError:
    return InputError(
        f"the training in {path.parent} cannot go on: {why}",
        cause="the folder holds another training, or its state is damaged",
        hint="another --out, or delete the folder to start anew",
    )
