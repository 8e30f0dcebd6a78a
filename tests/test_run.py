"""The pipeline over a run folder, on a small synthetic dive: what it finds, what it reuses, what it survives."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest
import torch

from swimm3r import reconstruction
from swimm3r.errors import InputError, StorageError
from swimm3r.evaluate.poses import absolute_pose_errors
from swimm3r.presets import PRESETS
from swimm3r.run import run_pipeline
from swimm3r.synthetic import write_dive
from swimm3r.synthetic.settings import DiveSettings


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clip") / "dive"
    write_dive(DiveSettings(frames=16, width=320, height=214), folder)
    return folder


@pytest.fixture(scope="module")
def finished(dive: Path) -> tuple[Path, dict]:
    folder = dive.parent / "run"
    return folder, run_pipeline(dive, folder, PRESETS["fast"])


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
    for name in reconstruction.load(folder / "sfm").names:
        assert (folder / "sfm" / "z_depth" / f"{name}.npz").is_file()
        assert (folder / "sfm" / "restored" / f"{name}.png").is_file()


def test_a_number_that_was_not_computed_is_null_with_its_reason(finished: tuple[Path, dict]):
    restored = finished[1]["restored"]["sfm"]
    assert restored["urank"] is None
    assert restored["urank_reason"]
    assert restored["uiqm"] > 0


def test_test_frames_never_reach_structure_from_motion(finished: tuple[Path, dict]):
    folder, _ = finished
    frames = json.loads((folder / "prepare" / "frames.json").read_text())["frames"]
    held_back = {frame["name"] for frame in frames if frame["split"] == "test"}
    assert len(held_back) == 2
    assert not held_back & set(reconstruction.load(folder / "sfm").names)


def test_the_report_needs_no_network(finished: tuple[Path, dict]):
    page = (finished[0] / "report.html").read_text()
    assert 'src="data:image/' in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert "https://" not in page


def test_finished_stages_are_reused_bit_for_bit(dive: Path, finished: tuple[Path, dict]):
    folder, _ = finished
    before = digests(folder / "prepare") | digests(folder / "sfm")
    began = time.process_time()
    run_pipeline(dive, folder, PRESETS["fast"])
    assert digests(folder / "prepare") | digests(folder / "sfm") == before
    assert time.process_time() - began < 30


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


def test_changed_settings_make_their_stage_again(dive: Path, tmp_path: Path):
    settings = PRESETS["fast"]
    run_pipeline(dive, tmp_path / "run", settings, last_stage="prepare")
    fewer = replace(settings, frames=replace(settings.frames, long_side=160))
    assert run_pipeline(dive, tmp_path / "run", fewer, last_stage="prepare")["input"]["width"] == 160


def test_too_little_disk_is_said_before_anything_is_begun(dive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 1 << 20})())
    with pytest.raises(StorageError, match="1 MB are left"):
        run_pipeline(dive, tmp_path / "run")


def test_a_disk_that_fills_under_the_database_is_said_with_its_exit_code(dive: Path, tmp_path: Path):
    """Stands in for a full disk: no file may grow beyond 1 MB, which the prepared frames do not, the database does."""
    folder = tmp_path / "run"
    command = f"ulimit -f 1000; exec {sys.executable} -m swimm3r sfm {dive} --out {folder} --preset fast"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode == 7, done.stderr
    assert "database" in done.stderr
    assert "Traceback" not in done.stderr
    assert json.loads((folder / "summary.json").read_text())["stages"]["prepare"]["status"] == "done"


@pytest.mark.parametrize("marker", ["sfm/database.db", "sfm/reconstruction.json"])
def test_a_killed_run_goes_on(marker: str, dive: Path, finished: tuple[Path, dict], tmp_path: Path):
    folder = tmp_path / "run"
    command = [sys.executable, "-m", "swimm3r", "run", str(dive), "--out", str(folder), "--preset", "fast"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while not (folder / marker).is_file() and process.poll() is None:
            time.sleep(0.02)
        os.kill(process.pid, signal.SIGKILL)
    before = digests(folder / "prepare")
    run_pipeline(dive, folder, PRESETS["fast"])
    assert digests(folder / "prepare") == before
    again, first = (reconstruction.load(f / "sfm") for f in (folder, finished[0]))
    assert again.names == first.names
    assert absolute_pose_errors(again.cameras.cam2world, first.cameras.cam2world).rotation_deg < 0.05
    assert torch.isfinite(again.cloud.xyz).all()
