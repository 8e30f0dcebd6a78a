"""The bands that colors of surface points are blended in."""

import cv2
import numpy as np
import pytest

from swimm3r.products.frame_colors import low_band


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (333, 501), (96, 72)])
def test_the_low_band_is_the_blur_of_all_pixels(width: int, height: int):
    image = np.random.default_rng(0).random((height, width, 3), dtype=np.float32)
    image[:, : width // 3] *= 0.2
    std = 0.03 * max(width, height)
    blurred = cv2.GaussianBlur(image, (0, 0), std, borderType=cv2.BORDER_REFLECT)
    found = low_band(image)
    assert found.size <= max(blurred.size / 3, 96 * 72 * 3)
    np.testing.assert_allclose(cv2.resize(found, (width, height), interpolation=cv2.INTER_LINEAR), blurred, atol=1e-3)
