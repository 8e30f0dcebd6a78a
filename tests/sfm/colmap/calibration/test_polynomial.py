"""The lens as a polynomial, where COLMAP's models do not explain the images: against lenses that are known."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.imaging.test_rectification import stretching_lens
from tests.sfm.colmap.test_extended_adjustment import assert_derivatives

from swimm3r.cameras import EXPONENTS, Cameras, directions, distort
from swimm3r.progress import silent
from swimm3r.sfm.colmap.calibration import polynomial
from swimm3r.sfm.colmap.calibration.polynomial import bent_lens

FRAMES, POINTS, NOISE = 10, 500, 0.2
WIDTH, HEIGHT = 400, 300


def scene(lens: Cameras, model: pycolmap.Camera, seed: int = 0) -> pycolmap.Reconstruction:
    """Points over uneven ground as a lens sees them from a winding path, and as a model's lens is believed to."""
    rng = np.random.default_rng(seed)
    xyz = np.stack([rng.uniform(-1.6, 1.6, POINTS), rng.uniform(-1.4, 1.4, POINTS), rng.uniform(2, 3.5, POINTS)], 1)
    out = pycolmap.Reconstruction()
    out.add_camera_with_trivial_rig(model)
    tracks = [pycolmap.Track() for _ in range(POINTS)]
    for k in range(FRAMES):
        s = 2 * k / (FRAMES - 1) - 1
        turn = Rotation.from_euler("yxz", [-20 * s, 12 * np.cos(3 * s), 25 * np.sin(4 * s)], degrees=True)
        shift = np.array([0.9 * s, 0.4 * np.sin(3 * s), 0.3 * np.cos(5 * s)])
        seen = turn.apply(xyz) + shift
        plane = torch.from_numpy(seen[:, :2] / seen[:, 2:])
        at = distort(plane, lens.distortion[0], lens.model) @ lens.K[0, :2, :2].mT + lens.K[0, :2, 2]
        pixels = at.numpy() + rng.normal(scale=NOISE, size=(POINTS, 2))
        inside = ((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(1) & (np.abs(plane.numpy()) < 0.8).all(1)
        image = pycolmap.Image(name=str(k), camera_id=1, image_id=k + 1)
        rows = np.flatnonzero(inside)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixels[row]) for row in rows])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn.as_matrix()), shift)
        out.add_image_with_trivial_frame(image, pose)
        for number, row in enumerate(rows):
            tracks[row].add_element(k + 1, number)
    for point, track in zip(xyz, tracks, strict=True):
        if track.length() > 2:
            out.add_point3D(point + rng.normal(scale=0.005, size=3), track)
    return out


def radial() -> pycolmap.Camera:
    return pycolmap.Camera(model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[300, 200, 150, 0.05], camera_id=1)


def angles(lens: Cameras) -> torch.Tensor:
    """Angles in degrees between the rays of pixels, which no turn of the camera changes."""
    x, y = torch.meshgrid(torch.linspace(60, 340, 8), torch.linspace(50, 250, 6), indexing="ij")
    rays = directions(lens, torch.stack([x, y], -1).reshape(1, -1, 2).double())[0]
    rays = torch.nn.functional.normalize(rays, dim=-1)
    return torch.rad2deg(torch.arccos((rays @ rays.mT).clamp(-1, 1)))


def test_a_lens_that_no_model_describes_is_found():
    truth = stretching_lens(WIDTH, HEIGHT)
    found = bent_lens(scene(truth, radial()), silent)
    assert found is not None
    assert found.model == "POLYNOMIAL"
    error = (angles(found) - angles(truth)).abs()
    assert error.median() < 0.1
    assert error.max() < 0.5  # of up to 60 degrees


@pytest.mark.parametrize("distortion", [[0.05, 0, 0, 0], [0.1, -0.05, 0.004, -0.003]])
def test_a_lens_of_colmaps_models_stays(distortion: list[float]):
    K = torch.tensor([[[300.0, 0, 200], [0, 300, 150], [0, 0, 1]]], dtype=torch.float64)
    lens = Cameras(K, torch.tensor([distortion]).double(), torch.eye(4).double()[None], WIDTH, HEIGHT, "OPENCV")
    params = [300, 300, 200, 150, *distortion]
    model = pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=params, camera_id=1)
    assert bent_lens(scene(lens, model), silent) is None


def test_fisheyes_and_clips_of_few_frames_stay():
    fisheye = pycolmap.Camera(
        model="OPENCV_FISHEYE", width=WIDTH, height=HEIGHT, params=[300, 300, 200, 150, 0, 0, 0, 0], camera_id=1
    )
    truth = stretching_lens(WIDTH, HEIGHT)
    assert bent_lens(scene(truth, fisheye), silent) is None
    few = scene(truth, radial())
    for image_id in list(few.images)[5:]:
        few.deregister_frame(few.images[image_id].frame_id)
    assert bent_lens(few, silent) is None


@pytest.mark.parametrize("camera", ["SIMPLE_RADIAL", "OPENCV"])
def test_a_polynomial_begins_as_the_lens_that_there_is(camera: str):
    params = {"SIMPLE_RADIAL": [310, 205, 148, 0.07], "OPENCV": [310, 290, 205, 148, 0.11, -0.05, 0.003, -0.002]}[
        camera
    ]
    theirs = pycolmap.Camera(model=camera, width=WIDTH, height=HEIGHT, params=params, camera_id=1)
    model = scene(stretching_lens(WIDTH, HEIGHT), theirs)
    clip = polynomial._clip(model, 10**6)
    assert clip is not None
    wanted = []
    for p in model.points3D.values():
        for e in p.track.elements:
            image = model.images[e.image_id]
            wanted.append(np.linalg.norm(image.project_point(p.xyz) - image.points2D[e.point2D_idx].xy))
    assert len(model.reg_image_ids()) == len(clip.start.R)
    found = [np.linalg.norm(part.errors(clip.start), axis=1) for part in (clip.fitted, clip.judge)]
    np.testing.assert_allclose(np.sort(np.concatenate(found)), np.sort(wanted), atol=1e-6)


def test_errors_have_the_derivatives_that_are_told():
    clip = polynomial._clip(scene(stretching_lens(WIDTH, HEIGHT), radial()), 2000)
    assert clip is not None
    others = clip.start.others.copy()
    others[4:] = np.random.default_rng(1).normal(scale=0.02, size=len(others) - 4)
    assert_derivatives(replace(clip.start, others=others), replace(clip.fitted, degree=5))


def test_a_lens_is_unknown_up_to_its_degree():
    clip = polynomial._clip(scene(stretching_lens(WIDTH, HEIGHT), radial()), 2000)
    assert clip is not None
    degree = np.array(EXPONENTS).sum(1)
    for most in (0, 3, 5):
        unknown = np.abs(replace(clip.fitted, degree=most).by_others(clip.start).toarray()).sum(0) > 0
        free = degree <= most if most else np.zeros(len(degree), bool)
        np.testing.assert_array_equal(unknown, [most > 0] * 4 + [*free, *free])


def test_observations_left_out_are_of_long_tracks_and_one_of_each():
    clip = polynomial._clip(scene(stretching_lens(WIDTH, HEIGHT), radial()), 3000)
    assert clip is not None
    assert len(clip.judge.point)
    assert len(np.unique(clip.judge.point)) == len(clip.judge.point)
    length = np.bincount(clip.fitted.point)
    assert length[clip.judge.point].min() >= 4
