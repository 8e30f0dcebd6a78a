"""A measuring pole before sand, seen from a camera that moves: at rest, in motion, and in motion with the camera."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from jaxtyping import Float

from swimm3r.cameras import Cameras, pixel_grid, project_visible, unproject
from swimm3r.sfm.moving.comparison import SmallView, color_range, compared
from swimm3r.sfm.moving.objects import color_models, color_samples, objects
from swimm3r.sfm.moving.occluders import Layer, evidence_on, measured_range, votes_on
from swimm3r.sfm.moving.parallax import explained

HEIGHT, WIDTH, FOCAL = 72, 96, 90.0
GROUND, POLE = 3.0, 1.2  # z depths
HALF = 0.04  # of the pole's width: 6 pixels in all
STEP = 0.1  # of the camera between frames: 3 pixels of the ground, 7.5 of the pole
NOW = 4  # of nine frames
ALONG_POLE, ACROSS_POLE = (0.0, STEP), (STEP, 0.0)

Place = Callable[[int], float]  # x of the pole's axis in a frame


def standing(frame: int) -> float:
    return 0.0


def moving_sideways(frame: int) -> float:
    return 0.13 * (frame - NOW)


def camera(frame: int, step: tuple[float, float]) -> Cameras:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:2, 3] = (frame - NOW) * torch.tensor(step, dtype=torch.float64)
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    return Cameras(K[None], torch.zeros(1, 0, dtype=torch.float64), pose[None], WIDTH, HEIGHT)


def points(lens: Cameras, z_depth: float) -> Float[np.ndarray, "h w 3"]:
    """The points of a plane on the rays of the pixels."""
    pixels = pixel_grid(HEIGHT, WIDTH).reshape(1, -1, 2).double()
    z = torch.full((1, HEIGHT * WIDTH), z_depth, dtype=torch.float64)
    return unproject(lens, pixels, z).reshape(HEIGHT, WIDTH, 3).numpy()


def pole(lens: Cameras, axis: float) -> np.ndarray:
    return np.abs(points(lens, POLE)[..., 0] - axis) <= HALF


def image(lens: Cameras, axis: float) -> Float[np.ndarray, "h w 3"]:
    """Sand in soft patches, and the pole in dark bands of unequal length."""
    x, y, _ = np.moveaxis(points(lens, GROUND), -1, 0) * 6
    sand = np.stack([np.sin(x + 2 * y), np.sin(2 * x - y + 1), np.sin(x - y)], -1) * 0.06 + 0.55
    along = points(lens, POLE)[..., 1]
    bands = np.where(np.sin(25 * along) + np.sin(41 * along) > 0, 0.25, 0.05)
    return np.where(pole(lens, axis)[..., None], bands[..., None], sand).astype(np.float32)


def view(frame: int, step: tuple[float, float], axis: float, pole_depth: float) -> SmallView:
    """A frame of the ground's depth, with some depth on the pole that is not the pole's."""
    lens = camera(frame, step)
    z_depth = np.where(pole(lens, axis), pole_depth, GROUND).astype(np.float32)
    return SmallView(lens, image(lens, axis), z_depth, np.ones((HEIGHT, WIDTH), bool))


def layer(lens: Cameras, other: SmallView) -> Layer:
    """The ground as another frame measured it, to the nearest pixel."""
    ground = torch.from_numpy(points(lens, GROUND).reshape(1, -1, 3))
    uv, _, visible = (part[0].numpy() for part in project_visible(other.camera, ground))
    column, row = np.where(visible[:, None], uv, 0).astype(int).T
    pixel = np.flatnonzero(visible & (other.z_depth[row, column] > 0))
    return Layer(other, (row * WIDTH + column)[pixel], pixel, np.full(len(pixel), GROUND, np.float32))


def filmed(step: tuple[float, float], place: Place, pole_depth: float) -> tuple[SmallView, list[Layer]]:
    mine = view(NOW, step, place(NOW), pole_depth)
    others = [view(frame, step, place(frame), pole_depth) for frame in range(9) if frame != NOW]
    return mine, [layer(mine.camera, other) for other in others]


def differs(mine: SmallView, layers: list[Layer]) -> np.ndarray:
    """The pixels that most other frames saw otherwise."""
    rgb, colors = mine.rgb.reshape(-1, 3), color_range(mine.rgb)
    pairs = [compared(rgb[each.pixel], colors.at(each.pixel), each.rgb) for each in layers]
    votes = votes_on(mine, layers, pairs)
    return votes.different > 2 * votes.same


@pytest.mark.parametrize("step", [ALONG_POLE, ACROSS_POLE], ids=["along", "across"])
@pytest.mark.parametrize("pole_depth", [0.0, GROUND], ids=["absent", "wrong"])
def test_a_standing_pole_without_its_depth_does_not_move(step: tuple[float, float], pole_depth: float) -> None:
    mine, layers = filmed(step, standing, pole_depth)
    assert not evidence_on(mine, layers).moving.any()


@pytest.mark.parametrize("pole_depth", [0.0, GROUND], ids=["absent", "wrong"])
def test_only_its_parallax_keeps_the_standing_pole_from_moving(pole_depth: float) -> None:
    mine, layers = filmed(ACROSS_POLE, standing, pole_depth)
    found = differs(mine, layers) & pole(mine.camera, 0.0)
    assert found.sum() > 0.5 * pole(mine.camera, 0.0).sum()


def moving_objects(mine: SmallView, layers: list[Layer]) -> np.ndarray:
    """The objects in a frame, by its own colors alone."""
    evidence = evidence_on(mine, layers)
    return objects(mine.rgb, evidence, color_models([color_samples(mine.rgb, evidence)]))


@pytest.mark.parametrize("pole_depth", [0.0, GROUND], ids=["absent", "wrong"])
def test_the_pole_that_moves_across_epipolar_lines_is_found(pole_depth: float) -> None:
    mine, layers = filmed(ALONG_POLE, moving_sideways, pole_depth)
    found, truth = moving_objects(mine, layers), pole(mine.camera, 0.0)
    assert (found & truth).sum() > 0.9 * truth.sum()
    assert (found & ~truth).sum() < 0.4 * truth.sum()  # a pixel on both sides of six


def test_the_pole_that_moves_with_the_camera_would_have_to_lie_behind_the_ground() -> None:
    mine, layers = filmed(ACROSS_POLE, lambda frame: STEP * (frame - NOW), 0.0)
    found, truth = moving_objects(mine, layers), pole(mine.camera, 0.0)
    assert (found & truth).sum() > 0.9 * truth.sum()


def test_a_pole_put_up_for_a_few_frames_is_found() -> None:
    mine, layers = filmed(ACROSS_POLE, lambda frame: 0.0 if abs(frame - NOW) < 2 else 100.0, 0.0)
    found, truth = moving_objects(mine, layers), pole(mine.camera, 0.0)
    assert (found & truth).sum() > 0.9 * truth.sum()


def test_without_other_frames_nothing_is_explained() -> None:
    mine, _ = filmed(ACROSS_POLE, standing, 0.0)
    asked = pole(mine.camera, 0.0)
    assert not explained(mine, [], [], asked, measured_range(asked.shape, [])).any()
