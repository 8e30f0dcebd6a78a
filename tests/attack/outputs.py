"""Output paths, two processes at once, little memory, a full disk, and the other commands."""

import json
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from tests.attack.harness import SMALL, Case, Fixture

REFUSED = (2, 3, 7)


def cases(fixture: Fixture) -> Iterator[Case]:
    """Every kind of `--out`, for every command that writes."""
    run, dive = str(fixture.run), str(fixture.dive)
    frame = next((fixture.run / "prepare").rglob("*.png"), None) or next((fixture.run / "prepare").rglob("*.jpg"))
    writers = {
        "run": ("run", dive, "--out", "{}", *SMALL),
        "prepare": ("prepare", dive, "--out", "{}"),
        "render": ("render", "copy", "--long-side", "40", "--out", "{}"),
        "localize": ("localize", "copy", str(frame), "--out", "{}"),
        "export": ("export", "copy", "--out", "{}"),
        "bench": ("bench", "restoration", "copy", "--out", "{}"),
        "demo": ("demo", "--frames", "3", "--width", "32", "--height", "24", "--out", "{}"),
    }
    paths: dict[str, tuple[str, Callable[[Path], object]]] = {
        "is-a-file": ("f", lambda d: (d / "f").write_text("mine")),
        "below-a-file": ("f/run", lambda d: (d / "f").write_text("mine")),
        "dangling": ("l", lambda d: (d / "l").symlink_to("nowhere/at/all")),
        "self-link": ("l", lambda d: (d / "l").symlink_to("l")),
        "too-long": ("a" * 300, lambda d: None),
        "path-too-long": ("/".join(["a" * 200] * 30), lambda d: None),
        "empty": ("", lambda d: None),
        "proc": ("/proc/swimm3r", lambda d: None),
        "null-device": ("/dev/null", lambda d: None),
        "other-things": ("mine", lambda d: ((d / "mine").mkdir(), (d / "mine" / "thesis.tex").write_text("x"))),
        "read-only": ("ro/run", lambda d: ((d / "ro").mkdir(), (d / "ro").chmod(0o555))),
    }
    for name, (path, make) in paths.items():
        for command, arguments in writers.items():
            legal = name == "other-things" and command in ("render", "localize", "bench")
            legal |= name == "dangling" and command == "export"
            codes = (0, *REFUSED) if legal else REFUSED
            yield Case(
                f"{name}-{command}",
                tuple(word.format(path) for word in arguments),
                codes,
                partial(_with_copy, fixture, make, "copy" in arguments),
                as_nobody=name == "read-only",
            )
    yield from _inside(fixture, dive)
    yield from _limits(fixture, dive)
    yield from _others(fixture, run)


def _with_copy(fixture: Fixture, make: Callable[[Path], object], needs_run: bool, folder: Path) -> None:
    if needs_run:
        shutil.copytree(fixture.run, folder / "copy")
        for path in (folder / "copy").rglob("*"):
            path.chmod(0o777)
        (folder / "copy").chmod(0o777)
    make(folder)


def _inside(fixture: Fixture, dive: str) -> Iterator[Case]:
    """Things in a run folder that are in the way."""

    def blocked(name: str, folder: Path) -> None:
        shutil.copytree(fixture.run, folder / "run")
        path = folder / "run" / name
        path.unlink(missing_ok=True)
        path.mkdir()

    for name in ("settings.yaml", "versions.json", "summary.json", "log.jsonl", "report.html"):
        arguments = ("run", dive, "--out", "run", *SMALL)
        yield Case(f"{name}-is-folder", arguments, (0, *REFUSED), partial(blocked, name))

    def dive_exists(folder: Path) -> None:
        (folder / "run-dive").mkdir()
        (folder / "run-dive" / "thesis.tex").write_text("x")

    yield Case(
        "demo-dive-exists",
        ("demo", "--frames", "3", "--width", "32", "--height", "24", "--out", "run"),
        (2, 3),
        dive_exists,
    )
    yield Case(
        "is-the-input",
        ("prepare", "p", "--out", "p"),
        REFUSED,
        lambda d: shutil.copytree(fixture.dive / "images", d / "p"),
    )


def _limits(fixture: Fixture, dive: str) -> Iterator[Case]:
    arguments = ("run", dive, "--out", "out", *SMALL)
    for megabytes in (0, 100, 300, 1000):
        yield Case(f"memory-{megabytes}M-more", arguments, (0, 5), memory=megabytes << 20, seconds=600)

    def held(folder: Path) -> None:
        """Another process works on the folder while the case runs."""
        script = (
            "import sys, time; from pathlib import Path\n"
            "from swimm3r.cli.main import main\n"
            f"main(['run', {dive!r}, '--out', 'out', *{list(SMALL)!r}])"
        )
        subprocess.Popen(["python", "-c", script], cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for _ in range(600):
            if (folder / "out" / "summary.json").exists():
                return
            time.sleep(0.1)

    yield Case("two-at-once", arguments, (2, 3, 7), held, seconds=120)


def _others(fixture: Fixture, run: str) -> Iterator[Case]:
    """Benchmarks, data sets, weights, and words that are no command."""
    copied = partial(_with_copy, fixture, lambda d: None, True)
    for protocol in ("ablation-uwbs", "render"):
        for seeds in ("0", "-1", "x", "1e9"):
            yield Case(
                f"bench-{protocol}-seeds={seeds}",
                ("bench", protocol, "copy", "--out", "out", "--seeds", seeds),
                (2, 3),
                copied,
                seconds=60,
            )
    yield Case(
        "bench-against-absent",
        ("bench", "render", "copy", "--out", "out", "--recipes", "ubs", "--against", "uwbs-static"),
        (2, 3),
        copied,
        seconds=60,
    )
    yield Case("datasets-unreadable", ("datasets", "in"), (0, 3), _private, as_nobody=True)
    yield Case("datasets-absent", ("datasets", "none"), (3,))
    yield Case("weights-list", ("weights", "list"), (0,))
    for name, text in {"deep": "[" * 100_000, "garbage": "x" * 50, "list": "[]"}.items():
        write = partial(_safetensors, text)
        sfm = ("sfm", str(fixture.dive), "--out", "out", "--backend", "mast3r", "--weights", "w.safetensors")
        yield Case(f"weights-config-{name}", sfm, (3, 4), write)
    for name, arguments in {
        "none": (),
        "unknown": ("dance",),
        "help": ("--help",),
        "empty": ("",),
        "run-nothing": ("run",),
        "double": ("run", "run"),
        "report-nosuch": ("report", "nosuch"),
        "option-unknown": ("run", "x", "--out", "y", "--nope", "1"),
    }.items():
        yield Case(f"words-{name}", arguments, (0,) if name in ("help",) else (0, 2) if name == "none" else (2, 3))


def _private(folder: Path) -> None:
    (folder / "in").mkdir()
    (folder / "in").chmod(0)


def _safetensors(config: str, folder: Path) -> None:
    header = json.dumps({"__metadata__": {"config": config, "model": config}}).encode()
    (folder / "w.safetensors").write_bytes(len(header).to_bytes(8, "little") + header)
