"""Pixels, intrinsics and masks between the prepared frames and what the network sees, distorted lenses included."""

from pathlib import Path

import numpy as np
import pytest
import torch

from swimm3r.cameras import project
from swimm3r.errors import InputError
from swimm3r.io import images
from swimm3r.scene.frames import Frame, Frames
from swimm3r.sfm.mast3r_sfm.network_frames import NetworkImages, network_images
from swimm3r.sfm.settings import Mast3rSettings

LENSES = [
    Mast3rSettings(),
    Mast3rSettings(focal=800.0),
    Mast3rSettings(camera="SIMPLE_RADIAL", focal=800.0, k1=-0.1),
    Mast3rSettings(camera="OPENCV", focal=800.0, k1=-0.1, k2=0.02, p1=0.003, p2=-0.002),
    Mast3rSettings(camera="OPENCV_FISHEYE", focal=700.0, k1=0.02, k2=-0.01),
]


def network_images_of(
    settings: Mast3rSettings, width: int = 1000, height: int = 750, folder: Path = Path()
) -> NetworkImages:
    return network_images(Frames((Frame("a.png", folder / "a.png", 0.0, 1.0, "train"),), width, height, True), settings)


@pytest.mark.parametrize("settings", LENSES, ids=lambda s: f"{s.camera}-{s.focal}")
def test_a_point_falls_where_both_cameras_say(settings: Mast3rSettings):
    seen = network_images_of(settings)
    K = seen.K if seen.K is not None else torch.tensor([[400.0, 0, 256], [0, 400, 192], [0, 0, 1]]).double()
    lens, canvas = seen.cameras(K[None], torch.eye(4, dtype=torch.float64)[None])
    points = torch.rand(1, 50, 3, generator=torch.Generator().manual_seed(0)).double() * torch.tensor([1.0, 0.8, 1])
    points = points - torch.tensor([0.5, 0.4, -2.0])
    there, here = project(canvas, points)[0][0], project(lens, points)[0][0]
    torch.testing.assert_close(seen.to_frame(there), here, atol=1e-6, rtol=0)
    assert lens.model == settings.camera
    assert (canvas.width, canvas.height) == (512, 384)


def test_known_intrinsics_keep_to_the_frames_own_size():
    lens, _ = network_images_of(LENSES[1]).cameras(
        network_images_of(LENSES[1]).K[None], torch.eye(4, dtype=torch.float64)[None]
    )
    expected = torch.tensor([[800.0, 0, 500], [0, 800, 375], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(lens.K[0], expected)


def test_pixels_a_distorted_image_does_not_show_are_masked(tmp_path: Path):
    images.write_rgb(tmp_path / "a.png", np.full((75, 100, 3), 0.5, np.float32))
    straight = network_images_of(Mast3rSettings(focal=80.0), 100, 75, tmp_path)
    pincushion = network_images_of(Mast3rSettings(camera="SIMPLE_RADIAL", focal=80.0, k1=0.2), 100, 75, tmp_path)
    assert straight.mask(0) is None
    mask = pincushion.mask(0)
    assert mask.shape == (384, 512)
    assert mask[192, 256]
    assert not mask[0, 0]


def test_a_strip_is_an_input_error():
    with pytest.raises(InputError, match="too narrow for the network"):
        network_images_of(Mast3rSettings(), 4000, 60)
