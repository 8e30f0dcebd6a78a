"""Inputs of a run are looked into before work begins: rigs that nothing would adjust as rigs, sources of scale."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from swimm3r.errors import InputError, UsageError
from swimm3r.io.images import write_rgb
from swimm3r.pipeline.inputs import check_inputs
from swimm3r.pipeline.presets import RunSettings
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scene.settings import FrameSettings
from swimm3r.sfm.settings import ColmapModelSettings, ColmapSettings, SfmSettings


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    for side in ("left", "right"):
        for i in range(3):
            write_rgb(tmp_path / "dive" / side / f"{i}.png", np.full((8, 12, 3), 20 * i, np.uint8))
    return tmp_path / "dive"


def settings(sfm: SfmSettings, *rig: str) -> RunSettings:
    return replace(RunSettings(), frames=FrameSettings(rig=rig), sfm=sfm)


@pytest.mark.parametrize(
    ("sfm", "fault"),
    [
        (ColmapModelSettings(model=Path("model")), "those of single frames"),
        (ColmapSettings(housing="flat", focal=500.0), "--housing flat"),
    ],
)
def test_a_rig_that_nothing_would_adjust_is_refused(pair: Path, sfm: SfmSettings, fault: str):
    with pytest.raises(UsageError, match=fault) as told:
        check_inputs(pair, settings(sfm, "left", "right"))
    assert "--rig none" in told.value.hint


def test_one_camera_after_the_other_may_be_behind_a_port(pair: Path):
    check_inputs(pair, settings(ColmapSettings(housing="flat", focal=500.0), "none"))
    check_inputs(pair, settings(ColmapSettings(), "left", "right"))


def test_files_that_tell_the_scale_are_looked_for_unless_the_run_has_it(pair: Path, tmp_path: Path):
    lost = replace(RunSettings(), scale=ScaleSettings(points=tmp_path / "points.csv"))
    with pytest.raises(InputError, match=r"there is no file .*points\.csv"):
        check_inputs(pair, lost)
    check_inputs(pair, lost, scaled=True)
