"""`swimm3r bench`: a protocol per sub-command, its table on the screen and in files, errors as everywhere."""

from pathlib import Path

import pytest

from swimm3r.bench.cells import Result
from swimm3r.bench.scores import columns
from swimm3r.bench.tables import Table
from swimm3r.cli.main import main


def test_a_protocol_prints_its_table_and_writes_it(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    main(["bench", "restoration", str(run), "--out", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "| as filmed | 1 |" in printed
    assert (tmp_path / "restoration.md").read_text() in printed
    assert {p.suffix for p in tmp_path.glob("restoration.*")} == {".md", ".csv", ".json", ".tex"}


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["render", "--out", "o"], 2, "nothing to measure"),
        (["render", "nowhere", "--out", "o"], 3, "there is no nowhere"),
        (["localization", "nowhere", "--out", "o"], 3, "there is no nowhere"),
        (["flsea", "nowhere", "--out", "o"], 3, "no data set was found"),
        (["sfm", "nowhere", "--out", "o"], 3, "there is no nowhere"),
        (["restoration", "nowhere", "--out", "o", "--jobs", "0"], 2, "--jobs"),
    ],
)
def test_mistakes_end_with_a_message_and_the_documented_code(
    arguments: list[str],
    code: int,
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(["bench", *arguments])
    assert stop.value.code == code
    assert says in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ([], "preset fast."),
        (["--preset", "paper"], "preset paper."),
        (["--preset", "paper", "--splat.iterations", "30"], "preset paper, changed by options."),
    ],
)
def test_the_table_names_the_preset_it_was_taken_under(
    options: list[str], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    cells = [Result("dive", "baseline", 0, {"psnr": 20.0})]
    monkeypatch.setattr(
        "swimm3r.bench.protocols.ablation_uwbs.ablate", lambda *_: Table("ablation", "T", cells, columns("psnr"))
    )
    main(["bench", "ablation-uwbs", "dive", "--out", str(tmp_path), *options])
    assert f"1 scene, 1 seed, {named}" in capsys.readouterr().out
