"""Every back end makes the same lens of the same numbers, and refuses the same slips."""

import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from swimm3r.cameras import Cameras
from swimm3r.errors import InputError, UsageError
from swimm3r.refraction.settings import PortSettings
from swimm3r.sfm.colmap.calibration.start import first_camera
from swimm3r.sfm.lens import (
    behind_port,
    check_calibration,
    check_lens_settings,
    gives_lens,
    known_lens,
    lens_of,
    with_calibration,
)
from swimm3r.sfm.settings import ColmapModelSettings, ColmapSettings, LensSettings, Mast3rSettings

GIVEN: dict[str, Any] = {"focal": 900.0, "k1": -0.1, "p2": 0.002}


@pytest.mark.parametrize("settings", [ColmapSettings(**GIVEN), Mast3rSettings(**GIVEN)])
def test_a_lens_has_the_numbers_that_are_given_in_the_order_of_its_model(settings: LensSettings):
    lens = lens_of(settings, "OPENCV", 1280, 720, 900.0, k1=0.03)
    assert lens.distortion.tolist() == [[-0.1, 0.0, 0.0, 0.002]]
    assert lens.K[0].tolist() == [[900, 0, 640], [0, 900, 360], [0, 0, 1]]
    assert torch.equal(lens.cam2world[0], torch.eye(4, dtype=torch.float64))


def test_the_assumed_distortion_gives_way_to_one_that_is_given():
    assert lens_of(LensSettings(), "SIMPLE_RADIAL", 640, 480, 500.0, k1=0.03).distortion.tolist() == [[0.03]]
    assert lens_of(LensSettings(k1=0.0), "SIMPLE_RADIAL", 640, 480, 500.0, k1=0.03).distortion.tolist() == [[0.0]]


@pytest.mark.parametrize(
    ("change", "model", "message"),
    [
        ({"k3": 0.1}, "OPENCV", "OPENCV has no k3"),
        ({"k1": 0.1}, "PINHOLE", "PINHOLE has no k1"),
        ({"focal": 4.2}, "OPENCV", "does not fit images 640 px wide"),
        ({"focal": 640.0, "fy": 64000.0}, "OPENCV", "does not fit images 640 px wide"),
        ({"focal": 640.0, "cx": 960.0}, "OPENCV", r"\(960.0, middle\) is outside images of 640x480"),
    ],
)
def test_numbers_of_another_lens_are_refused(change: dict[str, float], model: str, message: str):
    with pytest.raises(UsageError, match=message):
        check_lens_settings(replace(LensSettings(), **change), model, 640, 480)


LINES = {  # of COLMAP's cameras.txt
    "OPENCV": "1 OPENCV 1280 720 900 910 650 350 -0.1 0.02 0.001 0.002",
    "OPENCV_FISHEYE": "1 OPENCV_FISHEYE 1280 720 600 610 650 350 0.05 0.02 -0.01 0.002",
    "SIMPLE_RADIAL": "1 SIMPLE_RADIAL 1280 720 900 650 350 -0.1",
    "PINHOLE": "1 PINHOLE 1280 720 900 910 650 350",
}


@pytest.fixture(params=LINES)
def calibrated(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path]:
    (tmp_path / "cameras.txt").write_text(LINES[request.param])
    return request.param, tmp_path / "cameras.txt"


def test_mapping_begins_with_the_lens_of_a_calibration_at_the_size_of_the_frames(calibrated: tuple[str, Path]):
    model, path = calibrated
    settings = with_calibration(ColmapSettings(calibration=path, intrinsics="fixed"), 640, 360)
    camera = first_camera(640, 360, settings)
    numbers = [float(word) for word in LINES[model].split()[4:]]
    lens = 3 if model == "SIMPLE_RADIAL" else 4
    expected = [value / 2 for value in numbers[:lens]] + numbers[lens:]
    if model == "PINHOLE":  # of two focal lengths, which SIMPLE_RADIAL has not
        model, expected = "OPENCV", [*expected, 0.0, 0.0, 0.0, 0.0]
    assert camera.model.name == model
    assert camera.params.tolist() == expected
    assert camera.has_prior_focal_length


def test_the_network_gets_the_lens_of_a_calibration(calibrated: tuple[str, Path]):
    model, path = calibrated
    settings = with_calibration(Mast3rSettings(calibration=path), 640, 360)
    assert settings.focal is not None
    check_lens_settings(settings, settings.camera, 640, 360)
    lens = lens_of(settings, settings.camera, 640, 360, settings.focal)
    assert settings.camera == model
    assert (lens.K[0, 0, 2], lens.K[0, 1, 2]) == (325, 175)


@pytest.mark.parametrize("backend", ["colmap", "mast3r"])
def test_a_flat_port_multiplies_both_focal_lengths_of_a_calibration(tmp_path: Path, backend: str):
    (tmp_path / "a").write_text(LINES["OPENCV"])
    given: dict[str, Any] = {"calibration": tmp_path / "a", "housing": "flat"}
    in_air: Any
    if backend == "colmap":
        in_air = with_calibration(ColmapSettings(**given), 1280, 720)
    else:
        in_air = with_calibration(Mast3rSettings(**given), 1280, 720)
    settings, housed = behind_port(in_air, 1280, 720)
    assert housed is not None
    assert (settings.cx, settings.cy) == (650, 350)
    assert [settings.focal, settings.fy] == pytest.approx([900 * 1.333, 910 * 1.333], rel=2e-3)
    assert settings.k1 != in_air.k1


def test_a_lens_unknown_in_air_stays_unknown_behind_a_port():
    settings = ColmapSettings(housing="flat")
    assert behind_port(settings, 640, 480) == (settings, None)


def test_a_dome_that_hides_the_view_is_refused():
    settings = ColmapSettings(housing="dome", focal=100.0, port=PortSettings(distance=0.3, radius=0.02))
    with pytest.raises(UsageError, match="no image through this dome port"):
        behind_port(settings, 640, 480)


def test_the_lens_of_a_calibration_is_printed_in_pixels_of_the_frames(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    (tmp_path / "a").write_text(LINES["OPENCV"])
    with caplog.at_level(logging.INFO, "swimm3r"):
        with_calibration(ColmapSettings(calibration=tmp_path / "a"), 640, 360)
    said = "in frames of 640x360: OPENCV, fx 450.00, fy 455.00, cx 325.00, cy 175.00 px, k1 -0.1, k2 0.02"
    assert said in caplog.text


def test_settings_without_a_calibration_stay_as_they_are():
    settings = ColmapSettings(**GIVEN)
    assert with_calibration(settings, 1280, 720) is settings
    check_calibration(settings)


@pytest.mark.parametrize("kind", [ColmapSettings, Mast3rSettings])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"calibration": Path("a.yaml"), "focal": 900.0}, "--calibration and --focal exclude each other"),
        ({"calibration": Path("a.yaml"), "k1": 0.0}, "--calibration and --k1 exclude each other"),
        ({"calibration_camera": "cam0"}, "--calibration-camera needs --calibration"),
        ({"calibration_size": (640, 480)}, "--calibration-size needs --calibration"),
        ({"cx": 320.0}, "--cx needs --focal"),
    ],
)
def test_settings_of_a_lens_that_contradict_each_other_are_refused(kind: type, change: dict[str, Any], message: str):
    with pytest.raises(UsageError, match=message):
        check_calibration(kind(**change))


def test_another_camera_model_than_that_of_the_calibration_is_refused(tmp_path: Path):
    (tmp_path / "a").write_text(LINES["OPENCV"])
    settings = ColmapSettings(calibration=tmp_path / "a", camera="SIMPLE_RADIAL")
    with pytest.raises(UsageError, match="of the model OPENCV, and --camera says SIMPLE_RADIAL"):
        with_calibration(settings, 1280, 720)
    (tmp_path / "a").write_text(LINES["SIMPLE_RADIAL"])
    wider = with_calibration(ColmapSettings(calibration=tmp_path / "a", camera="OPENCV"), 1280, 720)
    assert (wider.k1, wider.k2, wider.p1, wider.p2) == (-0.1, 0.0, 0.0, 0.0)


def test_a_calibration_that_cannot_be_used_is_refused_before_any_frame_is_read(tmp_path: Path):
    (tmp_path / "a").write_text("not a calibration")
    with pytest.raises(InputError, match="cannot be read as a calibration"):
        check_calibration(ColmapSettings(calibration=tmp_path / "a"))


def test_the_lens_that_is_known_before_frames_are_placed_is_that_of_their_size_in_water(tmp_path: Path):
    (tmp_path / "cameras.txt").write_text(LINES["PINHOLE"])
    stated = tmp_path / "cameras.txt"
    assert known_lens(ColmapSettings(), 640, 360) is None
    assert known_lens(ColmapModelSettings(stated), 640, 360) is None
    given = known_lens(ColmapSettings(focal=700.0, k1=0.1), 640, 360, stated)
    of_source = known_lens(Mast3rSettings(), 640, 360, stated)
    housed = known_lens(ColmapSettings(calibration=stated, housing="flat"), 640, 360)
    assert given is not None
    assert of_source is not None
    assert housed is not None
    assert (given.K[0, 0, 0], given.distortion.tolist()) == (700, [[0.1]])
    assert of_source.K[0, 0, 0] == 450
    assert housed.K[0, 0, 0] > 1.3 * 450


def run_with_lens(folder: Path, focal: float, frames: int, size: tuple[int, int] = (1280, 720)) -> Path:
    """A run folder whose cameras have this lens."""
    K = torch.tensor([[focal, 0, 640.0], [0, 0.75 * focal, 350.0], [0, 0, 1]], dtype=torch.float64)
    distortion = torch.tensor([[0.05, 0.01, 0.002, -0.003]], dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1)
    cameras = Cameras(K.repeat(frames, 1, 1), distortion.repeat(frames, 1), poses, *size, "OPENCV")
    cameras.save(folder / "sfm" / "cameras.json", [f"{i}.png" for i in range(frames)])
    return folder


@pytest.mark.parametrize("kind", [ColmapSettings, Mast3rSettings])
def test_the_lens_of_a_run_is_held_at_the_size_of_the_frames(tmp_path: Path, kind: Any):
    run = run_with_lens(tmp_path / "run", 900.0, 3)
    settings = with_calibration(kind(lens_from=run), 640, 360)
    found = settings.focal, settings.fy, settings.cx, settings.cy
    assert found == pytest.approx((450, 337.5, 320, 175))
    assert (settings.k1, settings.k2, settings.p1, settings.p2) == (0.05, 0.01, 0.002, -0.003)
    assert settings.lens_from is None
    assert gives_lens(kind(lens_from=run))
    if kind is ColmapSettings:
        assert settings.intrinsics == "fixed"
        assert first_camera(640, 360, settings).params.tolist() == pytest.approx([*found, 0.05, 0.01, 0.002, -0.003])


def test_of_a_folder_of_runs_the_one_with_the_most_frames_in_place_has_the_lens(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    for name, focal, frames in (("a", 800.0, 2), ("b", 900.0, 5), ("c", 700.0, 3)):
        run_with_lens(tmp_path / name, focal, frames)
    (tmp_path / "logs").mkdir()
    with caplog.at_level(logging.INFO, "swimm3r"):
        assert with_calibration(ColmapSettings(lens_from=tmp_path), 1280, 720).focal == 900
    assert "lens of the run b, with the most frames in place" in caplog.text
    assert "a 0.625, b 0.703, c 0.547" in caplog.text


def test_runs_without_a_lens_and_frames_of_another_shape_are_refused(tmp_path: Path):
    with pytest.raises(UsageError, match="neither a run with a lens nor a folder of such runs"):
        check_calibration(ColmapSettings(lens_from=tmp_path))
    run = run_with_lens(tmp_path / "run", 900.0, 3)
    check_calibration(ColmapSettings(lens_from=run))
    with pytest.raises(InputError, match="is of images of 1280x720"):
        with_calibration(ColmapSettings(lens_from=run), 640, 480)
    (run / "sfm" / "cameras.json").write_text("{}")
    with pytest.raises(InputError, match=r"cameras\.json"):
        check_calibration(ColmapSettings(lens_from=run))


def test_a_run_of_cameras_with_several_lenses_is_refused(tmp_path: Path):
    run = run_with_lens(tmp_path / "run", 900.0, 3)
    path = run / "sfm" / "cameras.json"
    document = json.loads(path.read_text())
    lens = {key: document[key] for key in ("fx", "fy", "cx", "cy", "model", "distortion")}
    document["frames"][1] |= lens | {"fx": 800.0}
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match="several lenses"):
        check_calibration(ColmapSettings(lens_from=run))


@pytest.mark.parametrize("other", [{"focal": 900.0}, {"calibration": Path("a.yaml")}, {"housing": "flat"}])
def test_the_lens_of_a_run_stands_alone(other: dict[str, Any]):
    with pytest.raises(UsageError, match="--lens-from and --"):
        ColmapSettings(lens_from=Path("run"), **other)
