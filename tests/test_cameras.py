import math

import pytest
import torch

from swimm3r.cameras import (
    EXPONENTS,
    CameraModel,
    Cameras,
    directions,
    distort,
    image_directions,
    inside_image,
    pixel_grid,
    project,
    project_visible,
    ray_depth_from_z,
    resized,
    rows_of_frames,
    unproject,
    z_depth_from_ray,
)

LENSES: dict[CameraModel, list[float]] = {
    "PINHOLE": [],
    "SIMPLE_RADIAL": [-0.12],
    "OPENCV": [0.11, -0.05, 0.003, -0.002],
    "OPENCV_FISHEYE": [-0.02, 0.01, -0.004, 0.001],
    "POLYNOMIAL": [0.01, -0.02, 0.03, 0.15, 0.02, 0.1, *[0.0] * 12, 0.02, 0.01, -0.01, 0.05, -0.12, 0.02, *[0.01] * 12],
}


def two_cameras(model: CameraModel) -> Cameras:
    K = torch.tensor([[300.0, 0, 201.0], [0, 310.0, 148.0], [0, 0, 1]], dtype=torch.float64).repeat(2, 1, 1)
    cam2world = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    a = 0.3
    cam2world[1, :3, :3] = torch.tensor([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]])
    cam2world[1, :3, 3] = torch.tensor([0.5, -0.2, 0.1])
    return Cameras(K, torch.tensor([LENSES[model]] * 2, dtype=torch.float64), cam2world, 400, 300, model)


@pytest.mark.parametrize("model", LENSES)
def test_projecting_undoes_unprojecting(model: CameraModel):
    cameras = two_cameras(model)
    pixels = pixel_grid(300, 400).reshape(-1, 2)[::97].double().repeat(2, 1, 1)
    z = torch.linspace(0.5, 9.0, pixels.shape[1], dtype=torch.float64).repeat(2, 1)
    again, z_again = project(cameras, unproject(cameras, pixels, z))
    torch.testing.assert_close(again, pixels, atol=1e-5, rtol=0)
    torch.testing.assert_close(z_again, z)


@pytest.mark.parametrize("model", [model for model in LENSES if model != "POLYNOMIAL"])
def test_models_agree_with_colmap(model: CameraModel):
    pycolmap = pytest.importorskip("pycolmap")
    cameras = two_cameras(model)
    K = cameras.K[0]
    focal = [K[0, 0], K[1, 1]]
    if model == "SIMPLE_RADIAL":
        K[1, 1] = K[0, 0]
        focal = [K[0, 0]]
    theirs = pycolmap.Camera(model=model, width=400, height=300, params=[*focal, K[0, 2], K[1, 2], *LENSES[model]])
    pixels = pixel_grid(300, 400).reshape(-1, 2)[::611].double()
    ours = directions(cameras[0], pixels[None])[0, :, :2]
    torch.testing.assert_close(ours, torch.from_numpy(theirs.cam_from_img(pixels.numpy())), atol=1e-7, rtol=0)


def test_a_polynomial_has_the_lenses_of_colmap_as_special_cases():
    k1, k2, p1, p2 = LENSES["OPENCV"]
    a = {(3, 0): k1, (1, 2): k1, (5, 0): k2, (3, 2): 2 * k2, (1, 4): k2, (1, 1): 2 * p1, (2, 0): 3 * p2, (0, 2): p2}
    b = {(2, 1): k1, (0, 3): k1, (4, 1): k2, (2, 3): 2 * k2, (0, 5): k2, (1, 1): 2 * p2, (2, 0): p1, (0, 2): 3 * p1}
    terms = torch.tensor([axis.get(exponent, 0.0) for axis in (a, b) for exponent in EXPONENTS], dtype=torch.float64)
    xy = torch.rand(50, 2, dtype=torch.float64) - 0.5
    own = distort(xy, torch.tensor(LENSES["OPENCV"], dtype=torch.float64), "OPENCV")
    torch.testing.assert_close(distort(xy, terms, "POLYNOMIAL"), own)


def test_a_ray_the_lens_cannot_see_is_nan():
    cameras = two_cameras("SIMPLE_RADIAL")  # k < 0 folds back beyond r = 1.67
    far_outside = torch.tensor([[[5000.0, 5000.0]]], dtype=torch.float64)
    assert directions(cameras[0], far_outside)[..., :2].isnan().all()


def test_ray_depth_is_the_distance_from_the_center():
    cameras = two_cameras("OPENCV")
    rays = image_directions(cameras[1])
    z = torch.full((300, 400), 2.0)
    points = unproject(cameras[1], pixel_grid(300, 400).reshape(1, -1, 2), z.reshape(1, -1))
    distance = torch.linalg.vector_norm(points - cameras.centers[1].float(), dim=-1).reshape(300, 400)
    torch.testing.assert_close(ray_depth_from_z(z, rays), distance)
    torch.testing.assert_close(z_depth_from_ray(ray_depth_from_z(z, rays), rays), z)


def test_a_point_is_visible_before_the_camera_and_inside_its_image():
    cameras = two_cameras("OPENCV_FISHEYE")[0]
    pixels = torch.tensor([[[0.0, 0.0], [399.9, 299.9], [-0.1, 50.0], [50.0, 300.1], [200.0, 150.0]]]).double()
    points = unproject(cameras, pixels, torch.tensor([[2.0, 2.0, 2.0, 2.0, -2.0]]).double())
    again, z, visible = project_visible(cameras, points + 1e-9)
    assert visible[0].tolist() == [True, True, False, False, False]
    assert torch.equal(again, project(cameras, points + 1e-9)[0])
    assert z[0, -1] < 0


def test_a_pixel_inside_an_image_is_a_row_and_a_column_of_it():
    at = torch.tensor([[0.0, 0.0], [4.0, 1.0], [3.99, 2.99], [1.0, 3.0], [torch.nan, 1.0], [1.0, -1e-9]])
    assert inside_image(at, 4, 3).tolist() == [True, False, True, False, False, False]


def test_resizing_keeps_the_rays():
    cameras = two_cameras("OPENCV")[0]
    half = resized(cameras, 200, 150)
    pixels = torch.tensor([[[10.0, 20.0], [399.0, 299.0]]], dtype=torch.float64)
    torch.testing.assert_close(directions(half, pixels / 2), directions(cameras, pixels))


def test_wrong_number_of_distortion_parameters_is_refused():
    with pytest.raises(ValueError, match="OPENCV has 4 distortion parameters, got 1"):
        Cameras(torch.eye(3)[None], torch.zeros(1, 1), torch.eye(4)[None].double(), 4, 3, "OPENCV")


def test_no_pixels_have_no_rays():
    assert directions(two_cameras("OPENCV"), torch.zeros(2, 0, 2, dtype=torch.float64)).shape == (2, 0, 3)


def test_rows_of_frames_are_those_that_name_the_frame():
    frame = torch.tensor([2, 0, 2, 1, 0])
    assert [rows.tolist() for rows in rows_of_frames(frame, 4)] == [[1, 4], [3], [0, 2], []]
    assert [rows.tolist() for rows in rows_of_frames(frame[:0], 2)] == [[], []]
