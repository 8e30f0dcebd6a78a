"""Raw, linear and log images: the light that they recorded is what a fit in linear light sees."""

import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from tests.bag_files import SECOND, START, image, write_bag
from tests.prepare.raw_files import write_dng

from swimm3r.errors import DeviceError, InputError, UsageError
from swimm3r.io.raw import Multipliers, multipliers_of, read_raw, read_raw_header
from swimm3r.medium import linear_from_srgb
from swimm3r.prepare import read_frames
from swimm3r.prepare.development import developed, development_of, light_of
from swimm3r.scene.settings import FrameSettings

DAYLIGHT = Multipliers("daylight", 2.0, 1.6)
INNER = np.s_[8:-8, 8:-8]  # demosaicing changes what lies at the edge


def ramp(height: int = 120, width: int = 160, most: float = 0.9) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.stack([0.02 + most * x / width, 0.05 + 0.7 * most * y / height, np.full(x.shape, 0.3)], -1)


def patterned(k: int) -> np.ndarray:
    """Light with detail, moved by k pixels."""
    rng = np.random.default_rng(0)
    coarse = rng.uniform(0.05, 0.6, (30, 40, 3))
    return np.roll(np.kron(coarse, np.ones((4, 4, 1))), 3 * k, axis=1)


def test_the_light_of_a_raw_file_comes_back(tmp_path: Path):
    light = ramp()
    found = read_raw(write_dng(tmp_path / "a.dng", light), DAYLIGHT) / 65535
    np.testing.assert_allclose(found[INNER], light[INNER], rtol=3e-3, atol=3e-4)


def test_twice_the_light_is_twice_the_value(tmp_path: Path):
    one = read_raw(write_dng(tmp_path / "a.dng", ramp(most=0.4)), DAYLIGHT).astype(float)
    two = read_raw(write_dng(tmp_path / "b.dng", 2 * ramp(most=0.4)), DAYLIGHT).astype(float)
    np.testing.assert_allclose(two[INNER] / one[INNER], 2.0, rtol=4e-3)


def test_the_files_state_their_balance(tmp_path: Path):
    path = write_dng(tmp_path / "a.dng", ramp())
    for source in ("daylight", "camera"):
        found = multipliers_of(path, source)
        assert found.red == pytest.approx(2.0, rel=1e-3)
        assert found.blue == pytest.approx(1.6, rel=1e-3)
    assert multipliers_of(path, "none") == Multipliers("none", 1.0, 1.0)


def test_a_raw_file_is_upright(tmp_path: Path):
    path = write_dng(tmp_path / "a.dng", ramp(), orientation=6)
    assert read_raw_header(path).size == (120, 160)
    assert read_raw(path, DAYLIGHT).shape == (160, 120, 3)


def test_a_folder_of_raw_files_becomes_frames_whose_linear_light_is_the_sensors(tmp_path: Path):
    ramps = ramp()
    for k in range(4):
        write_dng(tmp_path / f"{k}.dng", ramps)
    frames = read_frames(tmp_path, FrameSettings(), tmp_path / "frames")
    assert frames.names == ("0.png", "1.png", "2.png", "3.png")
    light = linear_from_srgb(frames.image(1)).numpy()
    np.testing.assert_allclose(light[INNER], ramps[INNER], rtol=4e-3, atol=4e-4)
    assert frames.development is not None
    assert frames.development.startswith("raw, linear, white balance daylight (2.000, 1, 1.600)")


def test_all_frames_have_the_balance_of_the_first_file_that_can_be_read(tmp_path: Path):
    (tmp_path / "0.dng").write_bytes(b"II*\x00 no image")
    for k in range(1, 5):
        write_dng(tmp_path / f"{k}.dng", patterned(k))
    frames = read_frames(tmp_path, FrameSettings(raw_balance="camera"), tmp_path / "frames")
    assert len(frames) == 4
    assert any("0.dng" in warning for warning in frames.warnings)
    assert "camera (2.000, 1, 1.600)" in (frames.development or "")


def test_images_beside_raw_files_are_used_and_that_is_said(tmp_path: Path):
    for k in range(4):
        write_dng(tmp_path / f"{k}.dng", patterned(k))
        tifffile.imwrite(tmp_path / f"{k}.tif", (patterned(k) * 255).astype(np.uint8))
    frames = read_frames(tmp_path, FrameSettings(), tmp_path / "frames")
    assert frames.development is None
    assert any("4 camera raw files lie beside the images" in warning for warning in frames.warnings)


def test_raw_files_of_a_stereo_pair_are_a_rig(tmp_path: Path):
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for k in range(3):
            write_dng(tmp_path / side / f"{k}.dng", patterned(k))
    frames = read_frames(tmp_path, FrameSettings(), tmp_path / "frames")
    assert frames.rig is not None
    assert frames.names[:2] == ("left/0.png", "right/0.png")


def test_linear_tiff_keeps_its_light(tmp_path: Path):
    for k in range(4):
        tifffile.imwrite(tmp_path / f"{k}.tif", (patterned(k) * 65535).astype(np.uint16))
    frames = read_frames(tmp_path, FrameSettings(transfer="linear"), tmp_path / "frames")
    np.testing.assert_allclose(linear_from_srgb(frames.image(2)).numpy(), patterned(2), atol=6e-5)
    assert frames.development == "linear, +0 stops, stored by sRGB's curve"


@pytest.mark.parametrize("rig", [(), ("/left/image_raw", "/right/image_raw")], ids=["camera", "rig"])
def test_dark_linear_frames_of_a_bag_show_something_once_they_are_developed(tmp_path: Path, rig: tuple[str, ...]):
    topics = rig or ("/cam/image_raw",)
    dark = [(patterned(k) * 400).astype(np.uint16) for k in range(4)]  # of 12 bits in 16
    sent = [image(topic, dark[k], "rgb16", START + k * SECOND // 5) for k in range(4) for topic in topics]
    bag = write_bag(tmp_path, "mcap", sent)
    settings = FrameSettings(transfer="linear", stops=4.0, rig=rig)
    frames = read_frames(bag, settings, tmp_path / "frames")
    assert len(frames) == 4 * len(topics)
    with pytest.raises(InputError, match="0 usable frames"):
        read_frames(bag, FrameSettings(rig=rig), tmp_path / "as_stored")


def test_a_stop_is_twice_the_light_up_to_white():
    values = np.linspace(0, 65535, 300).astype(np.uint16).reshape(10, 10, 3)
    plain, brighter = (developed(values, development_of(FrameSettings(transfer="linear", stops=n))) for n in (0.0, 1.0))
    light, twice = (linear_from_srgb(torch.from_numpy(v / 65535)).numpy() for v in (plain, brighter))
    np.testing.assert_allclose(twice, np.minimum(2 * light, 1), atol=1e-4)


@pytest.mark.parametrize(
    ("transfer", "gray", "black"),
    [("s-log3", 420 / 1023, 95 / 1023), ("v-log", 0.423, 0.125), ("gopro-log", None, 0.0)],
)
def test_log_curves_have_their_makers_gray_and_black(transfer, gray, black):
    assert light_of(np.array([black]), transfer)[0] == pytest.approx(0.0, abs=1e-6)
    if gray is not None:
        assert light_of(np.array([gray]), transfer)[0] == pytest.approx(0.18, rel=0.01)
    if transfer == "gopro-log":
        assert light_of(np.array([1.0]), transfer)[0] == pytest.approx(1.0)
    rising = light_of(np.linspace(black, 1, 400), transfer)
    assert (np.diff(rising) > 0).all()
    assert np.abs(np.diff(rising, n=2)).max() < 0.02 * rising.max()  # no jump where line and curve meet


def test_without_rawpy_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for k in range(3):
        write_dng(tmp_path / f"{k}.dng", patterned(k))
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(DeviceError, match="need rawpy") as failure:
        read_frames(tmp_path, FrameSettings(), tmp_path / "frames")
    assert "swimm3r[raw]" in failure.value.hint


def test_a_damaged_raw_file_is_named(tmp_path: Path):
    path = write_dng(tmp_path / "a.dng", ramp())
    path.write_bytes(path.read_bytes()[:600])
    with pytest.raises(InputError, match=r"a\.dng cannot be read as a camera raw file"):
        read_raw(path, DAYLIGHT)


@pytest.mark.parametrize("settings", [FrameSettings(stops=1.0), FrameSettings(stops=-0.5)])
def test_stops_of_stored_images_are_refused(settings: FrameSettings):
    with pytest.raises(UsageError, match="the values are not linear"):
        development_of(settings)


def test_a_log_curve_of_raw_files_is_refused(tmp_path: Path):
    with pytest.raises(UsageError, match="whose values are linear"):
        development_of(FrameSettings(transfer="s-log3"), [tmp_path / "a.dng"])
