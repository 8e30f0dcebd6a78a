"""Tasks as jobs of a Slurm cluster, by submitit; its other executors do the same in processes of this computer."""

import time
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from swimm3r.errors import UsageError
from swimm3r.tasks.outcome import Ended, Named, Work, attempt_in_a_process, ended_unheard, log_path
from swimm3r.tasks.settings import EngineSettings
from swimm3r.tasks.threads import core_count, thread_variables

_OWN_FOLDER = Path("swimm3r-jobs")  # of tasks that have no logs; the temporary files of a computer are its own
_LOOK_EVERY_S = 0.1, 5.0  # at first, and at most


@dataclass(frozen=True)
class Job:
    """A task as submitit sends it; a job whose time is over, or that makes room for others, is queued again."""

    work: Work
    item: Named
    threads: int
    log: Path | None

    def __call__(self) -> Ended:
        return attempt_in_a_process(self.work, self.item, self.threads, self.log)

    def checkpoint(self) -> Any:
        """Called by submitit shortly before the job is ended."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


def as_jobs(
    work: Work, items: Sequence[Named], engine: EngineSettings, logs: Path | None
) -> Generator[tuple[int, Ended], None, None]:
    """The ends of all items as they come. Closing the iterator, or an exception in it, cancels what still runs."""
    cores = core_count()
    threads = engine.threads_of_each(cores, len(items))
    executor = _executor(engine, (logs or _OWN_FOLDER).resolve() / "submitit", threads)
    calls = [Job(work, item, threads, log_path(logs and logs.resolve(), item.name)) for item in items]
    waiting = list(enumerate(calls))
    running: dict[int, Any] = {}
    try:
        if engine.cluster == "slurm":  # one array, of which Slurm runs so many at once
            with executor.batch():
                running = {index: executor.submit(call) for index, call in waiting}
            waiting = []
        pause = _LOOK_EVERY_S[0]
        while waiting or running:
            while waiting and len(running) < engine.at_once(cores):
                index, call = waiting.pop(0)
                running[index] = executor.submit(call)
            done = [index for index, job in running.items() if job.done()]
            for index in done:
                yield index, _end_of(running.pop(index), items[index].name)
            pause = _LOOK_EVERY_S[0] if done else min(_LOOK_EVERY_S[1], 1.5 * pause)
            if running and not done:
                time.sleep(pause if engine.cluster == "slurm" else _LOOK_EVERY_S[0])
    finally:
        for job in running.values():
            job.cancel()


def _end_of(job: Any, name: str) -> Ended:
    from submitit.core.utils import FailedJobError, UncompletedJobError

    try:
        return job.result()
    except (FailedJobError, UncompletedJobError) as error:
        return ended_unheard(name, f"job {job.job_id}, {job.state.lower()}: {str(error).splitlines()[0]}")


def _executor(engine: EngineSettings, folder: Path, threads: int) -> Any:
    try:
        import submitit
    except ImportError as error:
        raise UsageError(
            "jobs are sent to Slurm by submitit, which is not installed",
            cause="Swimm3R was installed without its slurm extra",
            hint="pip install 'swimm3r[slurm]', or --engine local --jobs N for processes of this computer",
        ) from error
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=engine.cluster)
    except RuntimeError as error:
        raise UsageError(
            "there is no Slurm on this computer",
            cause=str(error).splitlines()[0],
            hint="the login node of the cluster; or --engine local --jobs N, or --cluster local",
        ) from error
    options: dict[str, Any] = {"timeout_min": engine.minutes, "cpus_per_task": threads, "gpus_per_node": engine.gpus}
    if engine.memory:
        options["mem_gb"] = engine.memory
    if engine.cluster == "slurm":
        options |= {"name": "swimm3r", "slurm_array_parallelism": engine.at_once(core_count())}
        options["slurm_setup"] = [f"export {name}={value}" for name, value in thread_variables(threads).items()]
        options |= {"slurm_partition": engine.partition} if engine.partition else {}
    executor.update_parameters(**options)
    return executor
