"""Medium-aware training: the loop, its states on disk, and going on where it stopped, in one process or several.

Everything random is drawn from the seed and the step: order of the pairs, water, adapters. A state therefore needs no
generators, and a training that was killed ends with the same bits as one that was not (one machine, one number of
threads). Started by torchrun, every process takes an equal share of each batch, and DistributedDataParallel averages
the gradients; the losses are means over pairs, so the curve is that of one process with the same batch.

    FOLDER/state.safetensors     trained parameters and AdamW's moments, of the last finished stretch
    FOLDER/metrics.jsonl         every term of the objective each few steps, validation after each epoch
    FOLDER/adapter.safetensors   what is handed on (adapter_file.py), after each epoch
    FOLDER/teacher/              what the teacher says of each pair (teacher_cache.py), where asked for
"""

import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from swimm3r.errors import InputError, UsageError
from swimm3r.io.files.cache_key import cache_key
from swimm3r.io.files.metrics_log import drop_rows_after
from swimm3r.memory import MB, peak_mb
from swimm3r.progress import Progress, silent
from swimm3r.sfm.distillation.pairs import PairData, PairItem
from swimm3r.sfm.distillation.settings import TrainSettings
from swimm3r.sfm.distillation.state import MetricsSums, resume, write_state
from swimm3r.sfm.distillation.teacher_cache import TeacherCache
from swimm3r.sfm.mast3r.network import Mast3r
from swimm3r.sfm.student import adapter_file
from swimm3r.sfm.student.adapter_file import Base, trained_parameters
from swimm3r.sfm.student.student import Student, new_student

_ORDER, _WATER = 1, 2  # purposes of randomness
_TERMS = ("encoder", "decoder", "descriptors", "forward", "inverse", "overshoot", "anchor", "known_water", "clean")
_LOADERS = 4  # threads that read and resize images while the network works

Validate = Callable[[Student, PairData], dict[str, Any]]


@dataclass(frozen=True)
class Workers:
    """The processes that train together, and which one this is."""

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        return self.rank == 0


@dataclass(frozen=True)
class Estimate:
    """Time of a training, measured on its first pairs."""

    pairs: int
    steps: int
    trained: int  # numbers
    seconds_per_step: float
    peak_mb: float | None  # of the device, or of the process where there is no accelerator; None where unknown

    @property
    def hours(self) -> float:
        return self.steps * self.seconds_per_step / 3600


def train(
    network: Mast3r,
    base: Base,
    data: PairData,
    validation: PairData,
    settings: TrainSettings,
    folder: Path,
    validate: Validate,
    announce: Callable[[Estimate], None] = lambda estimate: None,
    progress: Progress = silent,
) -> Path:
    """Trains, or goes on training, and returns the adapter's path; the network keeps its own weights.

    Raises UsageError where the batch does not divide among the processes, InputError where there are fewer pairs than
    processes, or where `folder` holds the state of another training.
    """
    with _workers(network) as workers:
        student = new_student(network, settings.lora, settings.objective, settings.seed).train()
        try:
            return _Training(student, base, data, validation, settings, folder, validate, workers).run(
                announce, progress
            )
        finally:
            student.adapters.detach()


@dataclass(frozen=True)
class _Training:
    """One training, its data and its files, as one of the processes sees it."""

    student: Student
    base: Base
    data: PairData
    validation: PairData
    settings: TrainSettings
    folder: Path
    validate: Validate
    workers: Workers

    @property
    def adapter(self) -> Path:
        """The file that is handed on."""
        return self.folder / "adapter.safetensors"

    @property
    def state(self) -> Path:
        """The file that a training resumes from."""
        return self.folder / "state.safetensors"

    @cached_property
    def size(self) -> int:
        """Pairs per step."""
        return batch_size(self.settings, len(self.data), self.workers)

    @property
    def per_epoch(self) -> int:
        """Steps per epoch."""
        return len(self.data) // self.size

    @cached_property
    def mark(self) -> str:
        """Settings, base and data: a state of another training is not continued."""
        return _fingerprint(self.settings, self.base, self.data)

    def run(self, announce: Callable[[Estimate], None], progress: Progress) -> Path:
        """Train to the end from the state on disk, if there is one; the path of the adapter."""
        settings, student, workers = self.settings, self.student, self.workers
        total = settings.epochs * self.per_epoch
        optimizer = torch.optim.AdamW(
            trained_parameters(student).values(), lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        metrics = self.folder / "metrics.jsonl"
        done = resume(student, optimizer, self.state, self.mark)
        if workers.first:
            self.folder.mkdir(parents=True, exist_ok=True)
            drop_rows_after(metrics, done)
            if done < total:
                announce(_estimate(student, self.data, settings, total, self.size, workers))
        model = _shared(student) if workers.count > 1 else student
        cache = None
        if settings.teacher_cache_mb:
            kept = self.folder / "teacher" / self.mark[:16] / str(workers.rank)
            cache = TeacherCache(kept, settings.teacher_cache_mb << 20)
        board = self.folder / "tensorboard" if settings.tensorboard and workers.first else None
        rows = MetricsSums(metrics, board)
        with ThreadPoolExecutor(_LOADERS) as pool:
            for step, items in self._batches(pool, done + 1, total):
                if workers.first:
                    progress("training the student", step - 1, total)
                for group in optimizer.param_groups:
                    group["lr"] = learning_rate(settings, step, total)
                terms = _step(model, student, optimizer, items, settings, self.size // workers.count, cache)
                rows.add(_mean_over_workers(terms, workers), step / self.per_epoch)
                if workers.first:
                    self._keep(step, rows, optimizer)
        if workers.first:
            progress("training the student", total, total)
        return self.adapter

    def _batches(self, pool: ThreadPoolExecutor, first: int, total: int) -> Iterator[tuple[int, list[PairItem]]]:
        """Every step from `first` on and its pairs; those of the next are read meanwhile."""
        data, settings, size, workers = self.data, self.settings, self.size, self.workers
        coming = _load(pool, data, settings, size, first, workers) if first <= total else []
        for step in range(first, total + 1):
            items = [future.result() for future in coming]
            coming = _load(pool, data, settings, size, step + 1, workers) if step < total else []
            yield step, items

    def _keep(self, step: int, rows: MetricsSums, optimizer: torch.optim.Optimizer) -> None:
        """Write what is due after a step: a row of metrics, the adapter, the state to resume from."""
        ends_epoch = step % self.per_epoch == 0
        if step % self.settings.log_every == 0 or ends_epoch:
            rows.write(step)
        if ends_epoch:
            about: dict[str, Any] = {"step": step, "epoch": step // self.per_epoch, "settings": asdict(self.settings)}
            if len(self.validation):
                about["validation"] = self._validated()
                rows.append({"step": step, "validation": about["validation"]})
            adapter_file.save(self.student, self.base, self.adapter, about)
        if step % self.settings.checkpoint_every == 0 or ends_epoch:
            write_state(self.student, optimizer, self.state, {"step": step, "fingerprint": self.mark})

    def _validated(self) -> dict[str, Any]:
        self.student.eval()
        with torch.no_grad():
            found = self.validate(self.student, self.validation)
        self.student.train()
        return found


def _shared(student: Student) -> DistributedDataParallel:
    """The student with its gradients averaged over the processes."""
    s = student.objective
    # adapters of the decoder stay without a gradient where only the encoder is compared
    return DistributedDataParallel(student, find_unused_parameters=not (s.decoder or s.descriptors))


def batch_size(settings: TrainSettings, pairs: int, workers: Workers = Workers()) -> int:
    """Pairs per step: the setting, or all pairs where there are fewer; a multiple of the number of processes.

    What is left of an epoch after its last whole batch is not used; it is drawn anew every epoch.
    """
    if settings.batch % workers.count:
        raise UsageError(
            f"a batch of {settings.batch} pairs does not divide among {workers.count} processes",
            cause="torchrun started more processes than the batch has pairs, or an odd number of them",
            hint=f"--batch {workers.count * max(1, settings.batch // workers.count)}",
        )
    size = min(settings.batch, pairs) // workers.count * workers.count
    if size == 0:
        raise InputError(
            f"{pairs} pairs are too few for {workers.count} processes",
            cause="the data set is tiny, or most of it was left out",
            hint="fewer processes; swimm3r datasets ROOT shows what was found",
        )
    return size


def learning_rate(settings: TrainSettings, step: int, total: int) -> float:
    """Adam's rate in a step (from 1); in the cool-down it falls along a line that would reach 0 after the last step."""
    left = (total + 1 - step) / (total + 1)
    return settings.learning_rate * min(1.0, left / settings.cool_down if settings.cool_down else 1.0)


def pairs_of_step(step: int, pairs: int, size: int, seed: int) -> list[int]:
    """The pairs of a step; each epoch takes every pair at most once, in its own order; steps count from 1."""
    epoch, place = divmod(step - 1, pairs // size)
    order = torch.randperm(pairs, generator=_generator(seed, epoch, _ORDER))
    return order[place * size : (place + 1) * size].tolist()


def _load(
    pool: ThreadPoolExecutor, data: PairData, settings: TrainSettings, size: int, step: int, workers: Workers
) -> list[Future[PairItem]]:
    """This process's share of a step's pairs, being loaded. Water depends on the place in the whole batch."""
    chosen = pairs_of_step(step, len(data), size, settings.seed)
    return [
        pool.submit(data.item, chosen[k], settings.water_probability, _generator(settings.seed, step, _WATER + k))
        for k in range(workers.rank, size, workers.count)
    ]


def _step(
    model: torch.nn.Module,
    student: Student,
    optimizer: torch.optim.Optimizer,
    items: list[PairItem],
    settings: TrainSettings,
    share: int,
    cache: TeacherCache | None,
) -> dict[str, Tensor]:
    """One step on this process's share of a batch; the sums of the terms over it."""
    sums: dict[str, Tensor] = {}
    parts = list(_parts(items, settings.micro_batch or len(items)))
    for number, part in enumerate(parts, start=1):
        last = number == len(parts)
        with nullcontext() if last or model is student else model.no_sync():  # type: ignore[operator]
            batch = _batch(part, student)
            teacher = None if cache is None else cache.features(student, batch["clean"])
            terms = model(**batch, teacher=teacher)
            (student.total(terms).sum() / share).backward()
        for name, values in {**terms, "loss": student.total(terms)}.items():
            sums[name] = sums.get(name, torch.zeros((), device=values.device)) + values.detach().sum()
    optimizer.step()
    optimizer.zero_grad(set_to_none=True)
    return {name: value / share for name, value in sums.items()}


def _parts(items: list[PairItem], most: int) -> Iterator[list[PairItem]]:
    """The items in groups of one size of image, none larger than `most`."""
    groups: dict[torch.Size, list[PairItem]] = {}
    for item in items:
        groups.setdefault(item.clean.shape, []).append(item)
    for group in groups.values():
        for start in range(0, len(group), most):
            yield group[start : start + most]


def _batch(items: list[PairItem], student: Student) -> dict[str, Tensor]:
    device = student.network.decoder_embed.weight.device
    return {name: torch.stack([getattr(i, name) for i in items]).to(device) for name in PairItem.__annotations__}


def _estimate(
    student: Student, data: PairData, settings: TrainSettings, total: int, size: int, workers: Workers
) -> Estimate:
    """One forward and backward pass, its gradients thrown away."""
    share = size // workers.count
    count = min(settings.micro_batch or share, share)
    items = [data.item(k, settings.water_probability, _generator(settings.seed, 0, _WATER + k)) for k in range(count)]
    part = next(_parts(items, count))
    device = student.network.decoder_embed.weight.device
    began = time.perf_counter()
    student.total(student(**_batch(part, student))).sum().backward()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    seconds = (time.perf_counter() - began) * share / len(part)
    for parameter in student.parameters():
        parameter.grad = None
    trained = sum(p.numel() for p in student.parameters())
    return Estimate(len(data), total, trained, seconds, _peak_mb(device))


def _peak_mb(device: torch.device) -> float | None:
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / MB
    return peak_mb()


def _mean_over_workers(terms: dict[str, Tensor], workers: Workers) -> dict[str, float]:
    names = ("loss", *_TERMS)
    values = torch.stack([terms[name] for name in names])
    if workers.count > 1:
        dist.all_reduce(values)
        values = values / workers.count
    return dict(zip(names, values.tolist(), strict=True))


def _fingerprint(settings: TrainSettings, base: Base, data: PairData) -> str:
    same = replace(settings, log_every=1, checkpoint_every=1, tensorboard=False)  # they change nothing that is learned
    return cache_key(same, base.sha256, data.fingerprint())


def _generator(seed: int, step: int, purpose: int) -> torch.Generator:
    """The randomness of one purpose in one step."""
    return torch.Generator().manual_seed(((seed * 1_000_003 + step) * 1_009 + purpose) % (1 << 63))


@contextmanager
def _workers(network: Mast3r) -> Iterator[Workers]:
    """The processes torchrun started, or this one alone."""
    if int(os.environ.get("WORLD_SIZE", "1")) < 2:
        yield Workers()
        return
    on_gpu = network.decoder_embed.weight.is_cuda
    dist.init_process_group("nccl" if on_gpu else "gloo")
    try:
        yield Workers(dist.get_rank(), dist.get_world_size())
    finally:
        dist.destroy_process_group()
