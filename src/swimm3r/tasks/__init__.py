"""Independent parts of a work side by side: in processes of this computer, as Slurm jobs by submitit, or in Ray.

    failures = run_tasks(partial(sweep, folder=folder), chunks, EngineSettings(jobs=4), progress, "chunks")

Every task keeps its results in files, so that a call that is repeated after a kill makes only those that are missing.
"""

import logging
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from pathlib import Path

from swimm3r.progress import Progress, silent
from swimm3r.tasks.outcome import Ended, Failure, Named, Work, attempt, log_path
from swimm3r.tasks.settings import EngineSettings

log = logging.getLogger(__name__)


def _ignore(name: str, failure: Failure | None, /) -> None:
    """The default: nobody waits for single tasks."""


def run_tasks(
    work: Work,
    items: Sequence[Named],
    engine: EngineSettings = EngineSettings(),  # noqa: B008 - records are frozen
    progress: Progress = silent,
    label: str = "tasks",
    *,
    logs: Path | None = None,
    isolated: bool = False,
    on_end: Callable[[str, Failure | None], None] = _ignore,
) -> tuple[Failure, ...]:
    """Call `work(item)` for every item and return the failures, in the items' order.

    One local job at a time runs in this process, unless `isolated` asks for a process for every task; more of them run
    in child processes that share the cores. A task whose process is killed, or that fails for no reason that the user
    can mend, is tried again when the others are done, at most `engine.retries` times. An interruption (^C) ends all
    processes, jobs and tasks before it leaves this function. Other tasks print into `logs`/NAME.log; with
    Slurm and Ray clusters, `logs` must lie on a disk that every computer sees. `on_end` is told of every task that is
    done, or has failed for good.

    Raises UsageError where submitit or ray is not installed, and where there is no cluster to send tasks to.
    """
    names = [item.name for item in items]
    assert len(set(names)) == len(names), "two tasks have one name"
    failures: dict[int, Failure] = {}
    left = list(range(len(items)))
    ended = 0
    progress(label, 0, len(items))
    for attempts_left in range(engine.retries, -1, -1):
        again: list[int] = []
        with closing(_ends(work, [items[index] for index in left], engine, logs, isolated)) as ends:
            for place, end in ends:
                index = left[place]
                failure = None if end.error is None else Failure(names[index], end.error, _existing(logs, names[index]))
                if failure is not None and end.is_worth_another and attempts_left:
                    log.warning("%s; it is tried again", failure.message)
                    again.append(index)
                    continue
                if failure is not None:
                    failures[index] = failure
                on_end(names[index], failure)
                ended += 1
                progress(label, ended, len(items))
        left = sorted(again)
        if not left:
            break
    return tuple(failures[index] for index in sorted(failures))


def _ends(
    work: Work, items: Sequence[Named], engine: EngineSettings, logs: Path | None, isolated: bool
) -> Generator[tuple[int, Ended], None, None]:
    """The end of every item's attempt with its index, in the order in which they end."""
    match engine.engine:
        case "local":
            if not isolated and engine.is_in_this_process:
                return ((index, attempt(work, item)) for index, item in enumerate(items))
            from swimm3r.tasks.local import in_processes

            return in_processes(work, items, engine, logs, isolated)
        case "slurm":
            from swimm3r.tasks.slurm import as_jobs

            return as_jobs(work, items, engine, logs)
        case "ray":
            from swimm3r.tasks.ray_cluster import in_ray

            return in_ray(work, items, engine, logs, isolated)


def _existing(logs: Path | None, name: str) -> Path | None:
    path = log_path(logs, name)
    return path if path is not None and path.exists() else None
