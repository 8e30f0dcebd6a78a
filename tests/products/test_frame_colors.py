"""The bands that colors of surface points are blended in."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tests.products.conftest import Seabed

from swimm3r.appearance import FrameColors
from swimm3r.io.images import write_rgb
from swimm3r.products.frame_colors import low_band
from swimm3r.products.survey import Survey


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (333, 501), (96, 72)])
def test_the_low_band_is_the_blur_of_all_pixels(width: int, height: int):
    image = np.random.default_rng(0).random((height, width, 3), dtype=np.float32)
    image[:, : width // 3] *= 0.2
    std = 0.03 * max(width, height)
    blurred = cv2.GaussianBlur(image, (0, 0), std, borderType=cv2.BORDER_REFLECT)
    found = low_band(image)
    assert found.size <= max(blurred.size / 3, 96 * 72 * 3)
    np.testing.assert_allclose(cv2.resize(found, (width, height), interpolation=cv2.INTER_LINEAR), blurred, atol=1e-3)


def test_frames_with_the_water_have_one_exposure_where_restored_ones_have(seabed: Seabed, tmp_path: Path):
    steady = seabed.survey()
    gains = 1 + 0.15 * torch.linspace(-1, 1, len(steady.rec.names))
    filmed = []
    for frame, gain in zip(steady.frames, gains.tolist(), strict=True):
        image = steady.frames.image(steady.frames.index(frame.name)).numpy()
        write_rgb(tmp_path / frame.name, gain * image)
        filmed.append(replace(frame, path=tmp_path / frame.name))
    colors = FrameColors(steady.rec.names, gains[:, None, None] * torch.eye(3, 4))
    frames = replace(steady.frames, frames=tuple(filmed))
    evened = Survey(steady.folder, replace(steady.rec, own_colors=colors), frames, steady.place)
    as_stored = replace(evened, rec=steady.rec)
    for i in steady.indices:
        expected, found, stored = (survey.image("filmed", i) for survey in (steady, evened, as_stored))
        assert np.abs(found - expected).max() < 1.5 / 255
        assert (np.abs(stored / expected - float(gains[i])) < 0.05).mean() > 0.95
