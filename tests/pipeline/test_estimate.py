"""Time and disk of a run, told before it starts."""

import logging
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from swimm3r.cli.main import main
from swimm3r.io.images import write_rgb
from swimm3r.pipeline.estimate import Estimate, check_disk, duration, estimate_run, size
from swimm3r.pipeline.presets import MAST3R_PRESETS, PRESETS, RunSettings
from swimm3r.pipeline.run import run_pipeline
from swimm3r.pipeline.stage_start import StageStart
from swimm3r.scene.settings import FrameSettings
from swimm3r.splat.settings import UwbsSettings, with_recipe

FAST = PRESETS["fast"]


@pytest.fixture
def dive(tmp_path: Path) -> Path:
    for i in range(6):
        write_rgb(tmp_path / "dive" / f"{i}.png", np.random.default_rng(i).random((48, 64, 3)))
    return tmp_path / "dive"


def estimated(source: Path, settings: RunSettings = FAST, **options: Any) -> Estimate:
    found = estimate_run(source, source.parent / "run", settings, **options)
    assert found is not None
    return found


def seconds(told: Estimate, stage: str) -> float:
    found = told.seconds[stage]
    assert found is not None
    return found


def test_images_are_counted_and_reduced_as_the_settings_say(dive: Path):
    assert (estimated(dive).frames, estimated(dive).width, estimated(dive).height) == (6, 64, 48)
    smaller = replace(FAST, frames=FrameSettings(long_side=32, max_frames=4))
    assert (estimated(dive, smaller).frames, estimated(dive, smaller).width) == (4, 32)


def test_a_video_is_counted_by_its_length_and_rate(tmp_path: Path, write_video: Callable[..., Path]):
    images = [np.full((48, 64, 3), 8 * i, np.uint8) for i in range(30)]
    video = write_video(tmp_path / "dive.mp4", images, times=[i / 10 for i in range(30)])
    by_rate = {fps: estimated(video, replace(FAST, frames=FrameSettings(fps=fps))).frames for fps in (2.0, 5.0, 0.0)}
    assert by_rate[2.0] == pytest.approx(6, abs=1)
    assert by_rate[5.0] == pytest.approx(15, abs=1)
    assert by_rate[0.0] == pytest.approx(30, abs=1)
    later = replace(FAST, frames=FrameSettings(fps=5.0, start=2.0))
    assert estimated(video, later).frames == pytest.approx(5, abs=1)


def test_more_work_is_estimated_longer_and_larger(dive: Path):
    base, splat = estimated(dive), FAST.splat
    assert isinstance(splat, UwbsSettings)
    longer = estimated(dive, replace(FAST, splat=replace(splat, iterations=10 * splat.iterations)))
    assert seconds(longer, "splat") > 5 * seconds(base, "splat")
    assert seconds(longer, "sfm") == seconds(base, "sfm")
    other = estimated(dive, replace(FAST, splat=with_recipe(splat, "watersplatting")))
    assert seconds(other, "splat") > seconds(base, "splat")
    assert seconds(estimated(dive, cores=8), "splat") < seconds(estimated(dive, cores=2), "splat")
    assert estimated(dive, stages=("prepare",)).total_bytes < base.total_bytes


def test_what_a_network_or_a_gpu_decides_is_not_estimated(dive: Path):
    network = estimated(dive, replace(FAST, sfm=MAST3R_PRESETS["fast"]))
    assert network.seconds["sfm"] is None
    assert network.seconds_from("prepare") is None
    assert network.seconds_from("splat") is not None
    assert "structure from motion not estimated" in str(network)
    assert estimated(dive, on_cpu=False).seconds["splat"] is None


def test_the_rates_are_those_of_measured_runs(tmp_path: Path):
    """ruie_cyan_slope: 42 frames of 400x300 at --preset fast, 101 processor-seconds; training 3.8 to 4.4 minutes."""
    for i in range(42):
        write_rgb(tmp_path / "dive" / f"{i:02}.png", np.zeros((300, 400, 3)))
    told = estimated(tmp_path / "dive", cores=2)
    processor = 1.5  # two cores, three quarters busy
    assert 50 < (seconds(told, "sfm") - 5) * processor < 200
    assert 2 * 60 < (seconds(told, "splat") - 5) * processor < 8 * 60


def test_a_disk_that_is_far_too_small_is_exit_7_and_a_tight_one_a_warning(
    dive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    need = estimated(dive).total_bytes
    free = {"plenty": 10 * need, "tight": 0.8 * need, "none": 0.3 * need}
    for name, amount in free.items():
        monkeypatch.setattr(shutil, "disk_usage", lambda _, amount=amount: SimpleNamespace(free=amount))
        if name == "none":
            with pytest.raises(SystemExit) as stop:
                main(["run", str(dive), "-o", str(tmp_path / "run"), "--preset", "fast"])
            assert stop.value.code == 7
            told = capsys.readouterr().err
            assert "the run takes about" in told
            assert "Try:" in told
            assert not (tmp_path / "run").exists()
        else:
            assert bool(check_disk(estimated(dive), tmp_path)) == (name == "tight")


def test_stages_announce_themselves_with_the_time_left(dive: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    told: list[StageStart] = []
    with caplog.at_level(logging.INFO, "swimm3r"):
        run_pipeline(dive, tmp_path / "run", FAST, last_stage="prepare", on_stage=told.append)
    assert [(one.number, one.count, one.title) for one in told] == [(1, 1, "frames")]
    assert told[0].seconds_left == pytest.approx(5, abs=1)
    caplog.clear()
    with caplog.at_level(logging.INFO, "swimm3r"):
        run_pipeline(dive, tmp_path / "run", FAST, last_stage="prepare", on_stage=told.append)
    assert not any(message.startswith("Rough estimate") for message in caplog.messages)  # nothing is left to do


@pytest.mark.parametrize(("count", "words"), [(4.4, "4 s"), (150, "2 min"), (9000, "2.5 h"), (None, "not estimated")])
def test_durations_are_told_in_the_unit_people_use(count: float | None, words: str):
    assert duration(count) == words


def test_sizes_are_told_in_the_unit_people_use():
    assert (size(12e6), size(3.21e9)) == ("12 MB", "3.2 GB")
