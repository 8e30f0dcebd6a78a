"""The page of a run as text: what it says of which run, and that it is one file."""

import base64
import json
import re
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path, PurePosixPath
from typing import get_args
from urllib.parse import unquote

import numpy as np
import pytest
from tests.report.conftest import COUNT, NAMES

from swimm3r.errors import InputError
from swimm3r.export.settings import ExportSettings
from swimm3r.prepare import load_frames
from swimm3r.report import water, write_report
from swimm3r.report.head import clock
from swimm3r.report.outputs import FURTHER, OUTPUTS, human_size, outputs_of
from swimm3r.report.scene import pack_scene
from swimm3r.report.scores import truth_rows
from swimm3r.scene.reconstruction import QualityWarning
from swimm3r.scene.reconstruction_io import load_reconstruction


@pytest.fixture(scope="module")
def page(finished: Path) -> str:
    return write_report(finished).read_text(encoding="utf-8")


class _Tags(HTMLParser):
    """Every tag with its attributes."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def named(self, *names: str) -> list[dict[str, str | None]]:
        return [attributes for tag, attributes in self.found if tag in names]


def text_of(page: str) -> str:
    """The words that are read, without scripts, styles and tags."""
    bare = re.sub(r"<(script|style)\b.*?</\1>", "", page, flags=re.DOTALL)
    return " ".join(unescape(re.sub(r"<[^>]+>", " ", bare)).split())


def test_the_page_is_one_file_that_asks_for_nothing(page: str):
    tags = _Tags(page)
    for attributes in tags.named("img", "video", "script", "iframe", "source", "link"):
        for name in ("src", "href", "poster"):
            value = attributes.get(name) or ""
            assert value.startswith("data:") or not value, value[:80]
    assert "url(" not in page
    assert "@import" not in page
    assert not re.findall(r"https?://", page)


def test_the_verdict_comes_before_everything_else(page: str):
    text = text_of(page)
    verdict = "Attenuation is determined in red only; red loses half of its light in 1.39 \u00b1 0.06 scene units."
    assert 0 < text.index(verdict) < text.index("Before you use these results") < text.index("The scene in 3D")
    assert text.index("The path is <one> straight line. Swim a loop.") < text.index("The scene in 3D")


def test_names_with_markup_stay_text(page: str):
    assert "<wall>" not in page
    assert "<one>" not in page
    assert "reef & <wall>" in text_of(page)


def test_a_frame_name_cannot_end_the_script(make_run: Callable[..., Path]):
    folder = make_run()
    frames = load_frames(folder / "prepare")
    rec = load_reconstruction(folder / "sfm", frames)
    names = tuple(f"</script>{i}" for i in range(len(rec.names)))
    renamed = tuple(replace(frame, name=name) for frame, name in zip(frames.train, names, strict=True))
    scene = pack_scene(replace(rec, names=names), replace(frames, frames=renamed))
    assert scene is not None
    assert "<" not in scene.header
    assert json.loads(scene.header)["cameras"][1]["name"].startswith("</script>1")


def test_the_date_is_that_of_the_recording_or_said_not_to_be(page: str, make_run: Callable[..., Path]):
    assert "recorded on 3 May 2024, 10:21 by the camera's clock" in text_of(page)
    other = text_of(write_report(make_run()).read_text(encoding="utf-8"))
    assert "processed on 22 November 2026, 17:12; the files do not state when they were recorded" in other


def test_times_are_shown_where_frames_have_any(page: str, make_run: Callable[..., Path]):
    assert f"{NAMES[1]}, 0.2 s" in text_of(page)
    assert f"{COUNT} frames of 96 \u00d7 64 pixels over 1.8 s; 8 used, 2 held back" in text_of(page)
    numbered = text_of(write_report(make_run(times=False)).read_text(encoding="utf-8"))
    assert NAMES[1] in numbered
    assert f"{NAMES[1]}," not in numbered
    assert "pixels;" in numbered


def test_no_key_of_the_summary_is_shown_as_it_is(page: str):
    text = text_of(page)
    for key in ("reprojection_px", "epipolar_px", "rotation_deg", "depth_absrel", "clear_psnr", "blur4", "T_D_abs"):
        assert key not in text
    for name in ("Reprojection error", "Rotation between frames, mean error", "Colors without the water, PSNR"):
        assert name in text


def test_a_map_whose_test_frames_could_not_be_placed_has_no_scores(make_run: Callable[..., Path]):
    folder = make_run()
    summary = json.loads((folder / "summary.json").read_text())
    nothing = dict.fromkeys(("psnr", "ssim", "lpips", "blur4_psnr", "sharpness", "observed", "flow_px"))
    names = [frame.name for frame in load_frames(folder / "prepare").test]
    scores = {"views": 0, "psnr_reason": "none of them could be placed", "unplaced": names, "frames": []}
    summary["test"] = nothing | scores | {"protocol": "every 8th frame; none could be placed"}
    (folder / "summary.json").write_text(json.dumps(summary))
    text = text_of(write_report(folder).read_text(encoding="utf-8"))
    assert "none of them could be placed" in text
    assert "\u2013 dB" not in text
    assert "Primitives" in text


def test_every_score_against_the_truth_has_a_name(finished: Path):
    truth = json.loads((finished / "summary.json").read_text())["truth"]
    rows = {row.label: row for row in truth_rows(truth)}
    assert len(rows) == 3 + len(truth["sfm"])
    assert rows["Depth, mean relative error"].of_sfm == "0.97 %"
    assert rows["Backscatter rate beta_B, relative error (red, green, blue)"].of_map == "not determined"


def test_every_image_has_a_text_in_its_place(page: str):
    tags = _Tags(page).named("img")
    assert len(tags) > 8
    assert all("alt" in attributes for attributes in tags)
    described = [a for a in tags if a.get("src") and a.get("class") != "poster"]
    assert all(attributes["alt"] for attributes in described)
    assert all(
        a.get("aria-label") or a.get("id") == "scene"
        for a in _Tags(page).named("canvas", "svg", "video")
        if a.get("class") != "overlay"
    )


def test_links_lead_to_files_that_are_there_with_their_size(finished: Path, page: str):
    hrefs = [a["href"] for a in _Tags(page).named("a")]
    assert "sfm/points.ply" in hrefs
    assert "prepare/" in hrefs
    assert all((finished / unquote(href or "nowhere")).exists() for href in hrefs)
    sizes = {output.path: output for output in outputs_of(finished)}
    assert sizes["splat/map.safetensors"].size == "1.2 kB"
    assert sizes["prepare/"].files == COUNT + 1
    assert not set(sizes) & {"renders/flythrough.mp4", "splat/cameras.json"}


def test_what_later_commands_add_is_listed_too(make_run: Callable[..., Path]):
    folder = make_run()
    places = [
        "splat/gaussians.ply",
        "splat/gaussians_physical.spz",
        "export/trajectory.tum",
        "export/colmap/sparse/0/a.bin",
    ]
    places += ["sfm/points_raw.glb", "renders/views/mine/view.png", "localization/poses.json"]
    for place in places:
        (folder / place).parent.mkdir(parents=True, exist_ok=True)
        (folder / place).write_bytes(b"1234567")
    listed = {output.path: output.size for output in outputs_of(folder)}
    for place in places:
        assert any(place == path or (path.endswith("/") and place.startswith(path)) for path in listed), place
    assert listed["export/colmap/"] == "7 bytes"


def test_every_format_exported_into_the_run_folder_is_listed():
    for kind in get_args(ExportSettings):
        place = PurePosixPath(kind().file_name)
        assert str(place) in OUTPUTS or any(place.match(pattern) for pattern in FURTHER), place


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0 bytes"), (999, "999 bytes"), (1000, "1.0 kB"), (13_600, "14 kB"), (999_900, "1.0 MB"), (2.5e9, "2.5 GB")],
)
def test_sizes_are_read_by_people(count: float, text: str):
    assert human_size(int(count)) == text


@pytest.mark.parametrize(
    ("seconds", "text"), [(4.21, "4.2 s"), (59.99, "60.0 s"), (185, "3:05 min"), (3723, "1:02:03 h")]
)
def test_times_are_read_by_people(seconds: float, text: str):
    assert clock(seconds) == text


def test_water_that_is_not_determined_is_said_in_every_place(make_run: Callable[..., Path]):
    text = text_of(write_report(make_run(determined=(False,) * 3, attenuation_std=5.0)).read_text(encoding="utf-8"))
    assert "Attenuation is not determined in any color channel" in text
    assert "left as filmed: the water is not determined" in text
    assert "The water is not determined: these are the colors as filmed." in text
    assert "its curve is one of many that fit" in text


def test_coefficients_that_are_not_determined_stand_in_brackets(page: str):
    text = text_of(page)
    assert re.search(r"0\.500 \u00b1 0\.020 \(0\.160 \u00b1 0\.020\) \(0\.100 \u00b1 0\.020\)", text)


@pytest.mark.parametrize(
    ("std", "text"), [(0.29, "0.12 \u00b1 0.29"), (0.0028, "0.1234 \u00b1 0.0028"), (1e-9, "0.12341 \u00b1 0.00000")]
)
def test_coefficients_have_two_digits_of_their_deviation(std: float, text: str):
    assert water._with_std(0.12341, std) == text


def test_a_metric_run_has_metres_and_a_run_without_scale_has_none(make_run: Callable[..., Path], page: str):
    metric = text_of(write_report(make_run(metric=True)).read_text(encoding="utf-8"))
    assert "1.39 \u00b1 0.06 m." in metric
    assert "Depth in metres" in metric
    assert "scene unit" not in metric
    assert "Depth in scene units" in text_of(page)
    assert not re.search(r"\d m\b(?! )", text_of(page))


def test_a_run_without_water_shows_its_points_and_says_so(make_run: Callable[..., Path]):
    page = write_report(make_run(water=False, stage="sfm")).read_text(encoding="utf-8")
    assert "The water was not estimated." in text_of(page)
    assert 'id="scene-data"' in page
    assert "without the water" not in text_of(page)


def test_prepared_frames_alone_have_a_page(make_run: Callable[..., Path]):
    page = write_report(make_run(stage="prepare")).read_text(encoding="utf-8")
    assert "no structure from motion yet" in text_of(page)
    assert 'id="scene"' not in page
    assert NAMES[0] in page


def test_the_scene_holds_points_in_both_colors_and_the_cameras(page: str):
    header = json.loads(re.search(r'id="scene-header">(.*?)</script>', page).group(1))
    data = base64.b64decode(re.search(r'id="scene-data">(.*?)</script>', page).group(1))
    n = header["points"]
    assert n == 4000
    assert len(data) == 12 * n
    cells = np.frombuffer(data, "<u2", 3 * n).reshape(n, 3)
    xyz = header["low"] + cells / 65535 * header["side"]
    assert np.abs(xyz[:, 2]).max() < 4.1
    assert np.ptp(xyz[:, 0]) == pytest.approx(8, abs=0.1)
    filmed, restored = np.frombuffer(data, "u1", 6 * n, 6 * n).reshape(2, n, 3)
    assert filmed[:, 0].mean() < restored[:, 0].mean() / 2
    assert [camera["name"] for camera in header["cameras"]] == [f"{n}, {i / 5} s" for i, n in enumerate(NAMES) if i % 8]
    assert header["up"][2] < -0.9  # the floor lies at larger z than the cameras


def test_a_large_cloud_is_thinned_below_five_megabytes(make_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch):
    from swimm3r.report import scene

    assert scene._MOST_POINTS * 12 * 4 / 3 < 5e6
    monkeypatch.setattr(scene, "_MOST_POINTS", 1000)
    page = write_report(make_run()).read_text(encoding="utf-8")
    assert "1,000 of 4,000 points are drawn" in text_of(page)


def test_warnings_of_the_run_are_the_warnings_of_the_page(make_run: Callable[..., Path]):
    folder = make_run(warnings=(QualityWarning("One.", ""), QualityWarning("Two.", "Do three.")))
    assert "One. Two. Do three." in text_of(write_report(folder).read_text(encoding="utf-8"))


def test_commands_in_warnings_are_set_as_commands_and_nothing_else_is_markup(make_run: Callable[..., Path]):
    folder = make_run(warnings=(QualityWarning("Depth < 1 m.", "`--flicker keep` takes the <frames> as filmed."),))
    page = write_report(folder).read_text(encoding="utf-8")
    assert "<code>--flicker keep</code> takes the &lt;frames&gt; as filmed." in page
    assert "Depth &lt; 1 m." in page


@pytest.mark.parametrize("section", ["stages", "test", "sfm", "truth"])
def test_a_summary_of_another_form_is_damaged_and_named(make_run: Callable[..., Path], section: str):
    folder = make_run()
    summary = json.loads((folder / "summary.json").read_text())
    summary[section] = {"other": 1} if section != "truth" else ["other"]
    (folder / "summary.json").write_text(json.dumps(summary))
    with pytest.raises(InputError, match=r"summary\.json"):
        write_report(folder)


def test_outputs_have_distinct_words():
    assert len(set(OUTPUTS.values())) == len(OUTPUTS)
