"""Scale as a part of a run: applied once, again where its sources change, moved away with what it was made from."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.scale.conftest import SCALE, Survey, lines, survey_along, write_csv
from tests.scale.test_rescale import write_run

from swimm3r.errors import InputError, UsageError
from swimm3r.io.images import write_rgb
from swimm3r.pipeline.presets import PRESETS, RunSettings, from_yaml, to_yaml
from swimm3r.pipeline.run import run_pipeline
from swimm3r.pipeline.run_record import _set_aside, open_record
from swimm3r.pipeline.run_settings import differences
from swimm3r.pipeline.stage_keys import stage_keys
from swimm3r.pipeline.stages import _scaled
from swimm3r.progress import silent
from swimm3r.scale.rescale import RESCALING
from swimm3r.scale.run import is_scaled, read_record, scale_sections
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scene.georeference import load_georeference
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.run_folder import open_run
from swimm3r.sfm.settings import ColmapSettings


@pytest.fixture
def survey() -> Survey:
    return survey_along(lines(count=2, each=4))


@pytest.fixture
def run(survey, tmp_path) -> Path:
    return write_run(tmp_path / "run", survey)


def scaled(run: Path, settings: ScaleSettings) -> bool:
    with open_record(run, Path("dive.mp4"), "none") as record:
        record.summary |= json.loads((run / "summary.json").read_text())
        done = _scaled(record, load_reconstruction(run / "sfm"), RunSettings(scale=settings), silent)
        record.describe("sfm", scale_sections(run, load_reconstruction(run / "sfm")))
        record.write()
    return done


def test_a_run_applies_its_sources_once_and_again_where_their_files_change(run, survey, tmp_path):
    file = write_csv(tmp_path / "nav.csv", survey)
    settings = ScaleSettings(nav=file, nav_offset=0.0)
    assert not scaled(run, ScaleSettings())
    assert scaled(run, settings)
    assert not scaled(run, settings)
    record = read_record(run)
    assert record is not None
    assert record.metres_per_unit == pytest.approx(SCALE, rel=1e-6)
    local = survey.geodetic(survey.position * 1.02)
    write_csv(file, survey, latitude=local[:, 0], longitude=local[:, 1], depth=-local[:, 2])
    assert scaled(run, settings)
    assert read_record(run).metres_per_unit == pytest.approx(1.02 * SCALE, rel=1e-5)
    summary = json.loads((run / "summary.json").read_text())
    assert summary["scale"]["metres_per_unit"] == pytest.approx(1.02 * SCALE, rel=1e-5)
    assert summary["water"]["unit"] == "1/m"


def test_a_scaled_run_keeps_its_scale_where_the_files_of_its_sources_are_not(run, survey, tmp_path):
    file = write_csv(tmp_path / "nav.csv", survey)
    settings, key = ScaleSettings(nav=file, nav_offset=0.0), open_run(run, "sfm").stages["sfm"].key
    assert not is_scaled(run, key, settings)
    scaled(run, settings)
    os.utime(file, (1, 1))  # as a copy may have it
    assert is_scaled(run, key, settings)
    assert not is_scaled(run, "another", settings)
    file.unlink()
    assert is_scaled(run, key, settings)
    assert not scaled(run, settings)
    assert not is_scaled(run, key, replace(settings, nav=tmp_path / "other.csv"))


def test_a_run_finishes_a_rescaling_that_was_interrupted(run):
    staged = run / RESCALING.parent / "note.txt"
    staged.parent.mkdir()
    staged.write_text("new")
    (run / RESCALING).write_text(json.dumps({"files": ["note.txt"]}))
    scaled(run, ScaleSettings())
    assert (run / "note.txt").read_text() == "new"
    assert not staged.parent.exists()


def test_stages_that_move_away_take_their_place_along(run, survey, tmp_path):
    scaled(run, ScaleSettings(nav=write_csv(tmp_path / "nav.csv", survey), nav_offset=0.0))
    target = _set_aside(run, ["sfm", "splat"])
    assert load_georeference(run) is None
    assert load_georeference(target) is not None
    assert read_record(run) is None


def test_sources_that_cannot_be_used_are_refused_before_any_work(tmp_path, survey):
    for i in range(4):
        write_rgb(tmp_path / "images" / f"{i}.png", np.full((48, 64, 3), 0.5))
    swapped = write_csv(tmp_path / "n.csv", survey, latitude=np.full(8, 120.0), longitude=np.zeros(8))
    settings = replace(PRESETS["fast"], scale=ScaleSettings(nav=swapped))
    with pytest.raises(InputError, match="beyond 90 degrees"):
        run_pipeline(tmp_path / "images", tmp_path / "out", settings, progress=silent)
    assert not (tmp_path / "out" / "prepare").exists()


def test_settings_of_scale_are_kept_in_the_run_folder(tmp_path):
    scale = ScaleSettings(scale_bar=("a.png:1,2", "0.5"), nav=Path("/data/nav.csv"), lever_arm=(0.1, 0.0, -0.2))
    (tmp_path / "settings.yaml").write_text(to_yaml(replace(PRESETS["fast"], scale=scale)))
    assert from_yaml(tmp_path / "settings.yaml").scale == scale


def test_navigation_belongs_to_mapping_unless_mapping_does_without(tmp_path):
    plain = PRESETS["fast"]
    given = replace(plain, scale=ScaleSettings(nav=Path("/data/nav.csv")))
    assert isinstance(plain.sfm, ColmapSettings)
    sfm = replace(plain.sfm, mapping=replace(plain.sfm.mapping, navigation=False))
    keys = [stage_keys("digest", settings, None)["sfm"] for settings in (plain, given, replace(given, sfm=sfm))]
    assert keys[0] != keys[1]
    assert keys[2] == stage_keys("digest", replace(plain, sfm=sfm), None)["sfm"]
    assert "scale.nav: None -> /data/nav.csv" in differences(plain, given, ["sfm"])


def test_a_run_that_was_mapped_without_navigation_is_told_how_to_get_it(tmp_path):
    plain = PRESETS["fast"]
    given = replace(plain, scale=ScaleSettings(nav=Path("/data/nav.csv")))
    (tmp_path / "run").mkdir()
    with open_record(tmp_path / "run", Path("dive.mp4"), "none") as record:
        (tmp_path / "run" / "settings.yaml").write_text(to_yaml(plain))
        key = stage_keys(record.fingerprint, plain, None)["sfm"]
        record.stage("sfm", key, make=lambda: None)
        with pytest.raises(UsageError, match="mapped with another navigation, or none") as refused:
            record.superseded(given, None)
    assert "swimm3r scale" in str(refused.value.hint)
