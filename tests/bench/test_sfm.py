"""Structure from motion by method: perfect poses score full marks, failures fail, what is missing is said."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from swimm3r.bench import sfm as bench_sfm
from swimm3r.bench import tables
from swimm3r.bench.restoration import score_restoration
from swimm3r.bench.runs import original_pixels, sfm_label
from swimm3r.bench.settings import PEERS, SfmMethods
from swimm3r.bench.sfm import compare_sfm
from swimm3r.bench.sfm_methods import model_scores, reference_scores, settings_for
from swimm3r.cameras import project
from swimm3r.errors import InputError, RegistrationError
from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.underwater import URANKER, uciqe, uiqm
from swimm3r.io.images import read_rgb, write_rgb
from swimm3r.prepare import load_frames
from swimm3r.presets import PRESETS, RunSettings
from swimm3r.reconstruction import Matches, Reconstruction
from swimm3r.run import open_finished_sfm
from swimm3r.sfm.settings import ColmapModelSettings, ColmapSettings, Mast3rSettings


@pytest.fixture
def weightless(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SWIMM3R_WEIGHTS_DIR", str(tmp_path / "no weights"))
    monkeypatch.setenv("SWIMM3R_CACHE", str(tmp_path / "no cache"))


def with_matches(rec: Reconstruction, off: float) -> Reconstruction:
    """Every point seen in the first two frames, in the second `off` pixels beside its place, across the motion."""
    (a, _), (b, _) = (project(rec.cameras[k], rec.points.xyz[None]) for k in (0, 1))
    along = b[0] - a[0]
    across = torch.stack([-along[:, 1], along[:, 0]], -1) / along.norm(dim=-1, keepdim=True)
    count = len(a[0])
    first, second = torch.zeros(count, dtype=torch.int64), torch.ones(count, dtype=torch.int64)
    xy_b = (b[0] + off * across).float()
    return replace(rec, matches=Matches(first, second, a[0].float(), xy_b, torch.ones(count)))


def test_a_map_is_scored_in_pixels_of_the_original_pictures(run: Path):
    rec = open_finished_sfm(run).rec
    exact = model_scores(with_matches(rec, 0.0), 14, 1.0)
    assert exact["registered_pct"] == 50
    assert exact["epipolar_mean_px"] == pytest.approx(0, abs=1e-3)
    assert exact["inlier_1px_pct"] == 100
    assert exact["points"] == len(rec.points.xyz)
    off = with_matches(rec, 0.8)
    once, twice = model_scores(off, 7, 1.0), model_scores(off, 7, 2.0)
    assert isinstance(once["epipolar_mean_px"], float)
    assert twice["epipolar_mean_px"] == pytest.approx(2 * once["epipolar_mean_px"])
    assert isinstance(twice["inlier_1px_pct"], float)
    assert twice["inlier_1px_pct"] < 100


def test_frames_that_are_not_placed_fail_their_pairs(run: Path):
    sfm = open_finished_sfm(run)
    assert sfm.truth is not None
    names = sfm.frames.train.names
    assert reference_scores(sfm.rec, names, sfm.truth) == {
        "rra15": 100, "rta15": 100, "maa30": pytest.approx(100), "reference_pct": 100,
    }  # fmt: skip
    fewer = replace(sfm.rec, names=("someone else", *sfm.rec.names[1:]))
    assert reference_scores(fewer, names, sfm.truth)["rra15"] == pytest.approx(100 * 15 / 21)
    assert reference_scores(None, names, sfm.truth)["maa30"] == 0
    assert reference_scores(None, names, NotComputed("nobody knows"))["rra15"] == NotComputed("nobody knows")


@pytest.mark.usefixtures("weightless")
def test_each_method_has_its_settings_or_says_what_is_missing(tmp_path: Path):
    def chosen(method, given=SfmMethods(), mast3r=Mast3rSettings()):  # noqa: B008
        return settings_for(method, "reef", given, ColmapSettings(), mast3r)

    assert chosen("colmap-global").mapping.method == "global"
    assert chosen("colmap-incremental").mapping.method == "incremental"
    assert "weights 'mast3r'" in chosen("mast3r").reason
    assert "--imports" in chosen("vggt").reason
    (tmp_path / "gluemap" / "reef").mkdir(parents=True)
    found = chosen("gluemap", SfmMethods(imports=tmp_path))
    assert isinstance(found, ColmapModelSettings)
    assert found.model == tmp_path / "gluemap" / "reef"
    assert sfm_label(RunSettings(sfm=found), "COLMAP model") == "gluemap"
    weights = tmp_path / "base.pth"
    weights.touch()
    known = Mast3rSettings(weights=weights)
    assert chosen("mast3r", mast3r=known) == known
    assert "--adapters" in chosen("swimm3r", mast3r=known).reason
    assert "train-sfm DATA --recipe dark3r" in chosen("dark3r", SfmMethods(adapters=tmp_path), known).reason
    adapter = tmp_path / "dark3r" / "adapter.safetensors"
    adapter.parent.mkdir()
    adapter.touch()
    settings = chosen("dark3r", SfmMethods(adapters=tmp_path), known)
    assert settings == replace(known, adapter=adapter)
    assert sfm_label(RunSettings(sfm=settings), "swimm3r") == "dark3r"


@pytest.mark.usefixtures("weightless")
def test_every_method_is_a_row_and_none_is_skipped_in_silence(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    calls = []

    def run_pipeline(source, folder, settings, *, last_stage, progress):
        calls.append(settings.sfm.mapping.method)
        shutil.copytree(run, folder, dirs_exist_ok=True)
        if settings.sfm.mapping.method == "global":
            shutil.rmtree(folder / "sfm")
            raise RegistrationError("only 2 of 7 frames", cause="", hint="")
        (folder / "summary.json").write_text('{"stages": {"sfm": {"cpu_seconds": 3.5}}}')

    monkeypatch.setattr(bench_sfm, "run_pipeline", run_pipeline)
    clip = run.parent / "dive"
    table = compare_sfm([clip], tmp_path, SfmMethods(), PRESETS["fast"], Mast3rSettings())
    assert [c.method for c in table.cells] == list(PEERS)
    placed, lost, *others = table.cells
    assert placed.scores["registered_pct"] == 100
    assert placed.scores["maa30"] == pytest.approx(100)
    assert placed.scores["sfm_cpu_seconds"] == 3.5
    assert (lost.scores["registered_pct"], lost.scores["rra15"], lost.scores["points"]) == (0, 0, 0)
    assert all(c.not_run and not c.scores for c in others)
    assert [path.parent.parent.name for path in tmp_path.glob("dive/*/0/run")] == ["colmap-incremental"]
    assert "vggt: not run" in tables.markdown(table)
    assert read_rgb(tmp_path / "pictures" / "dive.png").shape[1] > 400
    assert compare_sfm([clip], tmp_path, SfmMethods(), PRESETS["fast"], Mast3rSettings()).cells == table.cells
    assert calls == ["incremental", "global"]


def test_two_clips_of_one_name_are_refused(run: Path, tmp_path: Path):
    with pytest.raises(InputError, match="one name"):
        compare_sfm([run.parent / "dive"] * 2, tmp_path, SfmMethods(), PRESETS["fast"], Mast3rSettings())


def test_original_pixels_are_those_of_the_clip(run: Path):
    frames = load_frames(run / "prepare")
    assert original_pixels(run.parent / "dive", frames) == 1
    assert original_pixels(run.parent / "dive", replace(frames, width=96)) == 2


def test_restored_frames_are_scored_beside_those_as_filmed(run: Path, tmp_path: Path):
    restored = tmp_path / "restored run"
    shutil.copytree(run, restored)
    sfm = open_finished_sfm(restored)
    brighter = [sfm.frames.train.image(k).sqrt() for k in (0, 1)]
    for name, picture in zip(sfm.rec.names, brighter, strict=False):
        write_rgb(restored / "sfm" / "restored" / f"{name}.png", picture.numpy())
    table = score_restoration([restored], tmp_path / "out")
    filmed, clear = table.cells
    assert (filmed.method, clear.method) == ("as filmed", "truth")
    assert clear.scores["uiqm_funie"] == pytest.approx(sum(uiqm(picture).uiqm for picture in brighter) / 2, rel=1e-5)
    assert clear.scores["uciqe_cielab"] == pytest.approx(sum(uciqe(picture) for picture in brighter) / 2, rel=1e-5)
    assert filmed.scores["uiqm_funie"] != clear.scores["uiqm_funie"]
    assert clear.scores["uranker"] == URANKER
    assert list((tmp_path / "out" / "pictures" / "dive").glob("*.png"))
    nothing = score_restoration([run], tmp_path / "none").cells[1]
    assert isinstance(nothing.scores["uiqm_funie"], NotComputed)
