"""Cases, and the way one is run: the command line in a forked process, in a folder of its own, under a time limit.

The parent has everything imported, so a case costs its own work only. A case passes where its exit code is among the
expected ones, no traceback was printed, a failure states cause and remedy, and nothing beside its own folder changed.
"""

import contextlib
import ctypes
import os
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

SMALL = (  # settings that finish a run in seconds
    *("--preset", "fast", "--splat.iterations", "40", "--splat.initial.primitives", "1200"),
    *("--splat.densify.cap-max", "2000", "--test.steps", "2"),
)
_CRASHED = 1


@dataclass(frozen=True)
class Case:
    """One attack: `prepare` makes the files in the case's folder, `arguments` follow `swimm3r`."""

    name: str
    arguments: tuple[str, ...]
    codes: tuple[int, ...]
    prepare: Callable[[Path], object] = lambda folder: None
    as_nobody: bool = False  # without root's right to read everything
    memory: int | None = None  # bytes of address space beyond those the process starts with
    seconds: int = 240
    says: str | None = None  # words the output must hold


@dataclass(frozen=True)
class Outcome:
    """The end of one case."""

    case: Case
    code: int
    seconds: float
    output: str
    faults: tuple[str, ...] = field(default=())


@dataclass(frozen=True)
class Fixture:
    """The undamaged files of all cases: a dive's images with its truth, and a finished run of it."""

    dive: Path
    run: Path


def build_fixture(folder: Path) -> Fixture:
    """A synthetic dive of 16 frames and a finished run of it; made once, reused by later calls."""
    from swimm3r.synthetic import DiveSettings, write_dive

    dive, run = folder / "dive", folder / "run"
    if not dive.is_dir():
        write_dive(DiveSettings(frames=16, width=160, height=120), dive)
    if not (run / "report.html").is_file():
        case = Case("fixture", ("run", str(dive), "--out", str(run), *SMALL), (0,), seconds=900)
        ended = run_case(case, folder)
        if ended.code != 0:
            raise RuntimeError(f"the undamaged run failed:\n{ended.output}")
    return Fixture(dive, run)


def run_case(case: Case, scratch: Path) -> Outcome:
    """Run one case in a fresh folder below `scratch`, which is removed afterwards."""
    folder = Path(tempfile.mkdtemp(prefix="case-", dir=scratch))
    folder.chmod(0o777)
    try:
        case.prepare(folder)
        before = _listing(scratch, folder)
        started = time.monotonic()
        code, output = _forked(case, folder)
        faults = tuple(_faults(case, code, output, before, _listing(scratch, folder)))
        return Outcome(case, code, time.monotonic() - started, output, faults)
    finally:
        _remove(folder)


def _faults(case: Case, code: int, output: str, before: set[str], after: set[str]) -> Iterator[str]:
    if code not in case.codes:
        yield f"exit {code}, expected {list(case.codes)}"
    if "Traceback (most recent call last)" in output:
        yield "traceback"
    if code in (3, 4, 5, 6, 7) and not ("Likely cause" in output and "Try" in output):
        yield "no cause or remedy"
    if case.says is not None and case.says.lower() not in output.lower():
        yield f"does not say {case.says!r}"
    if before != after:
        yield f"changed outside its folder: {sorted(before ^ after)[:3]}"


def _forked(case: Case, folder: Path) -> tuple[int, str]:
    log = folder.parent / f"{folder.name}.log"
    child = os.fork()
    if child == 0:
        os._exit(_child(case, folder, log))
    deadline = time.monotonic() + case.seconds
    while time.monotonic() < deadline:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            code = os.waitstatus_to_exitcode(status)
            break
        time.sleep(0.02)
    else:
        os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
        code = -1000  # a hang
    output = log.read_text(errors="replace") if log.exists() else ""
    log.unlink(missing_ok=True)
    return code, output


def _child(case: Case, folder: Path, log: Path) -> int:
    os.setpgid(0, 0)
    sink = os.open(log, os.O_CREAT | os.O_WRONLY | os.O_TRUNC, 0o666)
    for stream in (1, 2):
        os.dup2(sink, stream)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.chdir(folder)
    if case.as_nobody:
        _without_override()
    if case.memory is not None:
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + case.memory, used + case.memory))
    try:
        from swimm3r.cli.main import main

        main(list(case.arguments))
        code = 0
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except BaseException:  # noqa: BLE001 - whatever a case raises is its outcome
        traceback.print_exc()
        code = _CRASHED
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
        sys.stderr.flush()
    return code


def _without_override() -> None:
    """Give up root's right to read and write whatever a file's mode forbids (Linux)."""
    header = struct.pack("Ii", 0x20080522, 0)  # _LINUX_CAPABILITY_VERSION_3, this process
    libc = ctypes.CDLL(None, use_errno=True)
    sets = ctypes.create_string_buffer(24)
    if libc.capget(header, sets) != 0:
        raise OSError(ctypes.get_errno(), "capget")
    effective, permitted, *rest = struct.unpack("6I", sets.raw)
    override = (1 << 1) | (1 << 2)  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
    if libc.capset(header, struct.pack("6I", effective & ~override, permitted & ~override, *rest)) != 0:
        raise OSError(ctypes.get_errno(), "capset")


def _listing(scratch: Path, own: Path) -> set[str]:
    """Files beside the case's folder, with their sizes."""
    return {
        f"{path.relative_to(scratch)}:{path.stat().st_size}"
        for root in (scratch,)
        for path in root.glob("*/*")
        if own not in path.parents and path.is_file()
    }


def _remove(folder: Path) -> None:
    for path in (folder, *folder.rglob("*")):
        if path.is_dir() and not path.is_symlink():
            path.chmod(0o777)
    shutil.rmtree(folder, ignore_errors=True)
