"""Many images placed in a run's map: the record of each, and nothing of earlier calls or of memory beside it."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from swimm3r.bench.protocols.localization import localization_scores
from swimm3r.errors import InputError
from swimm3r.evaluate import NotComputed
from swimm3r.io.images import write_rgb
from swimm3r.localization import batch
from swimm3r.localization.batch import Answer, Query, answer, localize_run, with_match_image
from swimm3r.localization.localizer import STAGES, Evidence, Localization, Localizer


def found() -> Localization:
    seen = torch.zeros(8, 10, 3)
    evidence = Evidence(seen, seen, torch.ones(3, 2), torch.ones(3, 2), torch.ones(3).bool())
    return Localization(torch.eye(4).double(), "refined", (), 20, 3, 3, 0.5, evidence, dict.fromkeys(STAGES, 0.1))


class Exact(Localizer):
    """Places every image of 10 x 8 pixels."""

    matcher: Any = SimpleNamespace(name="SIFT")

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def locate(self, image: torch.Tensor, *_: Any, **__: Any) -> Localization:
        if image.shape[:2] != (8, 10):
            raise InputError("the image is of another shape", cause="cropped", hint="its own lens")
        return found()

    def in_axes_of_sfm(self, cam2world: torch.Tensor) -> torch.Tensor:
        return cam2world


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run whose map places every image of 10 x 8 pixels."""

    parts = {
        "open_run": None,
        "load_map": SimpleNamespace(to=lambda _: None),
        "run_frames": SimpleNamespace(test=SimpleNamespace(names=())),
        "load_reconstruction": SimpleNamespace(metric=False, still=lambda frames: frames),
        "has_several_lenses": False,
        "run_rectification": None,
    }
    for name, value in parts.items():
        monkeypatch.setattr(batch, name, lambda *_, value=value: value)
    monkeypatch.setattr(batch, "Localizer", Exact)
    return tmp_path


def image(path: Path, width: int = 10) -> Path:
    path.parent.mkdir(exist_ok=True)
    write_rgb(path, np.zeros((8, width, 3), np.uint8))
    return path


def test_answers_hold_no_images_and_each_has_its_match_image(run: Path):
    answers, out = localize_run(run, [image(run / f"{i}.png") for i in range(3)])
    assert all(a.found is not None and a.found.evidence is None for a in answers)
    assert sorted(path.name for path in (out / "matches").iterdir()) == ["0.png.png", "1.png.png", "2.png.png"]
    assert json.loads((out / "poses.json").read_text())["located"] == 3


def test_a_match_image_of_before_goes_where_an_image_is_not_placed_now(tmp_path: Path):
    placed = Answer("a.png", 0.0, found())
    with_match_image(placed, tmp_path)
    assert (tmp_path / "matches" / "a.png.png").is_file()
    lost = replace(placed, found=None, reason="lost")
    assert with_match_image(lost, tmp_path) == lost
    assert not (tmp_path / "matches" / "a.png.png").exists()


def test_an_image_of_another_shape_is_named(run: Path):
    with pytest.raises(InputError, match=r"wide\.png: the image is of another shape"):
        localize_run(run, [image(run / "a.png"), image(run / "wide.png", 20)])
    with pytest.raises(InputError, match="x: the image"):
        answer(Exact(), Query("x", 0.0, torch.zeros(8, 11, 3)))


def test_two_images_of_one_name_are_refused_before_the_map_is_read(run: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(batch, "load_map", lambda _: pytest.fail("the map is read"))
    with pytest.raises(InputError, match="the same name"):
        localize_run(run, [image(run / "a" / "x.png"), image(run / "b" / "x.png")])


def test_a_run_without_test_frames_asks_for_images(run: Path):
    with pytest.raises(InputError, match="no test frames"):
        localize_run(run)
    assert isinstance(localization_scores([])["located_pct"], NotComputed)
    assert isinstance(localization_scores([])["fps_localize"], NotComputed)
