"""The bands that colors of surface points are blended in."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tests.products.conftest import Seabed, height, poses, write_survey

from swimm3r.appearance import FrameColors
from swimm3r.io.images import write_rgb
from swimm3r.products.frame_colors import Points, low_band, sight
from swimm3r.products.survey import Survey, open_survey


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


def test_a_frame_from_near_by_ranks_above_one_from_afar_whatever_else_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    placed = poses()
    placed[6] = placed[5]
    placed[6, 2, 3] += 1.0  # twice as high over the same place
    monkeypatch.setattr("tests.products.conftest.poses", lambda: placed)
    write_survey(tmp_path / "run")
    survey = open_survey(tmp_path / "run")
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(0.2, 0.8, 13), np.linspace(0.1, 0.6, 11)))
    points = Points(np.stack([x, y, height(x, y)], -1), size=0.01)
    near, far = (sight(survey, points, i).rank for i in (5, 6))
    middle = np.hypot(x - 0.5, y - 0.35) < 0.1
    assert (near[middle] > 1.6 * far[middle]).all()
    assert (far[middle] > 0).all()
    part = np.flatnonzero(x < 0.4)
    np.testing.assert_allclose(sight(survey, points.select(part), 5).rank, near[part], rtol=1e-6)
