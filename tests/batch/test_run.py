"""A batch over tiny dives: failures stay with their dive, finished ones are not touched, page and table show all."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from tests.batch.tasks import finish_or_fail
from tests.scale.conftest import lines, survey_along, write_csv
from tests.scale.test_rescale import write_run

from swimm3r.batch import run as batch_run
from swimm3r.batch.dive import Dive
from swimm3r.batch.dives import FoundDives, Skipped, find_dives
from swimm3r.batch.results import Row, is_finished, row_of
from swimm3r.batch.run import BatchError, check_outcome, run_batch
from swimm3r.cli.main import main
from swimm3r.errors import UsageError
from swimm3r.io.files.cache_key import sample_digest
from swimm3r.io.images import write_rgb
from swimm3r.pipeline.presets import PRESETS, to_yaml
from swimm3r.pipeline.stage_keys import stage_keys
from swimm3r.scale.run import scale_run
from swimm3r.scale.settings import ScaleSettings
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.synthetic import write_dive
from swimm3r.synthetic.settings import DiveSettings
from swimm3r.tasks import EngineSettings

TINY = PRESETS["fast"]


@pytest.fixture(scope="module")
def tapes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three dives of a few frames, one of them noise, in which nothing can be matched."""
    folder = tmp_path_factory.mktemp("tapes")
    write_dive(DiveSettings(frames=4, width=64, height=48), folder / "reef")
    write_dive(DiveSettings(frames=4, width=64, height=48, seed=1), folder / "wall")
    generator = np.random.default_rng(0)
    (folder / "animal").mkdir()
    for k in range(6):
        write_rgb(folder / "animal" / f"{k}.png", generator.integers(90, 110, (96, 128, 3), dtype=np.uint8))
    return folder


def table(out: Path) -> list[dict[str, str]]:
    with (out / "results.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_a_dive_that_fails_leaves_the_others_alone_and_finished_ones_are_not_touched(tapes: Path, tmp_path: Path):
    out, told = tmp_path / "out", []
    found = find_dives([tapes], TINY, out)
    rows = run_batch(found, out, last_stage="prepare", on_end=told.append)
    assert [(row.name, row.status, row.frames) for row in rows] == [
        ("animal", "finished", 6),
        ("reef", "finished", 4),
        ("wall", "finished", 4),
    ]
    assert told == list(rows)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    assert run_batch(found, out, last_stage="prepare", on_end=told.append) == rows
    assert len(told) == 3
    after = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    touched = {path.name for path in after if after[path] != before.get(path)}
    assert touched == {".lock", "results.csv", "results.html"}

    rows = run_batch(FoundDives(found.dives[:1]), out, last_stage="sfm")
    assert (rows[0].status, rows[0].exit_code) == ("failed", 6)
    assert rows[0].frames == 6
    assert rows[0].hint
    assert rows[0].log == "logs/animal.log"
    assert "Stage 2 of 2" in (out / rows[0].log).read_text()
    failed = table(out)[0]
    assert (failed["name"], failed["status"], failed["exit_code"]) == ("animal", "failed", "6")
    assert failed["error"] == rows[0].error
    with pytest.raises(BatchError, match="animal"):
        check_outcome(rows, out)
    (out / "wall" / "prepare" / "frames.json").write_text("{")  # by a crash: its page has no frame, and that is all
    assert [row.name for row in run_batch(found, out, last_stage="prepare")] == ["animal", "reef", "wall"]


ENGINES = [
    EngineSettings(jobs=2),
    pytest.param(
        EngineSettings(engine="slurm", cluster="local", jobs=2, cpus=1),
        marks=pytest.mark.skipif(find_spec("submitit") is None, reason="submitit is not installed"),
    ),
    pytest.param(
        EngineSettings(engine="ray", jobs=2, cpus=1),
        marks=[pytest.mark.long, pytest.mark.skipif(find_spec("ray") is None, reason="ray is not installed")],
    ),
]


@pytest.mark.parametrize("engine", ENGINES, ids=["local", "slurm", "ray"])
def test_a_killed_dive_is_made_again_by_every_engine(
    engine: EngineSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(batch_run, "run_dive", finish_or_fail)
    if engine.engine == "slurm":
        monkeypatch.setattr("submitit.Job._results_timeout_s", 0.5)
    dives = tuple(Dive(name, tmp_path / name, TINY) for name in ("killed", "gone", "wall"))
    rows = run_batch(FoundDives(dives), tmp_path / "out", engine)
    assert [row.status for row in rows] == ["finished", "failed", "finished"]
    assert (rows[1].exit_code, rows[1].error, rows[1].hint) == (3, "there is no nowhere", "another name")
    assert sorted(path.parent.name for path in tmp_path.glob("out/*/done")) == ["killed", "wall"]


def test_the_exit_code_is_that_of_the_failures_where_they_have_one():
    def row(code: int | None) -> Row:
        return Row(f"dive {code}", "finished" if code is None else "failed", error="why", exit_code=code)

    check_outcome([row(None)], Path("out"))
    for codes, expected in (((6, None, 6), 6), ((3, 6), 8)):
        with pytest.raises(BatchError) as raised:
            check_outcome([row(code) for code in codes], Path("out"))
        assert raised.value.exit_code == expected
        assert "results.html" in raised.value.hint


def test_another_table_is_not_overwritten(tapes: Path, tmp_path: Path):
    (tmp_path / "results.csv").write_text("name,score\nmine,1\n")
    with pytest.raises(UsageError, match="another table"):
        run_batch(find_dives([tapes], TINY, tmp_path), tmp_path, last_stage="prepare")
    assert (tmp_path / "results.csv").read_text() == "name,score\nmine,1\n"


def test_the_command_makes_a_page_and_a_table(
    tapes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], open_page: Callable
):
    out = tmp_path / "out"
    sheet = tapes / "dives.csv"
    sheet.write_text("dive,name,max_frames\nreef,Riff & Wand,3\nnothing,lost,\n")
    with pytest.raises(SystemExit) as stop:
        main(["batch", str(sheet), "--out", str(out), "--preset", "fast", "--last-stage", "prepare", "-q"])
    sheet.unlink()
    assert stop.value.code == 3
    said = capsys.readouterr()
    assert "lost: failed" in said.out
    assert "1 of 2 dives failed: lost" in said.err
    assert [(row["name"], row["status"], row["frames"]) for row in table(out)] == [
        ("Riff & Wand", "finished", "3"),
        ("lost", "failed", ""),
    ]
    shown = open_page(out / "results.html")
    assert shown.page.locator("section.dive").count() == 2
    assert shown.page.locator(".dive img").count() == 1
    assert "1 of 2 dives finished, 1 failed." in shown.page.inner_text(".verdict")
    assert "there is no" in shown.page.inner_text(".dive.failed")
    assert "Riff & Wand" in shown.page.inner_text("main")
    assert shown.requests == [(out / "results.html").as_uri()]
    assert shown.errors == []
    assert shown.overflow == 0


def test_what_is_left_out_is_on_the_page(tapes: Path, tmp_path: Path):
    found = find_dives([tapes / "reef"], TINY, tmp_path)
    skipped = (Skipped(Path("papers"), "it holds <neither> images nor a video"),)
    run_batch(replace(found, skipped=skipped), tmp_path, last_stage="prepare")
    assert "it holds &lt;neither&gt; images nor a video" in (tmp_path / "results.html").read_text()


def test_a_dive_is_finished_where_it_has_the_scale_of_its_sources(tapes: Path, tmp_path: Path):
    survey = survey_along(lines(count=2, each=4))
    file = write_csv(tmp_path / "nav.csv", survey)
    assert isinstance(TINY.sfm, ColmapSettings)
    without = replace(TINY.sfm, mapping=replace(TINY.sfm.mapping, navigation=False))
    plain = Dive("reef", tapes / "reef", replace(TINY, sfm=without))
    given = replace(plain, settings=replace(plain.settings, scale=ScaleSettings(nav=file, nav_offset=0.0)))
    run = write_run(tmp_path / "reef", survey)
    digest = sample_digest(plain.source, leave_out=run)
    keys = stage_keys(digest, plain.settings, None)
    stages = {stage: {"status": "done", **keys[stage].entry(None)} for stage in ("prepare", "sfm")}
    summary = json.loads((run / "summary.json").read_text())
    summary |= {"input": {"path": str(plain.source), "fingerprint": digest}, "stages": stages}
    (run / "summary.json").write_text(json.dumps(summary))
    (run / "settings.yaml").write_text(to_yaml(plain.settings))

    assert is_finished(plain, tmp_path, "sfm")
    assert not is_finished(given, tmp_path, "sfm")
    assert is_finished(given, tmp_path, "prepare")
    scale_run(run, given.settings.scale)
    assert is_finished(given, tmp_path, "sfm")
    assert is_finished(plain, tmp_path, "sfm")
    file.write_text(file.read_text().replace("5", "6"))
    assert not is_finished(given, tmp_path, "sfm")

    assert row_of(plain, tmp_path, "finished").medium
    (run / "sfm" / "medium.json").write_text("{")  # by a crash
    assert row_of(plain, tmp_path, "finished").medium == ""
