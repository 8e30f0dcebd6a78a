"""Tasks in this process, in several, by submitit and in Ray: failures stay with their task, kills are repeated."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import pytest
from tests.tasks.tasks import Part, tries_of, work

from swimm3r.errors import DeviceError, InputError, UsageError
from swimm3r.tasks import EngineSettings, Failure, run_tasks
from swimm3r.tasks.outcome import TaskError
from swimm3r.tasks.settings import EngineName
from swimm3r.tasks.threads import core_count, thread_count

ROOT = Path(__file__).parents[2]
NAMES = ("first", "refused", "killed-once", "faulty", "killed", "last")
without_submitit = pytest.mark.skipif(find_spec("submitit") is None, reason="submitit is not installed")
without_ray = pytest.mark.skipif(find_spec("ray") is None, reason="ray is not installed")


def parts(folder: Path, names: tuple[str, ...] = NAMES) -> list[Part]:
    return [Part(name, folder) for name in names]


def check_failures(folder: Path, failures: tuple[Failure, ...]) -> None:
    """The same ends whichever engine made them."""
    assert [(failure.name, type(failure.error)) for failure in failures] == [
        ("refused", InputError),
        ("faulty", TaskError),
        ("killed", DeviceError),
    ]
    assert failures[0].message == "no frames in it"
    assert failures[0].error.hint == "another one"
    assert "division of a fish by zero" in failures[1].message
    assert sorted(path.stem for path in folder.glob("*.done")) == ["first", "killed-once", "last"]
    assert [tries_of(part) for part in parts(folder)] == [1, 1, 2, 2, 2, 1]  # what the user must mend is not repeated


def test_one_job_runs_in_this_process_and_goes_on_after_failures(tmp_path: Path):
    told: list[tuple[str, int, int]] = []
    ends: list[str] = []
    failures = run_tasks(
        work,
        parts(tmp_path, ("first", "refused", "faulty", "last")),
        EngineSettings(retries=2),
        lambda *what: told.append(what),
        "pieces",
        on_end=lambda name, failure: ends.append(f"{name} {failure is None}"),
    )
    assert [failure.name for failure in failures] == ["refused", "faulty"]
    assert (tmp_path / "first.done").read_text().split()[0] == str(os.getpid())
    assert told == [("pieces", done, 4) for done in range(5)]
    assert ends == ["first True", "refused False", "last True", "faulty False"]
    assert tries_of(Part("faulty", tmp_path)) == 3


def test_child_processes_share_the_cores_and_a_killed_one_is_repeated_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    logs = tmp_path / "logs"
    failures = run_tasks(work, parts(tmp_path), EngineSettings(jobs=2), logs=logs)
    check_failures(tmp_path, failures)
    process, threads = (tmp_path / "first.done").read_text().split()
    assert process != str(os.getpid())
    assert int(threads) == max(1, core_count() // 2)
    assert "ZeroDivisionError" in (logs / "faulty.log").read_text()
    assert failures[1].log == logs / "faulty.log"
    assert (logs / "killed-once.log").read_text().count("working on") >= 1


def test_isolated_tasks_have_a_process_each(tmp_path: Path):
    assert run_tasks(work, parts(tmp_path, ("a", "b", "c")), isolated=True) == ()
    processes = {path.read_text().split()[0] for path in tmp_path.glob("*.done")}
    assert len(processes) == 3
    assert str(os.getpid()) not in processes


def test_the_share_of_the_threads_is_known(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert thread_count() == 3
    monkeypatch.setenv("OMP_NUM_THREADS", "many")
    assert thread_count() == core_count()
    assert EngineSettings(jobs=4).threads_of_each(16, 100) == 4
    assert EngineSettings(jobs=4).threads_of_each(16, 2) == 8
    assert EngineSettings(jobs=64).threads_of_each(16, 100) == 1
    assert EngineSettings(engine="slurm").threads_of_each(2, 100) == 8
    assert EngineSettings(engine="ray", cpus=3).threads_of_each(2, 100) == 3


def running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return "Z" not in Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1][:3]


@pytest.fixture
def waiting(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[tuple[subprocess.Popen, list[int]]]:
    """A process with two processes at work for it, by an engine of that name, and their numbers."""
    code = (
        "from pathlib import Path; from swimm3r.tasks import *; from tests.tasks.tasks import *\n"
        f"folder = Path({str(tmp_path)!r})\n"
        f"engine = EngineSettings(engine={request.param!r}, cluster='local', jobs=2, cpus=1)\n"
        "run_tasks(wait_long, [Part(name, folder) for name in 'ab'], engine, logs=folder / 'logs')"
    )
    paths = os.pathsep.join([str(ROOT), str(ROOT / "src")])
    parent = subprocess.Popen(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": paths},
        stderr=subprocess.PIPE,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a suite in the background ignores it
    )
    wait_for(lambda: sum(path.read_text() != "" for path in tmp_path.glob("*.pid")) == 2)
    yield parent, [int(path.read_text()) for path in tmp_path.glob("*.pid")]
    with suppress(ProcessLookupError):
        os.killpg(parent.pid, signal.SIGKILL)
    parent.communicate()


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
@pytest.mark.parametrize(
    ("waiting", "sign"),
    [
        pytest.param("local", signal.SIGINT, id="local-interrupted"),
        pytest.param("local", signal.SIGKILL, id="local-killed"),
        pytest.param("slurm", signal.SIGINT, id="slurm-interrupted", marks=without_submitit),
        pytest.param("ray", signal.SIGINT, id="ray-interrupted", marks=without_ray),
    ],
    indirect=["waiting"],
)
def test_nothing_goes_on_after_its_parent(waiting: tuple[subprocess.Popen, list[int]], sign: int):
    parent, children = waiting
    assert all(map(running, children))
    parent.send_signal(sign)
    parent.wait(30)
    wait_for(lambda: not any(map(running, children)))
    if sign == signal.SIGINT:
        assert b"KeyboardInterrupt" in parent.stderr.read()


@without_submitit
def test_submitit_runs_the_same_tasks_in_processes_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("submitit.Job._results_timeout_s", 0.5)  # the wait for a slow disk after a kill
    engine = EngineSettings(engine="slurm", cluster="local", jobs=2, cpus=1)
    logs = tmp_path / "logs"
    check_failures(tmp_path, run_tasks(work, parts(tmp_path), engine, logs=logs))
    process, threads = (tmp_path / "first.done").read_text().split()
    assert process != str(os.getpid())
    assert threads == "1"
    assert list((logs / "submitit").glob("*_result.pkl"))
    assert "ZeroDivisionError" in (logs / "faulty.log").read_text()


SBATCH = """#!{python}
import os, re, subprocess, sys
text = open(sys.argv[-1]).read()
open({seen!r}, "w").write(text)
last = int(re.search(r"--array=0-(\\d+)", text)[1])
command = "\\n".join(line for line in text.splitlines() if line.startswith("export"))
command += "\\n" + next(line for line in text.splitlines() if line.startswith("srun"))
for task in range(last + 1):
    own = dict(SLURM_JOB_ID=f"{{77 + task}}", SLURM_ARRAY_JOB_ID="77", SLURM_ARRAY_TASK_ID=str(task), SLURM_NTASKS="1",
               SLURM_PROCID="0", SLURM_LOCALID="0", SLURM_NODEID="0", SLURM_JOB_NUM_NODES="1", SLURM_JOB_NODELIST="sea")
    subprocess.Popen(["sh", "-c", command], env=dict(os.environ, **own), stdout=-3, stderr=-3)
print("Submitted batch job 77")
"""
SRUN = '#!/bin/sh\nwhile [ "$1" != --error ]; do shift; done; shift 2; exec "$@"\n'


@without_submitit
def test_a_cluster_gets_one_array_of_jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Slurm's commands are stand-ins that run every job of the array here, at once."""
    programs, seen = tmp_path / "bin", tmp_path / "sent.sh"
    programs.mkdir()
    for name, text in (("sbatch", SBATCH.format(python=sys.executable, seen=str(seen))), ("srun", SRUN)):
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), str(ROOT / "src")]))
    engine = EngineSettings(engine="slurm", jobs=2, cpus=3, partition="sea", minutes=5, memory=4, gpus=1)
    failures = run_tasks(work, parts(tmp_path, ("first", "refused", "last")), engine, logs=tmp_path / "logs")
    assert [(failure.name, failure.message) for failure in failures] == [("refused", "no frames in it")]
    assert (tmp_path / "last.done").read_text().split()[1] == "3"
    sent = seen.read_text()
    for asked in ("array=0-2%2", "cpus-per-task=3", "partition=sea", "time=5", "mem=4GB", "gpus-per-node=1"):
        assert f"#SBATCH --{asked}\n" in sent


@pytest.mark.long
@without_ray
def test_ray_runs_the_same_tasks_in_processes_of_its_own(tmp_path: Path):
    engine = EngineSettings(engine="ray", jobs=2, cpus=1)
    logs = tmp_path / "logs"
    check_failures(tmp_path, run_tasks(work, parts(tmp_path), engine, logs=logs))
    process, threads = (tmp_path / "first.done").read_text().split()
    assert process != str(os.getpid())
    assert threads == "1"
    assert "ZeroDivisionError" in (logs / "faulty.log").read_text()


@pytest.mark.parametrize(("engine", "module"), [("slurm", "submitit"), ("ray", "ray")])
def test_a_missing_extra_is_named(engine: EngineName, module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UsageError, match="not installed") as refused:
        run_tasks(work, parts(tmp_path, ("a",)), EngineSettings(engine=engine), logs=tmp_path)
    assert f"swimm3r[{engine}]" in refused.value.hint


@without_submitit
def test_a_computer_without_slurm_says_so(tmp_path: Path):
    with pytest.raises(UsageError, match="no Slurm"):
        run_tasks(work, parts(tmp_path, ("a",)), EngineSettings(engine="slurm"), logs=tmp_path)


def test_two_tasks_of_one_name_are_our_mistake(tmp_path: Path):
    with pytest.raises(AssertionError, match="one name"):
        run_tasks(work, parts(tmp_path, ("a", "a")))
