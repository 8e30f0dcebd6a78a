"""The Python of the README, of First dive's loop and of the package's docstring is run as it is printed."""

import re
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
import torch
from tests.imaging.test_rectification import stretching_lens

import swimm3r
from swimm3r.imaging.rectification import rectification_of
from swimm3r.imaging.turned_rows import RowTurns
from swimm3r.io.images import read_rgb
from swimm3r.sfm.plane_sweep.settings import PlaneSweepSettings
from swimm3r.sfm.rectified.frames import BentImagesError, TurnedRowsError
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.settings import DensifySettings, InitialSettings, MediumFieldSettings, UwbsSettings

README = Path(__file__).parents[1] / "README.md"
FIRST_DIVE = README.parent / "docs" / "first-dive.md"


def snippets(document: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", document.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


@pytest.fixture
def beside_a_dive(tmp_path: Path, write_video: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with dive.mp4, ten frames of 240x160, where the fast preset's map is a tiny one."""
    swimm3r.write_dive(swimm3r.DiveSettings(frames=10, width=240, height=160), tmp_path / "dive")
    images = [read_rgb(path) for path in sorted((tmp_path / "dive" / "images").iterdir())]
    write_video(tmp_path / "dive.mp4", images, times=[i / 5 for i in range(len(images))])
    tiny = UwbsSettings(
        iterations=40,
        long_side=120,
        initial=InitialSettings(primitives=1500),
        densify=DensifySettings(cap_max=2000),
        medium=MediumFieldSettings(hidden=16),
    )
    coarse = replace(swimm3r.PRESETS["fast"].sfm, depth=PlaneSweepSettings(long_side=120, sources=2))
    monkeypatch.setitem(swimm3r.PRESETS, "fast", replace(swimm3r.PRESETS["fast"], sfm=coarse, splat=tiny))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_readmes_python_runs_as_printed(beside_a_dive: Path):
    (snippet,) = snippets(README)
    names: dict = {}
    exec(compile(snippet, str(README), "exec"), names)
    out, camera = names["out"], names["camera"]
    assert isinstance(camera, swimm3r.Cameras)
    assert out.rgb.shape == (camera.height, camera.width, 3) == (160, 240, 3)
    for part in re.findall(r"out\.(\w+)", snippet):
        assert getattr(out, part) is not None
    assert names["pose"].shape == (4, 4)
    assert torch.isfinite(names["pose"]).all()
    np.testing.assert_allclose(names["pose"][:3, :3] @ names["pose"][:3, :3].mT, np.eye(3), atol=1e-5)


def test_the_docstrings_python_runs_as_printed(beside_a_dive: Path):
    blocks = re.findall(r"^    .*(?:\n+    .*)*", swimm3r.__doc__ or "", re.MULTILINE)
    assert len(blocks) == 1
    names: dict = {"swimm3r": swimm3r}
    exec(compile(dedent(blocks[0]), "swimm3r.__doc__", "exec"), names)
    out, scene, rec = names["out"], names["scene"], names["rec"]
    again = swimm3r.load_map("dive.safetensors").render(rec.cameras[0].pinhole())
    assert torch.equal(again.rgb, out.rgb)
    assert not torch.equal(out.rgb, out.clear)
    assert torch.equal(swimm3r.load_cameras("cameras.json").cam2world, rec.cameras.cam2world)
    assert torch.isfinite(names["pose"]).all()
    for shown in (names["frames"], rec, rec.medium, scene, out):
        assert "<" in shown._repr_html_()


def test_the_loop_over_rectifications_runs_as_printed(beside_a_dive: Path, monkeypatch: pytest.MonkeyPatch):
    (snippet,) = (text for text in snippets(FIRST_DIVE) if "RectifiableError" in text)
    way, seen = rectification_of(stretching_lens(240, 160)), []

    def reconstruct(frames: swimm3r.Frames, *_: object, **__: object) -> str:
        seen.append((frames.width, frames.rows_rectified))
        if frames.width == 240:
            raise BentImagesError(way)
        if not frames.rows_rectified:
            raise TurnedRowsError(RowTurns(way.pinhole, {frames.names[1]: np.array([0.02, 0.0, 0.01])}))
        return "poses"

    monkeypatch.setattr(swimm3r, "reconstruct", reconstruct)
    for resumed in (False, True):
        seen.clear()
        names: dict = {}
        exec(compile(snippet, str(FIRST_DIVE), "exec"), names)
        assert seen == [(240, False), (way.pinhole.width, False)] * (not resumed) + [(way.pinhole.width, True)]
        assert names["rec"] == "poses"
        assert (names["frames"].width, names["frames"].rows_rectified) == seen[-1]


def test_every_public_name_loads():
    for name in swimm3r.__all__:
        assert getattr(swimm3r, name) is not None
    assert set(swimm3r.__all__) == set(swimm3r._HOME)


def test_a_camera_with_distortion_is_refused_with_what_to_do():
    K, pose = torch.tensor([[[9.0, 0, 4], [0, 9, 3], [0, 0, 1]]]), torch.eye(4)[None].double()
    lens = swimm3r.Cameras(K, torch.tensor([[0.1]]), pose, 8, 6, "SIMPLE_RADIAL")
    with pytest.raises(ValueError, match=r"camera\.drawn\(\)"):
        view_camera(lens)
    view_camera(lens.drawn())


def test_the_version_is_that_of_the_distribution():
    assert swimm3r.__version__ == version("swimm3r")
