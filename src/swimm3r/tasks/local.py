"""Tasks in processes of this computer, several at once; a process that is killed takes no other with it."""

import logging
import os
import signal
import threading
from collections import deque
from collections.abc import Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from multiprocessing import connection, get_context, parent_process
from pathlib import Path

from swimm3r.tasks.outcome import Ended, Named, Work, attempt_in_a_process, ended_unheard, log_path
from swimm3r.tasks.settings import EngineSettings
from swimm3r.tasks.threads import limit_threads, thread_count

_KILL = getattr(signal, "SIGKILL", signal.SIGTERM)  # Windows has one way


def in_processes(
    work: Work, items: Sequence[Named], engine: EngineSettings, logs: Path | None, isolated: bool
) -> Generator[tuple[int, Ended], None, None]:
    """The ends of all items as they come. Closing the iterator, or an exception in it, kills what still runs."""
    cores = thread_count()
    threads = engine.threads_of_each(cores, len(items))
    idle = [_Worker(threads) for _ in range(min(engine.at_once(cores), len(items)))]
    workers = tuple(idle)
    waiting = deque(enumerate(items))
    running: dict[Future[Ended], tuple[_Worker, int, Named]] = {}
    try:
        while waiting or running:
            while idle and waiting:
                worker, (index, item) = idle.pop(), waiting.popleft()
                running[worker.start(work, item, log_path(logs, item.name))] = worker, index, item
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                worker, index, item = running.pop(future)
                try:
                    end = future.result()
                except BrokenProcessPool:
                    end = ended_unheard(item.name, "no word of it came back")
                    worker.leave()
                if isolated:
                    worker.leave()
                idle.append(worker)
                yield index, end
    finally:
        for worker in workers:
            worker.kill()


class _Worker:
    """A place for one process, which does one task after the other; another follows where it was killed."""

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._pool: ProcessPoolExecutor | None = None
        self._process: Future[int] | None = None

    def start(self, work: Work, item: Named, path: Path | None) -> Future[Ended]:
        if self._pool is None:
            level = logging.getLogger("swimm3r").getEffectiveLevel()
            self._pool = ProcessPoolExecutor(1, get_context("spawn"), _begin, (self._threads, level))
            self._process = self._pool.submit(os.getpid)
        return self._pool.submit(attempt_in_a_process, work, item, self._threads, path)

    def leave(self) -> None:
        """Let the process end where it is idle."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def kill(self) -> None:
        """End the process, whatever it does."""
        if self._pool is None:
            return
        process = self._process
        self._pool.shutdown(wait=False, cancel_futures=True)
        if process is not None and process.done() and not process.cancelled() and process.exception() is None:
            with suppress(ProcessLookupError):  # it ended by itself meanwhile
                os.kill(process.result(), _KILL)
        self.leave()


def _begin(threads: int, level: int) -> None:
    """Set up a process that only does tasks."""
    limit_threads(threads)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ^C reaches the whole terminal; the parent ends its processes itself
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    logging.getLogger("swimm3r").setLevel(max(level, logging.WARNING))
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process as soon as the one that started it is gone, even where that one was killed."""
    parent = parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)
