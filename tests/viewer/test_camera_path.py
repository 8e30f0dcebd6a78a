"""Views and paths that are kept: what is written comes back, renders the same, and overwrites nothing."""

import errno
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
import torch
from tests.viewer.test_layers import frame_view

from swimm3r.errors import UsageError
from swimm3r.geometry import Similarity, so3_exp
from swimm3r.io import images
from swimm3r.pipeline.renders import render_run
from swimm3r.pipeline.view_settings import ViewSettings
from swimm3r.scene.rig import Rig, RigCamera
from swimm3r.viewer.camera_path import KeyFrame, film, load_path, new_folder, save_path, save_view
from swimm3r.viewer.layers import LayerChoice, Painter
from swimm3r.viewer.panel import Panel
from swimm3r.viewer.scene_nodes import path_rows
from swimm3r.viewer.viewed_run import ViewedRun


def path_of(run: ViewedRun) -> list[KeyFrame]:
    return [KeyFrame(frame_view(run, i), float(i)) for i in (1, 3, 5)]


def test_a_path_comes_back_with_its_times(copied: Callable[[], ViewedRun]):
    run = copied()
    loaded = load_path(run, save_path(run, path_of(run)) / "cameras.json")
    for kept, back in zip(path_of(run), loaded, strict=True):
        assert torch.allclose(kept.view.cam2world, back.view.cam2world, atol=1e-9)
        assert back.view.fov == pytest.approx(kept.view.fov, rel=1e-3)
        assert back.time == kept.time


def test_a_path_in_a_map_whose_cameras_moved_is_stored_in_the_axes_of_sfm(copied: Callable[[], ViewedRun]):
    run = copied()
    turn = Similarity(
        torch.tensor(1.5).double(), so3_exp(torch.tensor([0.2, 0.1, -0.3]).double()), torch.ones(3).double()
    )
    moved = replace(run, to_map=turn)
    folder = save_path(moved, path_of(run))
    back = load_path(moved, folder / "cameras.json")
    assert torch.allclose(back[1].view.cam2world, path_of(run)[1].view.cam2world, atol=1e-9)
    in_sfm = load_path(run, folder / "cameras.json")
    assert not torch.allclose(in_sfm[1].view.cam2world, path_of(run)[1].view.cam2world, atol=1e-2)


def test_a_saved_view_is_rendered_again_by_render(copied: Callable[[], ViewedRun]):
    run = copied()
    folder = save_view(Painter(run), frame_view(run), LayerChoice())
    shown = images.read_rgb(folder / "view.png")
    out = render_run(run.folder, ViewSettings(folder / "cameras.json"), run.folder / "again", map_device="cpu")
    (rendered,) = out.glob("*_rgb.png")
    assert np.abs(images.read_rgb(rendered).astype(int) - shown).max() <= 1


def test_folders_are_numbered_and_a_name_that_exists_is_refused(copied: Callable[[], ViewedRun]):
    run = copied()
    assert [save_path(run, path_of(run)).name for _ in range(2)] == ["path-1", "path-2"]
    mine = save_path(run, path_of(run), "reef")
    before = (mine / "cameras.json").read_bytes()
    with pytest.raises(UsageError, match="exists"):
        save_path(run, path_of(run)[:1], "reef")
    assert (mine / "cameras.json").read_bytes() == before


@pytest.mark.parametrize("name", ["../out", "/tmp/out", "a/b", "a\\b", "..", "C:x"])
def test_names_that_lead_elsewhere_are_refused(copied: Callable[[], ViewedRun], name: str):
    with pytest.raises(UsageError):
        new_folder(copied(), name, "view")


def test_a_video_has_the_length_that_was_asked_for(copied: Callable[[], ViewedRun]):
    run = copied()
    folder = film(run, path_of(run), seconds=0.6, long_side=64)
    with av.open(str(folder / "flythrough.mp4")) as file:
        frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    assert len(frames) == 9
    assert frames[0].shape == (48, 128, 3)  # with the water, and beside it without
    assert (folder / "cameras.json").is_file()


def test_a_video_needs_two_views(copied: Callable[[], ViewedRun]):
    run = copied()
    with pytest.raises(UsageError, match="at least 2"):
        film(run, path_of(run)[:1], 1.0)
    assert not (run.folder / "renders").exists()


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES, errno.ENOSPC])
def test_a_folder_that_cannot_be_written_is_said_on_the_page(number: int, tmp_path: Path):
    def save() -> str:
        raise OSError(number, "refused", str(tmp_path))

    page: Any = SimpleNamespace(_kept=SimpleNamespace(content=""))
    Panel._keep(page, save)
    assert "Not saved" in page._kept.content
    assert str(tmp_path) in page._kept.content


def test_the_line_through_the_cameras_of_a_rig_leads_through_one_of_them(wall: ViewedRun):
    assert path_rows(wall) == list(range(len(wall.rec.names)))
    sides = ("left", "right")
    listed = tuple(replace(frame, camera=sides[i % 2]) for i, frame in enumerate(wall.frames))
    rig = Rig((RigCamera("left"), RigCamera("right")))
    rows = path_rows(replace(wall, frames=replace(wall.frames, frames=listed, rig=rig)))
    own = {frame.name: frame.camera for frame in listed}
    assert {own[wall.rec.names[row]] for row in rows} == {"left"}
    assert rows == sorted(rows)
