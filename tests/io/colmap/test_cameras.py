"""Lenses keep their rays on the way to COLMAP's cameras and back."""

import numpy as np
import pytest
import torch

from swimm3r.cameras import Cameras
from swimm3r.errors import InputError
from swimm3r.io.colmap.cameras import common_model, from_pycolmap_camera, to_pycolmap_camera, under_model

LENSES = {
    "PINHOLE": [],
    "SIMPLE_RADIAL": [-0.12],
    "OPENCV": [0.11, -0.05, 0.003, -0.002],
    "OPENCV_FISHEYE": [-0.02, 0.01, -0.004, 0.001],
}


def lens(model: str, fy: float = 310.0) -> Cameras:
    K = torch.tensor([[[310.0, 0, 201], [0, fy, 148], [0, 0, 1]]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)[None]
    return Cameras(K, torch.tensor([LENSES[model]], dtype=torch.float64), pose, 400, 300, model)


@pytest.mark.parametrize("model", LENSES)
def test_a_lens_comes_back_as_it_went(model: str):
    camera = to_pycolmap_camera(lens(model))
    assert (camera.model.name, camera.width, camera.height, camera.camera_id) == (model, 400, 300, 1)
    K, distortion = from_pycolmap_camera(camera, model)
    assert np.array_equal(K, lens(model).K[0].numpy())
    assert distortion.tolist() == LENSES[model]


def test_a_radial_lens_of_two_focal_lengths_is_written_as_opencv():
    camera = to_pycolmap_camera(lens("SIMPLE_RADIAL", fy=305.0))
    assert camera.model.name == "OPENCV"
    assert camera.params.tolist() == [310, 305, 201, 148, -0.12, 0, 0, 0]


def test_a_lens_under_a_wider_model_bends_rays_alike():
    narrow = to_pycolmap_camera(lens("SIMPLE_RADIAL"))
    wide = under_model(narrow, "OPENCV")
    pixels = np.array([[10.0, 20.0], [399.0, 1.0], [200.0, 150.0]])
    rays, expected = wide.cam_from_img(pixels), narrow.cam_from_img(pixels)
    assert rays is not None
    assert expected is not None
    np.testing.assert_allclose(rays, expected, atol=1e-9)
    assert under_model(narrow, "SIMPLE_RADIAL").params.tolist() == narrow.params.tolist()


def test_models_that_share_no_form_are_refused():
    assert common_model({"SIMPLE_PINHOLE", "PINHOLE"}) == "PINHOLE"
    assert common_model({"RADIAL"}) == "OPENCV"
    assert common_model({"PINHOLE", "SIMPLE_RADIAL"}) == "OPENCV"
    with pytest.raises(InputError, match="cannot be read together"):
        common_model({"PINHOLE", "OPENCV_FISHEYE"})
