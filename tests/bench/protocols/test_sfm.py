"""Structure from motion by method: perfect poses score full marks, failures fail, what is missing is said."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from swimm3r.bench import tables
from swimm3r.bench.protocols import sfm as bench_sfm
from swimm3r.bench.protocols.restoration import score_restoration
from swimm3r.bench.protocols.sfm import compare_sfm
from swimm3r.bench.runs import original_pixels, sfm_label
from swimm3r.bench.settings import PEERS, SfmMethod, SfmMethods
from swimm3r.bench.sfm_methods import Uncapped, model_scores, reference_scores, settings_for
from swimm3r.cameras import project
from swimm3r.errors import InputError, RegistrationError
from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.underwater import URANKER, uciqe, uiqm
from swimm3r.io.images import read_rgb, write_rgb, write_rgb_16
from swimm3r.medium import AttenuationCurve, Estimator, Medium, MediumFit
from swimm3r.pipeline.finished_sfm import open_finished_sfm
from swimm3r.pipeline.presets import PRESETS, RunSettings
from swimm3r.prepare import load_frames
from swimm3r.progress import silent
from swimm3r.scene.reconstruction import DepthMaps, Matches, Reconstruction
from swimm3r.scene.reconstruction_io import write_unfiltered_matches
from swimm3r.sfm.medium.dense_tracks import count_tracks, fuse_depth
from swimm3r.sfm.medium.settings import TrackSettings
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


def test_a_map_is_scored_in_pixels_of_the_original_images(run: Path):
    rec = open_finished_sfm(run).rec
    seen = with_matches(rec, 0.0)
    exact = model_scores(seen, Uncapped(seen.matches, 7), 14, 1.0)
    assert exact["registered_pct"] == 50
    assert exact["epipolar_mean_px"] == pytest.approx(0, abs=1e-3)
    assert exact["inlier_1px_pct"] == 100
    assert exact["points"] == len(rec.points.xyz)
    assert exact["dense_points"] == 7
    off = with_matches(rec, 0.8)
    once, twice = (model_scores(off, Uncapped(off.matches, 7), 7, pixels) for pixels in (1.0, 2.0))
    assert isinstance(once["epipolar_mean_px"], float)
    assert twice["epipolar_mean_px"] == pytest.approx(2 * once["epipolar_mean_px"])
    assert isinstance(twice["inlier_1px_pct"], float)
    assert twice["inlier_1px_pct"] < 100


def test_no_cap_and_no_filter_by_its_own_result_flatters_a_map(run: Path, tmp_path: Path):
    sfm = open_finished_sfm(run)
    shutil.copytree(run / "sfm", tmp_path / "sfm")
    handed = with_matches(sfm.rec, 5.0).matches
    write_unfiltered_matches(tmp_path / "sfm", handed)
    rec = replace(with_matches(sfm.rec, 0.0), points_found=1_010_000, depth=DepthMaps(tmp_path / "sfm" / "z_depth"))
    uncapped = Uncapped.of(tmp_path / "sfm", rec, sfm.frames, TrackSettings(max_tracks=10), silent)
    scores = model_scores(rec, uncapped, 7, 1.0)
    assert scores["points"] == 1_010_000
    assert isinstance(scores["inlier_1px_pct"], float)
    assert scores["inlier_1px_pct"] < 10  # of those it keeps, all
    assert isinstance(scores["epipolar_mean_px"], float)
    assert scores["epipolar_mean_px"] > 1
    assert isinstance(scores["dense_points"], float)
    assert scores["dense_points"] > 10 * len(fuse_depth(rec, sfm.frames, TrackSettings(max_tracks=100)).xyz)


def test_dense_points_are_those_of_the_fused_depth_maps(run: Path):
    sfm = open_finished_sfm(run)
    everything = TrackSettings(max_tracks=10_000_000)
    assert count_tracks(sfm.rec, sfm.frames, TrackSettings(max_tracks=10)) == len(
        fuse_depth(sfm.rec, sfm.frames, everything).xyz
    )


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
    def chosen(method: SfmMethod, given=SfmMethods(), mast3r=Mast3rSettings()) -> Any:  # noqa: B008
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

    def run_pipeline(source, folder, settings, *, redo, last_stage, progress):
        calls.append(settings.sfm.mapping.method)
        shutil.copytree(run, folder, dirs_exist_ok=True)
        if settings.sfm.mapping.method == "global":
            shutil.rmtree(folder / "sfm")
            raise RegistrationError("only 2 of 7 frames", cause="", hint="")
        return {"stages": {"sfm": {"cpu_seconds": 3.5}}}

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
    assert read_rgb(tmp_path / "images" / "dive.png").shape[1] > 400
    assert compare_sfm([clip], tmp_path, SfmMethods(), PRESETS["fast"], Mast3rSettings()).cells == table.cells
    assert calls == ["incremental", "global"]


def test_two_clips_of_one_name_are_refused(run: Path, tmp_path: Path):
    with pytest.raises(InputError, match="one name"):
        compare_sfm([run.parent / "dive"] * 2, tmp_path, SfmMethods(), PRESETS["fast"], Mast3rSettings())


def test_original_pixels_are_those_of_the_clip(run: Path):
    frames = load_frames(run / "prepare")
    assert original_pixels(run.parent / "dive", frames) == 1
    assert original_pixels(run.parent / "dive", replace(frames, width=96)) == 2


def water(estimator: Estimator) -> MediumFit:
    """Some water of that origin."""
    one = torch.ones(3)
    medium, known = Medium(0.3 * one, 0.4 * one, 0.2 * one), torch.ones(3, dtype=torch.bool)
    curve = AttenuationCurve(0.4 * one, 0 * one, 0 * one, 0 * one)
    flags: dict[str, torch.Tensor] = {name: known for name in ("Binf", "beta_D", "beta_B")}
    return MediumFit(
        **vars(medium),
        curve=curve,
        std=medium,
        identifiable=flags,
        z_range=(0.5, 4.0),
        encoding="srgb",
        estimator=estimator,
    )


def with_water(run: Path, folder: Path, estimator: Estimator = "Sea-Thru") -> Path:
    """A copy of the run whose water that estimator found."""
    shutil.copytree(run, folder)
    sfm = open_finished_sfm(folder)
    rec = replace(sfm.rec, medium=water(estimator), depth=DepthMaps(folder / "sfm" / "z_depth"))
    rec.save(folder / "sfm", sfm.frames)
    return folder


def test_a_row_says_which_algorithm_restored_it_or_that_none_did(run: Path, tmp_path: Path):
    runs = [with_water(run, tmp_path / "learned", "physics head"), with_water(run, tmp_path / "fitted"), run]
    _, learned, _, fitted, _, dry = score_restoration(runs, tmp_path / "out").cells
    assert learned.method.endswith("(learned) + physics head")
    assert fitted.method.endswith("(fitted) + Sea-Thru")
    assert (dry.not_run, dry.scores) == ("its water was not estimated", {})


def test_restored_frames_are_scored_in_physical_colors_beside_the_shown_ones_and_those_as_filmed(
    run: Path, tmp_path: Path
):
    restored = with_water(run, tmp_path / "restored run")
    sfm = open_finished_sfm(restored)
    physical = [sfm.frames.train.image(k).sqrt() for k in (0, 1)]
    balanced = [image * torch.tensor([1.0, 0.8, 0.7]) for image in physical]
    for name, clear, shown in zip(sfm.rec.names, physical, balanced, strict=False):
        write_rgb_16(restored / "sfm" / "restored_physical" / f"{name}.png", clear.numpy())
        write_rgb(restored / "sfm" / "restored" / f"{name}.png", shown.numpy())
    table = score_restoration([restored], tmp_path / "out")
    assert [cell.method for cell in table.cells] == [
        "as filmed",
        "truth + Sea-Thru",
        "truth + Sea-Thru, white-balanced",
    ]
    for cell, images in zip(table.cells[1:], (physical, balanced), strict=True):
        assert cell.scores["uiqm_funie"] == pytest.approx(sum(uiqm(image).uiqm for image in images) / 2, rel=1e-3)
        assert cell.scores["uciqe_cielab"] == pytest.approx(sum(uciqe(image) for image in images) / 2, rel=1e-3)
        assert cell.scores["uranker"] == URANKER
        assert cell.scores["scored_pct"] == pytest.approx(100 * 2 / 7)  # five were not restored
    assert table.cells[0].scores["scored_pct"] == 100
    assert len({f"{cell.scores['uciqe_cielab']:.2f}" for cell in table.cells}) == 3
    assert list((tmp_path / "out" / "images" / "dive").glob("*.png"))
    nothing = score_restoration([with_water(run, tmp_path / "unrestored")], tmp_path / "none").cells[1]
    assert isinstance(nothing.scores["uiqm_funie"], NotComputed)
