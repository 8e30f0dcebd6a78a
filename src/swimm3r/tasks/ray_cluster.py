"""Tasks of Ray: on a running cluster, or in a Ray of their own on this computer."""

import os
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

from swimm3r.errors import UsageError
from swimm3r.tasks.outcome import Ended, Named, Work, attempt_in_a_process, ended_unheard, log_path
from swimm3r.tasks.settings import EngineSettings
from swimm3r.tasks.threads import core_count, thread_variables

_STORE_BYTES = 100 * 2**20  # for values between tasks, of which there are none: results lie in files


def in_ray(
    work: Work, items: Sequence[Named], engine: EngineSettings, logs: Path | None, isolated: bool
) -> Generator[tuple[int, Ended], None, None]:
    """The ends of all items as they come. Closing the iterator, or an exception in it, kills what still runs."""
    ray = _imported()
    cores = core_count()
    threads = engine.threads_of_each(cores, len(items))
    is_ours = not ray.is_initialized()
    if is_ours:
        _connect(ray, engine, max(cores, threads))
    task = ray.remote(max_calls=1 if isolated else 0)(attempt_in_a_process).options(
        num_cpus=threads,
        num_gpus=engine.gpus,
        memory=engine.memory * 1e9 or None,
        max_retries=0,
        runtime_env={"env_vars": thread_variables(threads)},
    )
    waiting = list(enumerate(items))
    running: dict[Any, tuple[int, Named]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < engine.at_once(cores):
                index, item = waiting.pop(0)
                path = log_path(logs and logs.resolve(), item.name)
                running[task.remote(work, item, threads, path)] = index, item
            for reference in ray.wait(list(running))[0]:
                index, item = running.pop(reference)
                yield index, _end_of(ray, reference, item.name)
    finally:
        for reference in running:
            ray.cancel(reference, force=True)
        if is_ours:
            ray.shutdown()


def _end_of(ray: Any, reference: Any, name: str) -> Ended:
    try:
        return ray.get(reference)
    except ray.exceptions.RayError as error:
        return ended_unheard(name, f"{type(error).__name__} of Ray")


def _imported() -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent anywhere
    try:
        import ray
    except ImportError as error:
        raise UsageError(
            "tasks are sent to Ray by its package, which is not installed",
            cause="Swimm3R was installed without its ray extra",
            hint="pip install 'swimm3r[ray]', or --engine local --jobs N for processes of this computer",
        ) from error
    return ray


def _connect(ray: Any, engine: EngineSettings, cores: int) -> None:
    address = engine.address or os.environ.get("RAY_ADDRESS", "local")
    own = {"num_cpus": cores, "object_store_memory": _STORE_BYTES, "include_dashboard": False}
    try:
        ray.init(address=address, log_to_driver=False, logging_level="error", **(own if address == "local" else {}))
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise UsageError(
            f"there is no Ray at {address}",
            cause=(str(error).splitlines() or [type(error).__name__])[0],
            hint="ray start --head starts one; without --address a Ray of its own starts on this computer",
        ) from error
