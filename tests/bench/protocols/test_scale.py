"""Cost by the length of a survey: parts of a run add up, steps of one stage are not taken for another's."""

from pathlib import Path

import pytest

from swimm3r.bench.protocols.scale import StepClock, by_part, scale_table, survey
from swimm3r.bench.settings import SurveySettings
from swimm3r.evaluate import NotComputed
from swimm3r.pipeline.presets import PRESETS
from swimm3r.pipeline.stage_start import StageStart

SMALL = SurveySettings(counts=(14,), width=240, height=136, last="mapping")


def test_a_survey_has_as_many_frames_as_were_asked_for():
    assert [survey(n, SurveySettings()).frame_count for n in (14, 100, 300, 1000, 3000)] == [14, 100, 300, 1000, 3000]


def test_steps_are_counted_for_the_stage_they_belong_to():
    clock = StepClock()
    clock("preparing frames", 1, 1)
    clock.next_stage(StageStart(2, 2, "poses", None))
    clock("depth", 0, 2)
    clock("depth", 2, 2)
    assert [list(steps) for steps in clock.stages] == [["preparing frames"], ["depth"]]
    assert clock.total == pytest.approx(sum(sum(steps.values()) for steps in clock.stages))


def test_the_parts_of_a_run_add_up_to_its_stages():
    steps = [
        {"preparing frames": 1.0},
        {
            "matching frames": 5.0, "depth": 2.0, "depth agreement": 1.0, "depth seen through": 1.0,
            "fusing depth": 2.0, "restoring images": 4.0,
        },
        {"training the map": 30.0},
    ]  # fmt: skip
    stages = {name: {"cpu_seconds": seconds} for name, seconds in (("prepare", 1), ("sfm", 16), ("splat", 31))}
    found = by_part(steps, stages)
    assert found == {"cpu_prepare": 1, "cpu_mapping": 6, "cpu_depth": 4, "cpu_water": 6, "cpu_map": 31}
    assert sum(found.values()) == sum(stage["cpu_seconds"] for stage in stages.values())


@pytest.mark.long
def test_a_small_survey_is_made_mapped_and_scored(tmp_path: Path):
    (cell,) = scale_table(tmp_path, SMALL, PRESETS["fast"]).cells
    scores = {name: value for name, value in cell.scores.items() if not isinstance(value, NotComputed)}
    assert cell.scores.keys() - scores.keys() == {"psnr"}  # no map was asked for
    assert scores["registered_pct"] == 100
    assert 0 <= scores["ate_pct"] < 1
    assert scores["cpu_mapping"] > 0
