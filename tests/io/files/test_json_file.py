"""Strict reading of JSON records: every fault is told with the file and the place, and nothing else comes out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from swimm3r.errors import InputError, WeightsError
from swimm3r.io.files.damage import Remedy, remake
from swimm3r.io.files.json_file import read_json


@dataclass(frozen=True)
class Frame:
    name: str
    rows: tuple[tuple[float, float], ...]
    split: Literal["train", "test"] = "train"
    mask: str | None = None


@dataclass(frozen=True)
class Document:
    size: tuple[int, int]
    frames: tuple[Frame, ...]
    scores: dict[str, float]

    def __post_init__(self) -> None:
        if min(self.size) <= 0:
            raise ValueError(f"a size is positive, got {self.size}")


GOOD = '{"size": [4, 3], "frames": [{"name": "a", "rows": [[0, 1.5]]}], "scores": {"psnr": 20}}'


def written(folder: Path, text: str | bytes) -> Path:
    path = folder / "file.json"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_a_whole_file_becomes_its_record(tmp_path: Path):
    found = read_json(written(tmp_path, GOOD), Document, remake(tmp_path))
    assert found == Document((4, 3), (Frame("a", ((0.0, 1.5),)),), {"psnr": 20.0})


def test_keys_of_later_versions_are_ignored(tmp_path: Path):
    later = GOOD.replace('{"size"', '{"schema": 2, "size"')
    assert read_json(written(tmp_path, later), Document, remake(tmp_path)).size == (4, 3)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (GOOD[:-12], "line 1: "),
        (GOOD.replace(", ", ",\n")[:40], "line 3: "),
        ("", "line 1: Expecting value"),
        (b"\x82\x00", "not UTF-8"),
        ("[" * 100_000, "nested too deeply"),
        ('{"a":' * 100_000, "nested too deeply"),
        ("null", "an object is expected, got null"),
        ("[]", "an object is expected, got a list"),
        ('"text"', 'an object is expected, got a text ("text")'),
        ("{}", "there is no size"),
        (GOOD.replace("20", "NaN"), "scores.psnr: a finite number"),
        (GOOD.replace("20", "-Infinity"), "scores.psnr: a finite number"),
        (GOOD.replace("20", "1e999"), "scores.psnr: a finite number"),
        (GOOD.replace("20", "1" + "0" * 400), "scores.psnr: a finite number"),
        (GOOD.replace("20", "true"), "scores.psnr: a number is expected, got true"),
        (GOOD.replace("20", '"20"'), 'scores.psnr: a number is expected, got a text ("20")'),
        (GOOD.replace("[4, 3]", "[4]"), "size: 2 values are expected, got 1"),
        (GOOD.replace("[4, 3]", "[4, 3.5]"), "size[1]: a whole number is expected, got a number (3.5)"),
        (GOOD.replace("[4, 3]", "[4, -3]"), "a size is positive"),
        (GOOD.replace('"a"', "7"), "frames[0].name: a text is expected"),
        (GOOD.replace("1.5]", "null]"), "frames[0].rows[0][1]: a number is expected, got null"),
        (GOOD.replace('[{"name": "a"', '[{"nom": "a"'), "frames[0]: there is no name"),
        (GOOD.replace('"rows"', '"split": "val", "rows"'), "frames[0].split: one of train, test is expected"),
    ],
)
def test_a_fault_is_told_with_its_file_and_place(tmp_path: Path, text: str | bytes, said: str):
    path = written(tmp_path, text)
    with pytest.raises(InputError) as raised:
        read_json(path, Document, remake(tmp_path / "sfm"))
    assert str(path) in raised.value.what
    assert "is damaged (" in raised.value.what
    assert said in raised.value.what
    assert f"remove {tmp_path / 'sfm'}" in raised.value.hint


def test_a_file_that_is_not_there_is_missing(tmp_path: Path):
    with pytest.raises(InputError, match=r"nothing\.json is missing"):
        read_json(tmp_path / "nothing.json", Document, remake(tmp_path))


def test_a_folder_in_the_place_of_a_file_is_told(tmp_path: Path):
    with pytest.raises(InputError, match="is a folder"):
        read_json(tmp_path, Document, remake(tmp_path))


def test_the_remedy_chooses_the_error(tmp_path: Path):
    with pytest.raises(WeightsError, match="is damaged") as raised:
        read_json(
            written(tmp_path, "{"), Document, Remedy("get it again", cause="a broken download", error=WeightsError)
        )
    assert (raised.value.hint, raised.value.cause) == ("get it again", "a broken download")
