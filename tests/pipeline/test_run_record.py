"""A run folder under changed settings, another process, a kill and a damaged record."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from swimm3r.cli.main import main
from swimm3r.errors import DeviceError, InputError, UsageError
from swimm3r.io.files.atomic import DRAFT
from swimm3r.io.files.folder_lock import folder_lock
from swimm3r.pipeline.presets import PRESETS, RunSettings, from_yaml
from swimm3r.pipeline.run import run_pipeline
from swimm3r.pipeline.run_record import open_record
from swimm3r.pipeline.run_settings import differences, starting_settings
from swimm3r.pipeline.stage_keys import StageKey, stage_keys
from swimm3r.scene.run_folder import open_run, read_run
from swimm3r.synthetic import write_dive
from swimm3r.synthetic.settings import DiveSettings

FAST = PRESETS["fast"]
SMALLER = replace(FAST, frames=replace(FAST.frames, long_side=32))


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clip") / "dive"
    write_dive(DiveSettings(frames=4, width=64, height=48), folder)
    return folder


@pytest.fixture
def run(dive: Path, tmp_path: Path) -> Path:
    """A run up to its frames."""
    run_pipeline(dive, tmp_path / "run", FAST, last_stage="prepare")
    return tmp_path / "run"


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name not in ("log.jsonl", ".lock")
    }


def pretend(run: Path, stage: str, status: str = "done") -> None:
    """A later stage as if it had been made with the folder's settings."""
    document = json.loads((run / "summary.json").read_text())
    keys = stage_keys(document["input"]["fingerprint"], from_yaml(run / "settings.yaml"), None)
    document["stages"][stage] = {"status": status, **keys[stage].entry(None)}
    (run / "summary.json").write_text(json.dumps(document))
    marker = {"sfm": "sfm/reconstruction.json", "splat": "splat/map.safetensors", "eval": "renders/test/0.png"}[stage]
    (run / marker).parent.mkdir(parents=True)
    (run / marker).write_text(f"hours of work on {stage}")


SECTIONS = {
    "sfm": {"sfm": {"points": 9}, "scale": {"unit": "m"}, "warnings": [{"what": "of structure from motion"}]},
    "splat": {"splat": {"primitives": 7}},
    "eval": {"test": {"psnr": 30.0}, "restored": {"sfm": {}}, "truth": None, "other_protocols": {"steps-1": {}}},
}
"""Of summary.json, beside "medium", of which two stages make entries."""


def pretend_finished(run: Path) -> dict:
    """The summary of a run whose later stages are as if they had been made."""
    for stage in SECTIONS:
        pretend(run, stage)
    document = json.loads((run / "summary.json").read_text())
    document |= {name: section for of_stage in SECTIONS.values() for name, section in of_stage.items()}
    document["medium"] = {"sfm": {"Binf": [0.1]}, "splat": {"Binf": [0.2]}}
    document["input"] |= {"width": 99, "rectified": True}
    (run / "summary.json").write_text(json.dumps(document))
    return document


def test_a_command_that_stops_earlier_keeps_the_scores_of_a_finished_run(dive: Path, run: Path):
    before = pretend_finished(run)
    assert run_pipeline(dive, run, last_stage="prepare") == before
    assert json.loads((run / "summary.json").read_text()) == before


def test_a_command_that_stops_while_it_loads_keeps_the_scores_of_a_finished_run(dive: Path, run: Path):
    before = pretend_finished(run)
    with pytest.raises(InputError):  # the pretended structure from motion cannot be read
        run_pipeline(dive, run)
    assert json.loads((run / "summary.json").read_text()) == before


def refer_to(run: Path, reference: Path) -> None:
    """The run as if it had been scored against known poses."""
    document = json.loads((run / "summary.json").read_text())
    keys = stage_keys(document["input"]["fingerprint"], from_yaml(run / "settings.yaml"), reference)
    document["stages"]["eval"] |= {**keys["eval"].entry(None), "reference": str(reference)}
    (run / "summary.json").write_text(json.dumps(document))


def test_a_reference_is_the_same_from_another_folder(
    dive: Path, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    pretend_finished(run)
    known = tmp_path / "cameras.json"
    shutil.copy(dive / "truth" / "cameras.json", known)
    refer_to(run, known)
    monkeypatch.chdir(tmp_path)
    run_pipeline(dive, run, last_stage="prepare", reference=Path("cameras.json"))
    assert read_run(run).stages["eval"].reference == str(known)
    with pytest.raises(UsageError, match=r"reference: .*cameras\.json -> .*elsewhere\.json"):
        run_pipeline(dive, run, last_stage="prepare", reference=Path("elsewhere.json"))


def test_scores_against_a_reference_that_is_gone_are_kept_with_a_warning(
    dive: Path, run: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    pretend_finished(run)
    refer_to(run, tmp_path / "gone.json")
    before = json.loads((run / "summary.json").read_text())
    assert run_pipeline(dive, run, last_stage="prepare") == before
    assert "gone.json is not on this computer" in caplog.text
    shutil.rmtree(run / "renders")
    with pytest.raises(InputError, match=r"gone\.json"):  # the scores are to be taken again
        run_pipeline(dive, run)


def test_sections_of_stages_that_are_set_aside_are_not_shown_as_current(dive: Path, run: Path):
    pretend_finished(run)
    other = replace(FAST, splat=replace(FAST.splat, iterations=7))
    with pytest.raises(InputError):
        run_pipeline(dive, run, other, last_stage="splat", redo=True)
    summary = json.loads((run / "summary.json").read_text())
    assert {*SECTIONS["sfm"], "medium"} < set(summary)
    assert not set(summary) & {*SECTIONS["splat"], *SECTIONS["eval"]}
    assert summary["medium"] == {"sfm": {"Binf": [0.1]}}
    made = run_pipeline(dive, run, SMALLER, last_stage="prepare", redo=True)
    assert set(made) == {"schema", "input", "stages", "warnings"}
    assert made["warnings"] == []
    assert made["input"]["width"] == 32
    assert "rectified" not in made["input"]


def test_other_settings_are_refused_by_name_and_nothing_is_touched(dive: Path, run: Path):
    before = contents(run)
    with pytest.raises(UsageError, match=r"frames\.long_side: 960 -> 32") as refusal:
        run_pipeline(dive, run, SMALLER, last_stage="prepare")
    assert "--redo" in refusal.value.hint
    assert contents(run) == before


@pytest.mark.parametrize("status", ["done", "running"])
def test_a_later_stage_is_not_lost_to_other_settings(dive: Path, run: Path, status: str):
    """Finished or cut short."""
    pretend(run, "sfm", status)
    before = contents(run)
    other = replace(FAST, sfm=replace(FAST.sfm, overlap=7))
    with pytest.raises(UsageError, match=r"\(sfm\)(.|\n)*sfm.overlap: 10 -> 7"):
        run_pipeline(dive, run, other, last_stage="sfm")
    assert contents(run) == before


def test_redo_moves_superseded_stages_aside(dive: Path, run: Path):
    for stage in ("sfm", "splat", "eval"):
        pretend(run, stage)
    kept = {name: content for name, content in contents(run).items() if name.startswith(("prepare", "sfm"))}
    other = replace(FAST, splat=replace(FAST.splat, iterations=7))
    with pytest.raises(InputError):  # the pretended structure from motion cannot be read
        run_pipeline(dive, run, other, last_stage="splat", redo=True)
    now = contents(run)
    assert now["old/1/splat/map.safetensors"] == b"hours of work on splat"
    assert now["old/1/renders/test/0.png"] == b"hours of work on eval"
    assert "iterations: 2000" in now["old/1/settings.yaml"].decode()
    assert "iterations: 7" in now["settings.yaml"].decode()
    assert not (run / "splat").exists()
    assert all(now[name] == content for name, content in kept.items())
    assert sorted(json.loads(now["summary.json"])["stages"]) == ["prepare", "sfm"]


def test_every_redo_has_its_own_place(dive: Path, run: Path):
    for settings in (SMALLER, FAST):
        run_pipeline(dive, run, settings, last_stage="prepare", redo=True)
    assert sorted(path.name for path in (run / "old").iterdir()) == ["1", "2"]
    assert all((run / "old" / n / "prepare" / "frames.json").is_file() for n in "12")
    assert (run / "prepare" / "frames.json").is_file()


def test_without_settings_a_run_goes_on_with_its_own(dive: Path, run: Path):
    before = contents(run)
    run_pipeline(dive, run, last_stage="prepare")
    assert from_yaml(run / "settings.yaml") == FAST
    assert contents(run) == before


def test_a_part_of_the_pipeline_leaves_the_settings_of_later_stages(dive: Path, run: Path):
    other = replace(FAST, splat=replace(FAST.splat, iterations=7))
    run_pipeline(dive, run, other, last_stage="prepare")
    assert from_yaml(run / "settings.yaml").splat == FAST.splat


def test_a_stage_whose_folder_was_removed_is_made_again(dive: Path, run: Path):
    before = contents(run / "prepare")
    for path in (run / "prepare").iterdir():
        path.unlink()
    (run / "prepare").rmdir()
    run_pipeline(dive, run, last_stage="prepare")
    assert contents(run / "prepare") == before


@pytest.mark.parametrize(("made", "gone"), [("sfm", ["splat", "eval"]), ("splat", ["eval"]), ("prepare", [])])
def test_what_was_made_from_a_stage_is_not_done_once_it_is_made_again(
    dive: Path, run: Path, made: str, gone: list[str]
):
    """Not even where the run is killed before it comes to them."""
    pretend_finished(run)

    def killed() -> None:
        raise KeyboardInterrupt

    with open_record(run, dive, read_run(run).input.fingerprint) as record, pytest.raises(KeyboardInterrupt):
        record.stage(made, StageKey("key"), killed, lambda: None)
    kept = {"prepare", "sfm", "splat", "eval"} - set(gone)
    summary = json.loads((run / "summary.json").read_text())
    assert set(summary["stages"]) == kept
    shown = {stage for stage in SECTIONS if set(SECTIONS[stage]) <= set(summary)}
    assert shown == kept - {"prepare", made}
    assert set(summary.get("medium", {})) == {"sfm", "splat"} - {made, *gone}


def test_a_run_of_another_version_keeps_its_stages(dive: Path, run: Path, caplog: pytest.LogCaptureFixture):
    """A version with one more setting hashes the same settings to another key."""
    document = json.loads((run / "summary.json").read_text())
    document["stages"]["prepare"]["key"] = "0123456789abcdef"
    (run / "summary.json").write_text(json.dumps(document))
    before = (run / "prepare" / "frames.json").stat().st_mtime_ns
    run_pipeline(dive, run, last_stage="prepare")
    assert (run / "prepare" / "frames.json").stat().st_mtime_ns == before
    assert "another version" in caplog.text


@pytest.mark.parametrize("text", ["", "[]", "null", '{"input"', '{"input": {"path": "x", "fingerprint": "y"}}'])
def test_a_damaged_record_is_told_and_redo_starts_anew(dive: Path, run: Path, text: str):
    (run / "summary.json").write_text(text)
    with pytest.raises(InputError, match=r"summary.json is damaged"):
        run_pipeline(dive, run, last_stage="prepare")
    run_pipeline(dive, run, last_stage="prepare", redo=True)
    assert (run / "old" / "1" / "prepare" / "frames.json").is_file()
    assert read_run(run).is_finished("prepare")
    assert from_yaml(run / "settings.yaml") == FAST


@pytest.mark.parametrize("spoil", ["stages", "status"])
def test_a_record_that_is_not_what_it_should_be_is_told(run: Path, spoil: str):
    document = json.loads((run / "summary.json").read_text())
    if spoil == "stages":
        document["stages"] = []
    else:
        document["stages"]["prepare"] = {"status": "perhaps", "key": "x"}
    (run / "summary.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"summary.json"):
        read_run(run)


@pytest.mark.parametrize(("schema", "version"), [(1, "0.1.0"), (99, "7.0")])
def test_a_run_of_another_version_is_refused_with_the_version_that_wrote_it(run: Path, schema: int, version: str):
    for name, changes in {"summary.json": {"schema": schema}, "versions.json": {"swimm3r": version}}.items():
        document = json.loads((run / name).read_text()) | changes
        (run / name).write_text(json.dumps(document))
    with pytest.raises(InputError, match=rf"written by Swimm3R {version} \(schema {schema}\)") as refused:
        read_run(run)
    assert f"swimm3r=={version}" in refused.value.hint
    (run / "versions.json").unlink()
    with pytest.raises(InputError, match="of an unknown version"):
        read_run(run)


def test_only_one_process_works_in_a_run(dive: Path, run: Path):
    before = contents(run)
    with folder_lock(run), pytest.raises(UsageError, match=f"process {os.getpid()}"):
        run_pipeline(dive, run, last_stage="prepare")
    assert contents(run) == before


def test_drafts_of_a_killed_run_are_removed_at_the_next_start(dive: Path, run: Path):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    litter = run / "sfm" / f"{DRAFT}{ended.pid}-x.npz"
    of_another = run / f"{DRAFT}{os.getppid()}-x.png"  # written at this moment
    litter.parent.mkdir()
    litter.touch()
    of_another.touch()
    run_pipeline(dive, run, last_stage="prepare")
    assert not litter.exists()
    assert of_another.exists()


def test_an_input_that_is_refused_leaves_nothing(dive: Path, tmp_path: Path):
    few = tmp_path / "few"
    few.mkdir()
    (few / "a.png").write_bytes((dive / "images" / "0000.png").read_bytes())
    out = tmp_path / "new" / "deep" / "run"
    with pytest.raises(InputError, match="usable frame"):
        run_pipeline(few, out, last_stage="prepare")
    assert [path.name for path in tmp_path.iterdir()] == ["few"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="usable frame"):
        run_pipeline(few, tmp_path / "empty", last_stage="prepare")
    assert list((tmp_path / "empty").iterdir()) == []


def test_a_folder_in_the_place_of_a_record_is_told(dive: Path, tmp_path: Path):
    for name in ("settings.yaml", "log.jsonl"):
        run_pipeline(dive, tmp_path / name / "run", FAST, last_stage="prepare")
        (tmp_path / name / "run" / name).unlink()
        (tmp_path / name / "run" / name).mkdir()
        with pytest.raises(UsageError, match="it is a folder"):
            run_pipeline(dive, tmp_path / name / "run", FAST, last_stage="prepare")


def test_too_little_memory_is_told_before_a_stage_begins(dive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("swimm3r.pipeline.run_record.available_mb", lambda: 90.0)
    with pytest.raises(DeviceError, match="only 90 MB"):
        run_pipeline(dive, tmp_path / "run", FAST, last_stage="prepare")


def outcome(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    code = 0
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as stop:
        code = int(stop.code or 0)
    return code, capsys.readouterr().err


def test_the_command_line_goes_on_with_the_settings_of_the_folder(
    dive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "run"
    assert outcome(capsys, "prepare", dive, "--out", out, "--preset", "fast", "--long-side", 40)[0] == 0
    before = contents(out)
    for bare in (("prepare", dive, "--out", out), ("prepare", dive, f"--out={out}"), ("prepare", out)):
        assert outcome(capsys, *bare)[0] == 0
        assert contents(out) == before
    code, said = outcome(capsys, "prepare", out, "--preset", "default")
    assert code == 2
    assert "frames.long_side: 40 -> " in said
    code, said = outcome(capsys, "prepare", out, "--pick", "uniform")  # the others stay
    assert code == 2
    assert "pick" in said
    assert "long_side" not in said
    assert contents(out) == before
    assert outcome(capsys, "prepare", out, "--pick", "uniform", "--redo")[0] == 0
    assert from_yaml(out / "settings.yaml").frames.long_side == 40
    assert from_yaml(out / "settings.yaml").frames.pick == "uniform"


def test_a_new_run_needs_a_place(dive: Path, capsys: pytest.CaptureFixture[str]):
    code, said = outcome(capsys, "prepare", dive)
    assert code == 2
    assert "--out" in said


@pytest.mark.parametrize("empty", [("--out", ""), ("--out=",)])
def test_an_empty_place_is_not_the_current_folder(
    empty: tuple[str, ...], dive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert outcome(capsys, "prepare", dive, *empty)[0] == 2
    assert list(tmp_path.iterdir()) == []


def missing(run: Path) -> tuple[Path, str]:
    return run / "nowhere", "there is no"


def no_run(run: Path) -> tuple[Path, str]:
    return run / "prepare", "is no run folder"


def without_a_map(run: Path) -> tuple[Path, str]:
    return run, "has no finished map yet"


WITHOUT = [(command, folder) for command in ("export", "localize", "render", "eval") for folder in (missing, no_run)]
WITHOUT += [(command, without_a_map) for command in ("export", "localize", "render", "eval")]
WITHOUT += [("report", missing), ("report", no_run)]  # which needs no map


@pytest.mark.parametrize(("command", "folder"), WITHOUT)
def test_commands_on_a_folder_without_a_finished_run_say_what_is_not_there(
    command: str, folder: Callable[[Path], tuple[Path, str]], run: Path, capsys: pytest.CaptureFixture[str]
):
    path, what = folder(run)
    before = contents(run)
    code, said = outcome(capsys, command, path)
    assert code == 3
    assert what in said
    assert "damaged" not in said
    assert contents(run) == before


@pytest.mark.parametrize("command", ["render", "localize", "export", "bench", "train-sfm"])
def test_every_command_refuses_a_place_that_it_cannot_write_to(
    command: str, dive: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    pretend(run, "sfm")
    pretend(run, "splat")
    (tmp_path / "f").write_text("mine")
    (tmp_path / "d").mkdir()
    for path in ("d",) if command == "export" else ("f", "f/x"):
        words = {"bench": ("bench", "restoration", run), "train-sfm": ("train-sfm", dive)}.get(command, (command, run))
        code, said = outcome(capsys, *words, "--out", tmp_path / path)
        assert code == 2, said
        assert "cannot be written to" in said
    assert (tmp_path / "f").read_text() == "mine"


def test_bench_says_it_too(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for folder, what in (no_run(run), (run, "has no finished structure from motion yet")):
        code, said = outcome(capsys, "bench", "restoration", folder, "--out", tmp_path / "bench")
        assert code == 3
        assert what in said
    assert not (tmp_path / "bench").exists()


@pytest.mark.parametrize("name", ["versions.json", "settings.yaml"])
def test_the_report_says_what_is_missing(run: Path, name: str, capsys: pytest.CaptureFixture[str]):
    (run / name).unlink()
    code, said = outcome(capsys, "report", run)
    assert code == 3
    assert name in said


def test_the_report_says_that_a_number_is_missing(run: Path, capsys: pytest.CaptureFixture[str]):
    document = json.loads((run / "summary.json").read_text())
    del document["input"]["path"]
    (run / "summary.json").write_text(json.dumps(document))
    code, said = outcome(capsys, "report", run)
    assert code == 3
    assert "summary.json" in said
    assert "input: there is no" in said


def test_a_stage_that_is_done_is_open(run: Path):
    assert open_run(run, "prepare").stages["prepare"].status == "done"


def test_options_start_from_the_preset_that_is_named_else_from_the_folder():
    held = replace(FAST, splat=replace(FAST.splat, iterations=7))
    assert starting_settings(None, None, None, None) == PRESETS["default"]
    assert starting_settings("fast", None, None, held) == FAST
    assert starting_settings(None, "colmap", "uwbs-static", held) == held
    other = starting_settings(None, None, "ubs", held)
    assert other.splat.recipe == "ubs"
    assert (other.frames, other.sfm, other.test) == (held.frames, held.sfm, held.test)
    assert starting_settings(None, None, "uwbs-static", other).splat.recipe == "uwbs-static"
    assert "Mast3rSettings" in differences(held, starting_settings(None, "mast3r", None, held), ["sfm"])[0]


def test_differences_are_named_as_in_the_settings_file():
    other = replace(RunSettings(), splat=replace(RunSettings().splat, iterations=7, seed=3))
    told = differences(RunSettings(), other, ["prepare", "splat"])
    assert told == ["splat.iterations: 5000 -> 7", "splat.seed: 0 -> 3"]
