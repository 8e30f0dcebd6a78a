"""Damaged run folders: every file of a finished run, damaged in every way, read by every command that reads it."""

import json
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from tests.attack import damage
from tests.attack.harness import SMALL, Case, Fixture

COMMANDS: dict[str, tuple[str, ...]] = {
    "report": ("report", "run"),
    "render": ("render", "run", "--long-side", "40"),
    "eval": ("eval", "run", "--steps", "1"),
    "export": ("export", "run"),
    "localize": ("localize", "run", "run/prepare/{frame}"),
    "resume": ("run", "{dive}", "--out", "run", *SMALL),
    "bench": ("bench", "restoration", "run", "--out", "bench"),
}
READ = (3,)  # damage that must be named
MAYBE = (0, 3)  # damage that a command may not meet, or may repair
IN_THE_WAY = (0, 2, 3)  # a folder where a file is to be written

READERS = {  # file -> commands that read it
    "summary.json": ("report", "eval", "resume", "bench"),
    "settings.yaml": ("report", "eval", "resume"),
    "versions.json": ("report",),
    "prepare/frames.json": ("report", "render", "eval", "localize", "resume"),
    "sfm/cameras.json": ("render",),
    "sfm/medium.json": ("report", "eval", "render"),
    "sfm/reconstruction.json": ("report", "render", "eval"),
    "sfm/matches.npz": ("report", "render", "eval", "resume"),
    "sfm/points_physical.ply": ("report", "render"),
    "sfm/white_balance.json": ("report", "render", "eval"),
    "sfm/sparse/images.bin": ("report", "render"),
    "sfm/sparse/cameras.bin": ("report", "render"),
    "sfm/sparse/points3D.bin": ("report", "render"),
    "splat/map.safetensors": ("render", "export", "eval", "localize", "resume"),
    "splat/metrics.jsonl": ("resume", "report"),
    "log.jsonl": ("report",),
    "renders/flythrough.mp4": ("report",),
}


def cases(fixture: Fixture) -> Iterator[Case]:
    """Every file, kind of damage and command."""
    frame = json.loads((fixture.run / "prepare" / "frames.json").read_text())["frames"][0]["name"]
    depth = next((fixture.run / "sfm" / "z_depth").rglob("*.npz")).relative_to(fixture.run).as_posix()

    def case(name: str, command: str, codes: tuple[int, ...], change: Callable[[Path], None]) -> Case:
        arguments = tuple(word.format(dive=fixture.dive, frame=frame) for word in COMMANDS[command])
        return Case(f"{name}-{command}", arguments, codes, partial(_copied, fixture.run, change))

    for path, commands in {**READERS, depth: ("report", "eval")}.items():
        kinds = damage.ANY | (damage.JSON_KINDS if path.endswith(".json") else {})
        for kind, change in kinds.items():
            for command in commands:
                codes = IN_THE_WAY if kind == "folder" else MAYBE
                yield case(f"{Path(path).name}-{kind}", command, codes, partial(_at, path, change))
    for name, (path, change, commands) in _edits(depth).items():
        for command in commands:
            yield case(name, command, MAYBE, partial(_at, path, damage.edited(change)))
    for name, (path, change, commands) in _arrays(depth).items():
        for command in commands:
            yield case(name, command, MAYBE, partial(_at, path, change))
    for command in ("render", "export", "eval", "localize"):
        yield case("no-map", command, READ, lambda run: shutil.rmtree(run / "splat"))
    for name, change in _half_made().items():
        yield Case(
            f"sfm-halfway-{name}",
            ("sfm", str(fixture.dive), "--out", "run", "--preset", "fast"),
            MAYBE,
            partial(_copied_halfway, fixture.run, change),
        )
    yield from _without_run(frame)


def _without_run(frame: str) -> Iterator[Case]:
    """Every command on a folder that is none, empty, or a file."""
    for name, words in {"no-folder": "none", "empty-folder": "nothing", "a-file": "file"}.items():
        for command, arguments in COMMANDS.items():
            if command == "resume":
                continue
            yield Case(
                f"{name}-{command}",
                tuple(words if word == "run" else word.format(dive="", frame=frame) for word in arguments),
                (2, 3),
                _odd_folders,
            )


def _copied(run: Path, change: Callable[[Path], None], folder: Path) -> None:
    shutil.copytree(run, folder / "run")
    change(folder / "run")


def _at(path: str, change: damage.Damage, run: Path) -> None:
    if (run / path).exists():
        change(run / path)


def _odd_folders(folder: Path) -> None:
    (folder / "nothing").mkdir()
    (folder / "file").write_text("not a folder")


def _copied_halfway(run: Path, change: Callable[[Path], None], folder: Path) -> None:
    """A run whose structure from motion was cut short, with leftovers."""
    shutil.copytree(run, folder / "run")
    summary = json.loads((folder / "run" / "summary.json").read_text())
    summary["stages"] = {k: v for k, v in summary["stages"].items() if k == "prepare"}
    (folder / "run" / "summary.json").write_text(json.dumps(summary))
    shutil.rmtree(folder / "run" / "splat")
    change(folder / "run" / "sfm")


def _half_made() -> dict[str, Callable[[Path], None]]:
    def left(name: str, content: bytes) -> Callable[[Path], None]:
        def write(sfm: Path) -> None:
            (sfm / name).write_bytes(content)

        return write

    made = {}
    for name in ("database.db", "database.json", "made_from.json"):
        for kind, content in {
            "garbage": bytes(range(130, 250)) * 9,
            "empty": b"",
            "cut": b"SQLite format 3\0" * 3,
        }.items():
            made[f"{name}-{kind}"] = left(name, content)
    return made


def _edits(depth: str) -> dict[str, tuple[str, Callable, tuple[str, ...]]]:
    """Well-formed JSON with wrong content: name -> file, change, commands."""

    def put(*keys: str | int, value: object) -> Callable[[dict], None]:
        def change(document: dict) -> None:
            for key in keys[:-1]:
                document = document[key]
            document[keys[-1]] = value

        return change

    def every(document: dict, key: str, value: object) -> None:
        for frame in document["frames"]:
            frame[key] = value

    nan, all_of = float("nan"), ("report", "render", "eval", "localize")
    pose = [[nan] * 4] * 4
    return {
        "summary-stages-list": ("summary.json", put("stages", value=[]), ("eval", "resume", "bench", "report")),
        "summary-stages-none": ("summary.json", put("stages", value={}), ("eval", "resume", "bench", "report")),
        "summary-input-text": ("summary.json", put("input", value="x"), ("eval", "resume", "report")),
        "summary-test-missing": ("summary.json", put("test", value={}), ("report",)),
        "summary-truth-number": ("summary.json", put("truth", value=4), ("report",)),
        "versions-list": ("versions.json", lambda _: [1], ("report",)),
        "frames-none": ("prepare/frames.json", put("frames", value=[]), all_of),
        "frames-size-negative": ("prepare/frames.json", put("width", value=-5), all_of),
        "frames-size-text": ("prepare/frames.json", put("width", value="wide"), all_of),
        "frames-size-huge": ("prepare/frames.json", put("width", value=10**9), all_of),
        "frames-name-escapes": ("prepare/frames.json", put("frames", 0, "name", value="../../x.png"), all_of),
        "frames-name-number": ("prepare/frames.json", put("frames", 0, "name", value=7), all_of),
        "frames-time-nan": ("prepare/frames.json", put("frames", 0, "time", value=nan), all_of),
        "frames-split-odd": ("prepare/frames.json", lambda d: every(d, "split", "test"), all_of),
        "frames-split-unknown": ("prepare/frames.json", lambda d: every(d, "split", "x"), all_of),
        "cameras-nan": ("sfm/cameras.json", put("frames", 0, "c2w", value=pose), ("render",)),
        "cameras-singular": ("sfm/cameras.json", put("frames", 0, "c2w", value=[[0.0] * 4] * 4), ("render",)),
        "cameras-zero-size": ("sfm/cameras.json", put("width", value=0), ("render",)),
        "cameras-negative-focal": ("sfm/cameras.json", put("fx", value=-1), ("render",)),
        "medium-fit-number": ("sfm/medium.json", put("stored", value=3), ("report", "eval", "render")),
        "medium-empty-fit": ("sfm/medium.json", put("stored", value={}), ("report", "eval", "render")),
        "reconstruction-warnings": ("sfm/reconstruction.json", put("warnings", value=[{"x": 1}]), ("report", "render")),
        "reconstruction-metric-text": ("sfm/reconstruction.json", put("metric", value="yes"), ("report", "render")),
        "reconstruction-backend-number": ("sfm/reconstruction.json", put("backend", value=1), ("report", "render")),
    }


def _arrays(depth: str) -> dict[str, tuple[str, damage.Damage, tuple[str, ...]]]:
    def header(change: Callable[[dict], object]) -> damage.Damage:
        def edit(path: Path) -> None:
            data = path.read_bytes()
            size = int.from_bytes(data[:8], "little")
            document = json.loads(data[8 : 8 + size])
            document = change(document) or document
            text = json.dumps(document).encode()
            path.write_bytes(len(text).to_bytes(8, "little") + text + data[8 + size :])

        return edit

    def metadata(change: Callable[[dict], object]) -> damage.Damage:
        def edit(document: dict) -> None:
            for key, value in document["__metadata__"].items():
                try:
                    about = json.loads(value)
                except ValueError:
                    continue
                if isinstance(about, dict):
                    document["__metadata__"][key] = json.dumps(change(about) or about)

        return header(edit)

    def put(key: str, value: object) -> damage.Damage:
        return metadata(lambda about: about | {key: value})

    def nan_points(path: Path) -> None:
        data = path.read_bytes()
        end = data.index(b"end_header\n") + 11
        path.write_bytes(data[:end] + np.float32(np.nan).tobytes() + data[end + 4 :])

    maps = ("render", "export", "eval", "localize")
    map_file = "splat/map.safetensors"
    return {
        "matches-pickle": ("sfm/matches.npz", damage.pickled, ("report", "eval", "render")),
        "matches-nan": ("sfm/matches.npz", damage.npz(xy_i=lambda a: a * np.nan), ("report", "eval")),
        "matches-index": ("sfm/matches.npz", damage.npz(i=lambda a: a + 1000), ("report", "eval")),
        "matches-short": ("sfm/matches.npz", damage.npz(i=lambda a: a[:-1]), ("report", "eval")),
        "matches-none": ("sfm/matches.npz", damage.npz(confidence=None), ("report", "eval")),
        "depth-pickle": (depth, damage.pickled, ("report", "eval")),
        "depth-nan": (depth, damage.npz(z_depth=lambda a: a * np.nan), ("report", "eval")),
        "depth-shape": (depth, damage.npz(z_depth=lambda a: a[:4, :4]), ("report", "eval")),
        "depth-none": (depth, damage.npz(confidence=None), ("report", "eval")),
        "ply-nan": ("sfm/points_physical.ply", nan_points, ("report", "render")),
        "map-header-list": (map_file, header(lambda _: []), maps),
        "map-header-empty": (map_file, header(lambda document: document.pop("__metadata__", None) and None), maps),
        "map-about-list": (map_file, metadata(lambda _: []), maps),
        "map-length-nan": (map_file, put("length", float("nan")), maps),
        "map-length-text": (map_file, put("length", "long"), maps),
        "map-length-negative": (map_file, put("length", -1.0), maps),
        "map-no-metric": (map_file, metadata(lambda about: about.pop("metric", None) and None), maps),
        "map-span-odd": (map_file, put("span", [1.0]), maps),
        "map-span-text": (map_file, put("span", ["a", "b"]), maps),
        "map-settings-text": (map_file, put("settings", "none"), maps),
        "map-settings-types": (map_file, put("settings", {"iterations": "many", "render": 3}), maps),
        "map-frames-hostile": (map_file, put("frames", ["../../x", 3]), maps),
        "map-frames-no-poses": (map_file, put("frames", ["0000.png"]), maps),
        "map-recipe-unknown": (map_file, put("recipe", "evil"), maps),
        "map-schema-future": (map_file, put("schema", 99), maps),
    }
