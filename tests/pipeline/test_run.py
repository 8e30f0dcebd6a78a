"""The pipeline over a run folder, on a small synthetic dive: what it finds, what it reuses, what it survives."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
import torch

from swimm3r.errors import InputError, StorageError
from swimm3r.evaluate.poses import absolute_pose_errors
from swimm3r.evaluate.underwater import uciqe
from swimm3r.io import images
from swimm3r.io.depth import read_depth
from swimm3r.io.video import Video
from swimm3r.localization.batch import localize_run
from swimm3r.localization.settings import LocalizationSettings
from swimm3r.pipeline.presets import MAST3R_PRESETS, PRESETS, RunSettings, from_yaml, to_yaml
from swimm3r.pipeline.renders import KINDS, render_run
from swimm3r.pipeline.run import run_pipeline
from swimm3r.pipeline.scores.evaluation import evaluate_run
from swimm3r.pipeline.view_settings import ViewSettings
from swimm3r.prepare import load_frames
from swimm3r.report.outputs import OUTPUTS, outputs_of
from swimm3r.report.scores import TRUTH_LABELS, truth_rows
from swimm3r.scene.ground_truth import read_ground_truth
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.sfm.medium.settings import SeathruSettings
from swimm3r.sfm.settings import ColmapModelSettings, ColmapSettings
from swimm3r.splat.settings import (
    DensifySettings,
    InitialSettings,
    MediumFieldSettings,
    PoseRefinementSettings,
    UwbsSettings,
)
from swimm3r.synthetic import write_dive
from swimm3r.synthetic.settings import DiveSettings


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clip") / "dive"
    write_dive(DiveSettings(frames=16, width=320, height=214), folder)
    return folder


FEWER = ("--water.max-pixels", "60000", "--water.max-observations", "20000")  # a third of the time of the poses
AS_TYPED = replace(
    PRESETS["fast"],
    sfm=replace(PRESETS["fast"].sfm, water=SeathruSettings(max_pixels=60_000, max_observations=20_000)),
)
TINY_MAP = replace(
    AS_TYPED,
    splat=UwbsSettings(
        iterations=60,
        long_side=160,
        initial=InitialSettings(primitives=2500),
        densify=DensifySettings(cap_max=3000),
        medium=MediumFieldSettings(hidden=16),
    ),
    test=PoseRefinementSettings(steps=4, long_side=80, min_gain=0.0),
)


@pytest.fixture(scope="module")
def finished(dive: Path) -> tuple[Path, dict]:
    folder = dive.parent / "run"
    return folder, run_pipeline(dive, folder, TINY_MAP)


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): sha256(path.read_bytes()).hexdigest() for path in files}


def test_every_training_frame_is_placed_close_to_the_truth(finished: tuple[Path, dict]):
    _, summary = finished
    assert summary["sfm"]["registered"] == summary["sfm"]["frames"] == 14
    assert summary["truth"]["rotation_deg"] < 0.6
    assert summary["truth"]["translation_deg"] < 3
    assert summary["truth"]["depth_absrel"] < 0.05


def test_the_water_is_found(finished: tuple[Path, dict]):
    water = finished[1]["truth"]["sfm"]
    assert max(water["T_D_abs"]) < 0.1
    assert max(water["B_abs"]) < 0.04
    assert water["clear_psnr"] > 18


def test_the_run_folder_holds_what_the_conventions_promise(finished: tuple[Path, dict]):
    folder, summary = finished
    assert json.loads((folder / "summary.json").read_text()) == summary
    for name in ("settings.yaml", "versions.json", "log.jsonl", "report.html", "prepare/frames.json"):
        assert (folder / name).stat().st_size > 0, name
    for name in ("cameras.json", "matches.npz", "medium.json", "points.ply", "points_raw.ply", "sparse/images.bin"):
        assert (folder / "sfm" / name).stat().st_size > 0, name
    frames, names = load_frames(folder / "prepare"), load_reconstruction(folder / "sfm").names
    table = json.loads((folder / "sfm" / "cameras.json").read_text())["frames"]
    assert {entry["name"]: entry["time"] for entry in table} == dict(zip(names, frames.times_of(names), strict=True))
    trajectory = np.loadtxt(folder / "sfm" / "trajectory.tum")
    assert trajectory[:, 0].tolist() == sorted(frames.times_of(names))
    for name in names:
        assert (folder / "sfm" / "z_depth" / f"{name}.npz").is_file()
        assert (folder / "sfm" / "restored" / f"{name}.png").is_file()
        assert images.read_rgb(folder / "sfm" / "restored_physical" / f"{name}.png").dtype == np.uint16
    for name in ("map.safetensors", "metrics.jsonl", "checkpoint/state.safetensors"):
        assert (folder / "splat" / name).stat().st_size > 0, name
    for name in frames.test.names:
        stem = folder / "renders" / "test" / Path(name).stem
        for kind in KINDS:
            assert Path(f"{stem}_{kind}.png").is_file()
        assert read_depth(Path(f"{stem}_z_depth.tif")).any()


def test_the_map_shows_frames_it_never_saw(finished: tuple[Path, dict]):
    test = finished[1]["test"]
    assert test["views"] == 2
    assert test["psnr"] > 20
    assert test["sharpness"] > 0.3
    assert test["lpips"] is not None or test["lpips_reason"]
    assert "from reference" in test["protocol"]  # a synthetic dive knows where its frames were taken


def test_the_map_knows_the_water(finished: tuple[Path, dict]):
    water = finished[1]["truth"]["splat"]
    assert max(water["T_D_abs"]) < 0.1
    assert max(water["B_abs"]) < 0.05
    assert water["clear_psnr"] > 10  # after 60 steps much is still transparent
    assert water["clear_psnr_observed"] > water["clear_psnr"] - 0.5  # what no frame saw is no better
    assert finished[1]["medium"]["splat"]["unit"] == finished[1]["medium"]["sfm"]["unit"]


def test_the_flight_is_a_video_of_the_dive(finished: tuple[Path, dict]):
    video = Video(finished[0] / "renders" / "flythrough.mp4")
    shown = list(video.frames())
    assert len(shown) == 90
    assert video.width > 1.5 * video.height  # with and without the water, side by side


def test_a_finished_run_is_scored_and_rendered_again(finished: tuple[Path, dict], tmp_path: Path):
    folder, summary = finished
    copy = tmp_path / "run"
    shutil.copytree(folder, copy)
    again = evaluate_run(copy)
    assert again["test"] == summary["test"]
    assert again["truth"]["splat"]["clear_psnr"] == pytest.approx(summary["truth"]["splat"]["clear_psnr"], abs=1e-3)
    images = render_run(copy, ViewSettings(long_side=80))
    assert len(list(images.rglob("*_rgb.png"))) == summary["sfm"]["registered"]


def test_scores_by_another_protocol_stand_beside_the_runs_own(dive: Path, finished: tuple[Path, dict], tmp_path: Path):
    folder, summary = finished
    copy = tmp_path / "run"
    shutil.copytree(folder, copy)
    before = digests(copy / "renders")
    known = os.path.relpath(dive / "truth" / "cameras.json")
    assert evaluate_run(copy, steps=1, reference=Path(known))["stages"] == summary["stages"]
    (against,) = json.loads((copy / "summary.json").read_text())["other_protocols"].values()
    assert against["reference"] == str(dive / "truth" / "cameras.json")
    again = evaluate_run(copy, steps=1)
    assert {name: again[name] for name in ("test", "restored", "truth", "stages")} == {
        name: summary[name] for name in ("test", "restored", "truth", "stages")
    }
    other = again["other_protocols"]["steps-1"]
    assert other["settings"]["steps"] == 1
    assert "refined 1 steps" in other["test"]["protocol"]
    assert other["test"]["psnr"] != summary["test"]["psnr"]
    assert other["truth"]["sfm"] == summary["truth"]["sfm"]
    views = digests(copy / "renders")
    assert {name: views[name] for name in before} == before
    assert (copy / other["views"] / "0000_rgb.png").is_file()
    assert "steps-1" in (copy / "report.html").read_text()
    assert run_pipeline(dive, copy, TINY_MAP) == again


def test_the_test_frames_are_localized_in_the_map(dive: Path, finished: tuple[Path, dict], tmp_path: Path):
    answers, out = localize_run(finished[0], out=tmp_path / "places", settings=LocalizationSettings(matcher="sift"))
    frames, rec = load_frames(finished[0] / "prepare"), load_reconstruction(finished[0] / "sfm")
    assert [a.name for a in answers] == list(frames.test.names)
    record = json.loads((out / "poses.json").read_text())
    assert record["located"] == len(answers)
    assert len((out / "poses.tum").read_text().splitlines()) == len(answers)
    found = [a.found for a in answers if a.found is not None]
    assert all((out / "matches" / f"{a.name}.png").is_file() for a in answers)
    truth = read_ground_truth(dive / "truth")
    names = [*rec.names, *(a.name for a in answers)]
    poses = torch.cat([rec.cameras.cam2world, torch.stack([f.cam2world for f in found])])
    errors = absolute_pose_errors(poses, truth.cameras.cam2world[[truth.names.index(name) for name in names]])
    assert errors.rotation_deg < 0.1  # the mean, over 14 placed by structure from motion and 2 by the map
    assert isinstance(errors.ate, float)
    assert errors.ate < 0.02


def test_settings_come_back_from_their_file(tmp_path: Path):
    for settings in (
        *PRESETS.values(),
        RunSettings(sfm=MAST3R_PRESETS["fast"]),
        RunSettings(sfm=ColmapModelSettings(tmp_path)),
    ):
        (tmp_path / "settings.yaml").write_text(to_yaml(settings))
        assert from_yaml(tmp_path / "settings.yaml") == settings


@pytest.mark.parametrize("text", ["", "frames: {fps: 5}\nwarp: 9\n", "sfm: {kind: Sonar}\n", "[1, 2"])
def test_a_settings_file_of_another_version_is_named(tmp_path: Path, text: str):
    (tmp_path / "settings.yaml").write_text(text)
    with pytest.raises(InputError, match="is damaged"):
        from_yaml(tmp_path / "settings.yaml")


@pytest.mark.long
def test_a_map_is_trained_on_any_colmap_model(dive: Path, finished: tuple[Path, dict], tmp_path: Path):
    like = TINY_MAP.sfm
    assert isinstance(like, ColmapSettings)
    depth, model = replace(like.depth, long_side=160, sources=2), finished[0] / "sfm" / "sparse"
    own = replace(TINY_MAP, sfm=ColmapModelSettings(model, depth=depth, water=like.water))
    summary = run_pipeline(dive / "images", tmp_path / "run", own)
    assert summary["sfm"]["backend"] == "COLMAP model"
    assert summary["sfm"]["registered"] == finished[1]["sfm"]["registered"]
    assert summary["sfm"]["epipolar_px"] < 1  # of the observations of common points
    assert "from 2D-3D matches" in summary["test"]["protocol"]  # the model has no test frame
    assert summary["test"]["psnr"] > 20
    scored_again = evaluate_run(tmp_path / "run")
    assert scored_again["test"] == summary["test"]


def test_a_number_that_was_not_computed_is_null_with_its_reason(finished: tuple[Path, dict]):
    restored = finished[1]["restored"]["sfm"]
    assert restored["urank"] is None
    assert restored["urank_reason"]
    assert restored["uiqm"] > 0


@pytest.mark.parametrize(
    ("part", "physical", "shown"),
    [
        ("sfm", "sfm/restored_physical/*.png", "sfm/restored/*.png"),
        ("splat", "renders/test/*_clear_physical.png", "renders/test/*_clear.png"),
    ],
)
def test_scores_without_reference_are_of_physical_colors(
    part: str, physical: str, shown: str, finished: tuple[Path, dict]
):
    folder, summary = finished
    section = summary["restored"][part]
    for scores, files in ((section, sorted(folder.glob(physical))), (section["shown"], sorted(folder.glob(shown)))):
        stored = [images.read_rgb(path) for path in files]
        shares = [torch.from_numpy(image.astype("float32") / np.iinfo(image.dtype).max) for image in stored]
        assert scores["uciqe"] == pytest.approx(sum(uciqe(image) for image in shares) / len(files), rel=1e-4)
    assert section["uciqe"] != section["shown"]["uciqe"]
    assert "before the white balance" in section["colors"]


def test_test_frames_never_reach_structure_from_motion(finished: tuple[Path, dict]):
    folder, _ = finished
    frames = json.loads((folder / "prepare" / "frames.json").read_text())["frames"]
    held_back = {frame["name"] for frame in frames if frame["split"] == "test"}
    assert len(held_back) == 2
    assert not held_back & set(load_reconstruction(folder / "sfm").names)


def test_the_report_needs_no_network(finished: tuple[Path, dict]):
    page = (finished[0] / "report.html").read_text()
    assert 'src="data:image/' in page
    assert 'src="data:video/mp4' in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert "https://" not in page


_NOT_OF_THIS_RUN = {
    "splat/cameras.json", "splat/blocks", "sfm/cameras_between.json", "sfm/cameras_imported.json", "sfm/parts",
    "scale.json", "georeference.json",
}  # fmt: skip
"""Of maps that refined the poses, large maps, long clips, imported models, clips that fall into parts, runs with
sources of scale."""


def test_the_report_lists_every_result_and_names_every_score(finished: tuple[Path, dict]):
    folder, summary = finished
    listed = {output.path.rstrip("/") for output in outputs_of(folder)}
    assert set(OUTPUTS) - listed <= _NOT_OF_THIS_RUN
    truth = summary["truth"]
    scores = {k for section in (truth, truth["sfm"], truth["splat"]) for k, v in section.items() if _is_score(v)}
    assert scores <= set(TRUTH_LABELS)
    assert len(truth_rows(truth)) >= len(scores)


def _is_score(value: object) -> bool:
    return isinstance(value, (int, float, list))


def test_finished_stages_are_reused_bit_for_bit(dive: Path, finished: tuple[Path, dict]):
    folder, _ = finished
    kept = ("prepare", "sfm", "splat", "renders")
    before = [digests(folder / name) for name in kept]
    for last in ("prepare", "sfm", "eval"):
        assert run_pipeline(dive, folder, TINY_MAP, last_stage=last) == finished[1]
    assert [digests(folder / name) for name in kept] == before


def test_a_training_that_was_interrupted_goes_on(dive: Path, finished: tuple[Path, dict], tmp_path: Path):
    copy = tmp_path / "run"
    shutil.copytree(finished[0], copy)
    other = replace(TINY_MAP, splat=replace(TINY_MAP.splat, seed=1))

    def interrupt(what: str, done: int, total: int, /) -> None:
        if what == "training the map" and done == 40:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_pipeline(dive, copy, other, redo=True, progress=interrupt)
    steps: list[int] = []

    def count(what: str, done: int, total: int, /) -> None:
        if what == "training the map":
            steps.append(done)

    run_pipeline(dive, copy, other, last_stage="splat", progress=count)
    assert (steps[0], steps[-1]) == (36, 60)


@pytest.mark.long
def test_a_folder_copied_to_another_computer_goes_on_without_its_input(finished: tuple[Path, dict], tmp_path: Path):
    copy, gone = tmp_path / "run", tmp_path / "not mounted" / "dive"
    shutil.copytree(finished[0], copy)
    summary = json.loads((copy / "summary.json").read_text())
    summary["input"]["path"] = str(gone)
    (copy / "summary.json").write_text(json.dumps(summary))
    longer = replace(TINY_MAP, splat=replace(TINY_MAP.splat, iterations=8))
    made = run_pipeline(gone, copy, longer, redo=True)
    assert made["stages"]["eval"]["status"] == "done"
    assert made["truth"] is None  # it lies beside the dive
    assert made["input"] == summary["input"]
    assert digests(copy / "sfm") == digests(finished[0] / "sfm")
    before = digests(copy)
    smaller = replace(longer, frames=replace(longer.frames, long_side=160))
    with pytest.raises(InputError, match="there is no"):
        run_pipeline(gone, copy, smaller, redo=True)
    assert digests(copy / "prepare") == digests(finished[0] / "prepare")
    assert before.keys() == digests(copy).keys()
    with pytest.raises(InputError, match="there is no"):
        run_pipeline(gone, tmp_path / "new")


def test_another_input_is_refused(finished: tuple[Path, dict], tmp_path: Path):
    other = tmp_path / "other"
    write_dive(DiveSettings(frames=2, width=64, height=48), other)
    before = digests(finished[0])
    with pytest.raises(InputError, match="another input"):
        run_pipeline(other, finished[0])
    assert digests(finished[0]) == before


def test_a_folder_with_other_things_in_it_is_refused(dive: Path, tmp_path: Path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="not a run folder"):
        run_pipeline(dive, tmp_path)


def test_changed_settings_make_their_stage_again_where_that_is_asked_for(dive: Path, tmp_path: Path):
    settings = PRESETS["fast"]
    run_pipeline(dive, tmp_path / "run", settings, last_stage="prepare")
    fewer = replace(settings, frames=replace(settings.frames, long_side=160))
    assert run_pipeline(dive, tmp_path / "run", fewer, last_stage="prepare", redo=True)["input"]["width"] == 160


def test_too_little_disk_is_said_before_anything_is_begun(dive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 1 << 20})())
    with pytest.raises(StorageError, match="1 MB are free"):
        run_pipeline(dive, tmp_path / "run")


def test_a_disk_that_fills_under_the_database_is_said_with_its_exit_code(dive: Path, tmp_path: Path):
    """Stands in for a full disk: no file may grow beyond 1 MB, which the prepared frames do not, the database does."""
    folder = tmp_path / "run"
    (tmp_path / "temporary").mkdir()
    command = f"ulimit -f 1000; exec {sys.executable} -m swimm3r sfm {dive} --out {folder} --preset fast"
    elsewhere = {**os.environ, "TMPDIR": str(tmp_path / "temporary")}
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False, env=elsewhere)
    assert done.returncode == 7, done.stderr
    assert "database" in done.stderr
    assert "Traceback" not in done.stderr
    assert json.loads((folder / "summary.json").read_text())["stages"]["prepare"]["status"] == "done"
    assert list((tmp_path / "temporary").iterdir()) == []  # of no library


@pytest.mark.parametrize("marker", [pytest.param("sfm/database.db", marks=pytest.mark.long), "sfm/reconstruction.json"])
def test_a_killed_run_goes_on(marker: str, dive: Path, finished: tuple[Path, dict], tmp_path: Path):
    folder = tmp_path / "run"
    command = [sys.executable, "-m", "swimm3r", "run", str(dive), "--out", str(folder), "--preset", "fast"]
    command += FEWER
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while not (folder / marker).is_file() and process.poll() is None:
            time.sleep(0.02)
        os.kill(process.pid, signal.SIGKILL)
    before = digests(folder / "prepare")
    run_pipeline(dive, folder, AS_TYPED, last_stage="sfm")
    assert digests(folder / "prepare") == before
    again, first = (load_reconstruction(f / "sfm") for f in (folder, finished[0]))
    assert again.names == first.names
    assert absolute_pose_errors(again.cameras.cam2world, first.cameras.cam2world).rotation_deg < 0.05
    assert torch.isfinite(again.cloud.xyz).all()
    if marker == "sfm/reconstruction.json":  # killed after the poses were found: all that follows has the same bits
        for name in ("cameras.json", "medium.json", "points.ply", "matches.npz"):
            assert (folder / "sfm" / name).read_bytes() == (finished[0] / "sfm" / name).read_bytes(), name
