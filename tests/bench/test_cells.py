"""Cells are kept, found again by what they depend on, and say why they are empty; scenes run side by side."""

from functools import partial
from pathlib import Path

import pytest

from swimm3r.bench import cells
from swimm3r.bench.cells import Result, ResultKey, Scores, kept_cell, over_scenes
from swimm3r.errors import InputError, UsageError, WeightsError
from swimm3r.evaluate import NotComputed
from swimm3r.progress import Progress
from swimm3r.tasks import EngineSettings

PLACE = ResultKey("reef", "colmap / + SGG", 2)


def test_a_cell_is_computed_once_for_what_it_depends_on(tmp_path: Path):
    made = []

    def make(folder: Path) -> Scores:
        made.append(folder)
        return {"psnr": 20.0 + len(made), "lpips_vgg": NotComputed("no weights"), "fps": float("inf")}

    first = kept_cell(tmp_path, PLACE, ["a", Path("b")], make)
    assert first.scores["psnr"] == 21.0
    assert first.scores["lpips_vgg"] == NotComputed("no weights")
    assert isinstance(first.scores["fps"], NotComputed)
    assert kept_cell(tmp_path, PLACE, ["a", Path("b")], make) == first
    assert kept_cell(tmp_path, PLACE, ["a", Path("c")], make).scores["psnr"] == 22.0
    assert made == [tmp_path / "reef" / "colmap" / "plus-SGG" / "2"] * 2


def test_scores_are_taken_anew_where_only_they_are_decided_by_something_else(tmp_path: Path):
    folder = PLACE.folder(tmp_path)

    def make(folder: Path) -> Scores:
        (folder / "map.safetensors").touch()
        return {"psnr": 1.0, "lpips_vgg": NotComputed("no weights")}

    def again(folder: Path) -> Scores:
        assert (folder / "map.safetensors").is_file()
        return {"psnr": 1.0, "lpips_vgg": 0.2}

    kept_cell(tmp_path, PLACE, "settings", make, [None])
    assert kept_cell(tmp_path, PLACE, "settings", again, ["digest of the weights"]).scores["lpips_vgg"] == 0.2
    assert not (folder / "old").exists()


def test_what_was_made_from_something_else_is_set_aside_and_not_taken(tmp_path: Path):
    folder = PLACE.folder(tmp_path)

    def make(folder: Path) -> Scores:
        assert not (folder / "map.safetensors").exists()
        (folder / "map.safetensors").touch()
        return {"psnr": 1.0}

    def cut_short(folder: Path) -> Scores:
        (folder / "checkpoint").touch()
        raise InputError("stopped", cause="", hint="")

    def goes_on(folder: Path) -> Scores:
        assert (folder / "checkpoint").is_file()
        return {"psnr": 2.0}

    for settings in ("first", "second", "first"):
        kept_cell(tmp_path, PLACE, settings, make)
    assert len(list(folder.glob("old/*/map.safetensors"))) == 2
    with pytest.raises(InputError):
        kept_cell(tmp_path, PLACE, "third", cut_short)
    assert kept_cell(tmp_path, PLACE, "third", goes_on).scores == {"psnr": 2.0}
    assert len(list(folder.glob("old/*/scores.json"))) == 3


def test_other_code_makes_other_cells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cells, "code_version", lambda: "before")
    assert kept_cell(tmp_path, PLACE, 1, lambda _: {"psnr": 1.0}).scores == {"psnr": 1.0}
    monkeypatch.setattr(cells, "code_version", lambda: "after")
    assert kept_cell(tmp_path, PLACE, 1, lambda _: {"psnr": 2.0}).scores == {"psnr": 2.0}


def test_a_damaged_record_of_a_cell_is_made_anew(tmp_path: Path):
    kept_cell(tmp_path, PLACE, 1, lambda _: {"psnr": 1.0})
    for text in ("{", "[]", "[" * 100_000):
        (PLACE.folder(tmp_path) / "scores.json").write_text(text)
        assert kept_cell(tmp_path, PLACE, 1, lambda _: {"psnr": 2.0}).scores == {"psnr": 2.0}


def test_a_method_without_its_weights_is_not_run_and_tried_again(tmp_path: Path):
    def refuse(folder: Path) -> Scores:
        raise WeightsError("the weights 'mast3r' are not on this computer", cause="", hint="")

    cell = kept_cell(tmp_path, PLACE, 1, refuse)
    assert cell == Result("reef", PLACE.method, 2, {}, "the weights 'mast3r' are not on this computer")
    assert kept_cell(tmp_path, PLACE, 1, lambda _: {"psnr": 1.0}).scores == {"psnr": 1.0}


def names_lead_out(scene: str, /, *, out: Path, progress: Progress) -> list[Result]:
    (out / scene).touch()
    if scene == "b":
        raise InputError("b is damaged", cause="why", hint="try")
    return [Result(scene, "m", 0, {"x": float(ord(scene)), "y": NotComputed("no weights")})]


@pytest.mark.parametrize("jobs", [1, 2])
def test_scenes_keep_their_order_and_one_error_waits_for_the_others(tmp_path: Path, jobs: int):
    work = partial(names_lead_out, out=tmp_path)
    found = over_scenes(["c", "a"], work, tmp_path, EngineSettings(jobs=jobs))
    assert [c.scene for c in found] == ["c", "a"]
    assert found[0].scores == {"x": 99.0, "y": NotComputed("no weights")}
    with pytest.raises(InputError, match="b is damaged") as raised:
        over_scenes(["b", "d"], work, tmp_path, EngineSettings(jobs=jobs))
    assert (raised.value.cause, raised.value.hint) == ("why", "try")
    assert (tmp_path / "d").exists()


def test_no_scenes_are_said_plainly(tmp_path: Path):
    with pytest.raises(UsageError, match="nothing to measure"):
        over_scenes([], names_lead_out, tmp_path, EngineSettings())


def test_names_of_scenes_stay_below_the_folder(tmp_path: Path):
    assert ResultKey("../../etc", "a/b").folder(tmp_path).is_relative_to(tmp_path)
    assert ".." not in ResultKey("../../etc", "..").folder(tmp_path).parts
