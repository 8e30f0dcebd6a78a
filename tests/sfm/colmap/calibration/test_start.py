"""Lenses that can be, and those that cannot."""

import pytest
from tests.sfm.colmap.two_planes import HEIGHT, WIDTH

from swimm3r.sfm.colmap.calibration.start import is_lens


@pytest.mark.parametrize(
    ("params", "believable"),
    [
        ([260, 160, 120, 0.05], True),
        ([30, 160, 120, 0.0], False),  # 160 degrees without a fisheye
        ([26000, 160, 120, 0.0], False),
        ([260, 160, 120, -0.8], False),  # the corner folds back
        ([260, 160, 120, 4.0], False),
    ],
)
def test_only_what_can_be_a_lens_is_kept(params: list[float], believable: bool) -> None:
    import pycolmap

    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=params)
    assert is_lens(camera) is believable


@pytest.mark.parametrize(("tangential", "believable"), [(0.08, True), (-0.12, False)])
def test_a_lens_is_not_far_askew(tangential: float, believable: bool) -> None:
    import pycolmap

    params = [260, 260, 160, 120, 0.05, 0.0, 0.0, tangential]
    camera = pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=params)
    assert is_lens(camera) is believable
