"""The dives of a batch: found in folders, by patterns and in tables; names, and errors that name the place."""

import errno
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from swimm3r.batch.dives import find_dives
from swimm3r.batch.sheet import read_sheet, with_settings
from swimm3r.errors import InputError, UsageError
from swimm3r.io.images import write_rgb
from swimm3r.pipeline.presets import PRESETS, RunSettings, from_yaml, to_yaml
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scene.settings import FrameSettings
from swimm3r.settings import SettingError, declarations
from swimm3r.sfm.settings import ColmapSettings, Mast3rSettings
from swimm3r.splat.settings import GaussianSettings

FAST = PRESETS["fast"]


def make_images(folder: Path, count: int = 3) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(count):
        write_rgb(folder / f"{k}.png", np.full((48, 64, 3), 40 * k, np.uint8))
    return folder


@pytest.fixture
def tapes(tmp_path: Path) -> Path:
    folder = tmp_path / "tapes"
    make_images(folder / "reef" / "images")
    make_images(folder / "wall")
    (folder / "papers").mkdir()
    (folder / "README.md").write_text("tapes")
    (folder / ".hidden").mkdir()
    return folder


def names(*given: Path, out: Path = Path("out")) -> list[str]:
    return [dive.name for dive in find_dives(given, FAST, out).dives]


def test_a_folder_stands_for_the_dives_in_it_and_the_others_are_listed_with_the_reason(tapes: Path):
    found = find_dives([tapes], FAST, tapes / "out")
    assert [(dive.name, dive.source, dive.settings) for dive in found.dives] == [
        ("reef", tapes / "reef", FAST),
        ("wall", tapes / "wall", FAST),
    ]
    assert [one.path.name for one in found.skipped] == ["README.md", "papers"]
    assert all(one.reason for one in found.skipped)


def test_single_dives_patterns_and_the_folder_of_the_images_itself(tapes: Path):
    assert names(tapes / "wall", tapes / "reef" / "images") == ["wall", "reef"]
    assert names(tapes / "*") == ["reef", "wall"]
    assert names(tapes / "w*") == ["wall"]


def test_folders_of_raw_files_and_of_stereo_pairs_are_dives_of_their_own(tmp_path: Path):
    for dive in ("north", "south"):
        (tmp_path / dive).mkdir()
        for k in range(3):
            (tmp_path / dive / f"{k}.NEF").write_bytes(b"raw")
    for side in ("left", "right"):
        make_images(tmp_path / "pair" / side)
        make_images(tmp_path / "rig" / f"cam_{side}")
    assert names(tmp_path) == ["north", "pair", "south"]
    of_rig = replace(FAST, frames=replace(FAST.frames, rig=("cam_left", "cam_right")))
    assert [dive.name for dive in find_dives([tmp_path], of_rig, Path("out")).dives] == ["north", "rig", "south"]


def test_a_folder_that_may_not_be_searched_is_left_out(tapes: Path, monkeypatch: pytest.MonkeyPatch):
    def iterdir(folder: Path) -> Iterator[Path]:
        if folder.name == "lost+found":  # permissions do not bind the user root
            raise PermissionError(errno.EACCES, "Permission denied", str(folder))
        return iter([folder / name for name in os.listdir(folder)])

    (tapes / "lost+found").mkdir()
    monkeypatch.setattr(Path, "iterdir", iterdir)
    found = find_dives([tapes], FAST, tapes / "out")
    assert [dive.name for dive in found.dives] == ["reef", "wall"]
    assert {one.path.name: one.reason for one in found.skipped}["lost+found"] == "it cannot be read: Permission denied"


def test_runs_and_results_among_the_dives_are_no_dives(tapes: Path):
    out = make_images(tapes / "out")
    (make_images(tapes / "run") / "summary.json").write_text("{}")
    found = find_dives([tapes], FAST, out)
    assert [dive.name for dive in found.dives] == ["reef", "wall"]
    reasons = {one.path.name: one.reason for one in found.skipped}
    assert reasons["run"] == "it is the folder of a run"
    assert reasons["out"] == "it is the folder of the results"


def test_dives_of_one_name_get_that_of_the_folder_above(tapes: Path, tmp_path: Path):
    make_images(tmp_path / "second" / "wall")
    assert names(tapes / "wall", tmp_path / "second" / "wall") == ["tapes-wall", "second-wall"]
    with pytest.raises(UsageError, match="two dives are called"):
        names(tapes / "wall", tapes / "wall")


def test_a_path_that_leads_nowhere_and_a_folder_without_dives_are_refused(tapes: Path):
    for path in (tapes / "shipwreck", tapes / "ship*"):
        with pytest.raises(InputError, match=r"there is no .*ship"):
            names(tapes, path)
    with pytest.raises(InputError, match="no dive in"):
        names(tapes / "papers")
    with pytest.raises(UsageError, match="'logs'"):
        names(make_images(tapes / "logs"))


def sheet(folder: Path, text: str) -> Path:
    path = folder / "dives.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_table_gives_each_dive_its_name_preset_and_settings(tapes: Path):
    path = sheet(
        tapes,
        "dive,name,preset,fps,splat.iterations,masks,reference,sfm.depth.long_side\n"
        "reef/images,Riff 1,best,2,,masks/reef,truth.json,\n"
        "\n"
        "wall,,,,700,,,320\n",
    )
    first, second = find_dives([path], FAST, tapes / "out", Path("known.json")).dives
    assert (first.name, first.source, first.reference) == ("Riff 1", tapes / "reef" / "images", tapes / "truth.json")
    assert first.settings.frames.fps == 2
    assert first.settings.frames.masks == tapes / "masks" / "reef"
    assert first.settings.splat == PRESETS["best"].splat
    assert (second.name, second.source, second.reference) == ("wall", tapes / "wall", Path("known.json"))
    assert second.settings.splat.iterations == 700
    assert isinstance(second.settings.sfm, ColmapSettings)
    assert second.settings.sfm.depth.long_side == 320
    assert second.settings.frames == FAST.frames


def test_back_ends_and_recipes_have_columns_and_spreadsheets_may_use_semicolons(tapes: Path):
    path = sheet(tapes, "\ufeffdive;backend;recipe\nwall;mast3r;\nreef;;mcmc_gs\n")
    first, second = read_sheet(path, FAST)
    assert isinstance(first.settings.sfm, Mast3rSettings)
    assert isinstance(second.settings.splat, GaussianSettings)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "no column `dive`"),
        ("name,fps\na,1\n", "no column `dive`"),
        ("dive,fsp\nwall,1\n", "no settings: 'fsp'"),
        ("dive,splatt.iterations\nwall,1\n", "splatt.iterations"),
        ("dive,splat.iteration\nwall,1\n", "line 2: there is no setting splat.iteration"),
        ("dive,splat.depth.long_side\nwall,1\n", "line 2: there is no setting splat.depth"),
        ("dive,fps\nwall,1\nreef,often\n", "line 3: frames.fps must be"),
        ("dive,preset\nwall,fastest\n", "line 2: preset must be one of fast"),
        ("dive,name\n,reef\n", "line 2: it names no dive"),
        ("dive,start,end\nwall,5,2\n", "line 2: end .* is not after start"),
        ("dive,fps,fps\nwall,1,2\n", "two columns of one name"),
        ("dive,name\nwall,a/b\n", "cannot be called 'a/b'"),
        ("dive,markers\nwall,\nreef,aruco-4x4-50\n", "line 3: markers of aruco-4x4-50 .* size is not given"),
        ("dive,nav_std\nwall,0.1 0.1\n", "line 2: scale.nav_std must be 3 values"),
        ("dive,scale\nwall,markers\n", "line 2: there is no setting scale"),
        ("dive\nwall\nwall\n", "two dives are called wall"),
    ],
)
def test_a_table_that_cannot_be_used_is_refused_with_its_line(tapes: Path, text: str, expected: str):
    with pytest.raises(UsageError, match=expected) as refused:
        read_sheet(sheet(tapes, text), FAST)
    assert refused.value.hint


def test_a_slip_in_a_column_is_told_with_the_name_that_was_meant(tapes: Path):
    with pytest.raises(UsageError) as refused:
        read_sheet(sheet(tapes, "dive,fsp\nwall,1\n"), FAST)
    assert "similar: fps" in refused.value.cause


def test_a_table_that_is_none_is_refused(tapes: Path):
    path = tapes / "dives.csv"
    path.write_bytes(b"dive,fps\n\xff\xfe")
    with pytest.raises(InputError, match="not UTF-8"):
        read_sheet(path, FAST)
    path.write_text('dive,fps\n"wall"x,1\n')
    with pytest.raises(InputError, match="cannot be used"):
        read_sheet(path, FAST)


def changed(name: str, text: str, settings: RunSettings = FAST) -> RunSettings:
    return with_settings(settings, {name: text}, Path())


def test_texts_that_look_like_numbers_stay_texts_where_a_text_is_expected():
    assert changed("frames.masks", "2024").frames.masks == Path("2024")
    assert changed("frames.end", "12").frames.end == 12
    with pytest.raises(SettingError, match=r"frames\.fps"):
        changed("frames.fps", "-1")


def test_what_a_dive_of_a_table_runs_with_is_what_settings_yaml_says(tmp_path: Path):
    settings = changed("splat.densify.cap_max", "1234")
    path = tmp_path / "settings.yaml"
    path.write_text(to_yaml(settings))
    assert from_yaml(path) == settings
    assert settings != FAST


def test_a_table_gives_each_dive_its_sources_of_scale(tapes: Path):
    bar = "0.png:10,20 0.png:30,22 1.png:14,25 1.png:35,28 0.5"
    path = sheet(
        tapes,
        "dive,preset,nav,nav_offset,nav_std,markers,marker_size,scale_bar,scale.baseline\n"
        "reef,best,logs/reef.csv,0.3,0.1 0.1 0.02,aruco-4x4-50,0.2,,\n"
        f'wall,,,,,,,"{bar}",0.1\n',
    )
    everywhere = replace(FAST, scale=ScaleSettings(camera_height=1.5))
    first, second = (dive.settings.scale for dive in read_sheet(path, everywhere))
    assert first == ScaleSettings(
        camera_height=1.5, nav=tapes / "logs" / "reef.csv", nav_offset=0.3, nav_std=(0.1, 0.1, 0.02),
        markers="aruco-4x4-50", marker_size=0.2,
    )  # fmt: skip
    assert second == ScaleSettings(camera_height=1.5, scale_bar=tuple(bar.split()), baseline=0.1)


def test_paths_of_a_table_hold_wherever_the_command_is_repeated(tapes: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tapes)
    sheet(tapes, "dive,nav\nreef,reef.csv\n")
    (dive,) = read_sheet(Path("dives.csv"), FAST)
    assert dive.settings.scale.nav == tapes / "reef.csv"


def test_columns_without_a_dot_name_one_setting():
    short = [*declarations(FrameSettings), *declarations(ScaleSettings)]
    own = ["dive", "name", "preset", "backend", "recipe", "reference"]
    assert len(set(short + own)) == len(short + own)
