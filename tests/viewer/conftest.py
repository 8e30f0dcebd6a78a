"""A small finished run of a flat wall, and the same run with structure from motion alone."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import pytest
import torch
from tests.splat.conftest import TinyDive, make_wall, tiny_dive  # noqa: F401 - the second is a fixture

from swimm3r.io.images import write_rgb
from swimm3r.pipeline.presets import PRESETS, to_yaml
from swimm3r.splat.rendering import SplatMap
from swimm3r.viewer.viewed_run import ViewedRun, open_viewed_run

DISTANCE = 3.0  # of the wall, metres


def flat_wall() -> SplatMap:
    """The wall of the map's tests, without its waves."""
    scene = make_wall(6000)
    p = scene.primitives
    xyz = torch.cat([p.xyz[:, :2], torch.full((len(p.xyz), 1), DISTANCE)], -1)
    flat = p.scale.clone()
    flat[:, 2] = -9.0  # thin
    return replace(scene, primitives=p._replace(xyz=xyz, scale=flat), span=(0.0, 8.0))


@pytest.fixture(scope="session")
def wall_run(tiny_dive: TinyDive, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: F811
    """A run folder; tests that write into it copy it first."""
    folder = tmp_path_factory.mktemp("viewer") / "wall"
    tiny_dive.frames.save(folder / "prepare")
    tiny_dive.rec.save(folder / "sfm", tiny_dive.frames)
    for name in tiny_dive.rec.names:
        write_rgb(folder / "sfm" / "restored" / f"{name}.png", torch.full((48, 64, 3), 0.5).numpy())
    scene = replace(flat_wall(), viewpoint=tiny_dive.cameras[4])
    scene.save(folder / "splat" / "map.safetensors")
    (folder / "settings.yaml").write_text(to_yaml(PRESETS["fast"]))
    (folder / "versions.json").write_text(json.dumps({"swimm3r": version("swimm3r")}))
    write_summary(folder, ("prepare", "sfm", "splat"))
    return folder


@pytest.fixture
def sfm_run(wall_run: Path, tmp_path: Path) -> Path:
    """The same, stopped before its map."""
    folder = tmp_path / "sfm-only"
    shutil.copytree(wall_run, folder, ignore=shutil.ignore_patterns("splat"))
    write_summary(folder, ("prepare", "sfm"))
    return folder


@pytest.fixture(scope="session")
def wall(wall_run: Path) -> ViewedRun:
    """The run as the viewer reads it."""
    return open_viewed_run(wall_run, "cpu")


@pytest.fixture
def copied(wall_run: Path, tmp_path: Path) -> Callable[[], ViewedRun]:
    """A copy of the run that may be written into."""

    def copy() -> ViewedRun:
        shutil.copytree(wall_run, tmp_path / "copy")
        return open_viewed_run(tmp_path / "copy", "cpu")

    return copy


def write_summary(folder: Path, stages: tuple[str, ...]) -> None:
    document = {
        "schema": 2,
        "input": {"path": str(folder), "fingerprint": "0"},
        "stages": {name: {"status": "done", "key": "0"} for name in stages},
    }
    (folder / "summary.json").write_text(json.dumps(document))
