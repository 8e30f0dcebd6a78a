"""Depth that other views look through: frontal planes at known depths before cameras in a row."""

from dataclasses import replace

import pytest
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import Cameras, directions, pixel_grid
from swimm3r.sfm.plane_sweep.seen_through import without_seen_through
from swimm3r.sfm.plane_sweep.settings import PlaneSweepSettings
from swimm3r.sfm.plane_sweep.sweep import RawDepth

WIDTH, HEIGHT, COUNT, GROUND, PLATE = 96, 72, 9, 4.0, 3.0
PATCH = (slice(30, 40), slice(40, 60))
SETTINGS = PlaneSweepSettings()


@pytest.fixture
def cameras() -> Cameras:
    """Nine cameras side by side over 1.6 units that look along +z; the first stands in their middle."""
    poses = torch.eye(4, dtype=torch.float64).repeat(COUNT, 1, 1)
    poses[:, 0, 3] = torch.tensor([0.0, -0.8, -0.6, -0.4, -0.2, 0.2, 0.4, 0.6, 0.8])
    K = torch.tensor([[80.0, 0, WIDTH / 2], [0, 80.0, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    return Cameras(K.repeat(COUNT, 1, 1), torch.zeros(COUNT, 0, dtype=torch.float64), poses, WIDTH, HEIGHT)


def on_plate(camera: Cameras, wider: float = 0.0) -> Bool[Tensor, "h w"]:
    """Mask of the pixels that show a plate of 0.6 units before the ground, `wider` by some pixels on each side."""
    rays = directions(camera, pixel_grid(HEIGHT, WIDTH).reshape(1, -1, 2).double())[0].reshape(HEIGHT, WIDTH, 3)
    at = camera.centers[0] + PLATE * rays
    return (at[..., :2].abs() <= 0.3 + wider * PLATE / 80).all(-1)


def measured(z_depth: Float[Tensor, "h w"]) -> RawDepth:
    return RawDepth(torch.where(z_depth > 0, 1 / z_depth, 0.0).float(), (z_depth > 0).float())


def seen(cameras: Cameras, wider: float = 0.0) -> list[RawDepth]:
    """Depth of the plate and of the ground behind it, as every camera measured it."""
    return [measured(torch.where(on_plate(cameras[i], wider), PLATE, GROUND)) for i in range(COUNT)]


def test_a_surface_that_one_view_puts_before_what_the_others_measured_goes(cameras: Cameras):
    views = [measured(torch.full((HEIGHT, WIDTH), GROUND)) for _ in range(COUNT)]
    views[0].inverse_depth[PATCH] *= 1.25
    kept = without_seen_through(views[0], views[1:], cameras, SETTINGS)
    gone = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    gone[PATCH] = True
    assert torch.equal(kept.inverse_depth == 0, gone)
    assert torch.equal(kept.correlation == 0, gone)
    assert torch.equal(kept.inverse_depth[~gone], views[0].inverse_depth[~gone])
    lenient = without_seen_through(views[0], views[1:], cameras, replace(SETTINGS, most_behind=1000.0))
    assert torch.equal(lenient.inverse_depth, views[0].inverse_depth)


def test_a_surface_that_hides_another_stays(cameras: Cameras):
    views = seen(cameras)
    kept = without_seen_through(views[0], views[1:], cameras, SETTINGS)
    interior = on_plate(cameras[0], wider=-1.0)  # beyond, the nearest pixels of others may be those of the ground
    assert bool((kept.inverse_depth[interior] > 0).all())
    assert bool((kept.inverse_depth[~on_plate(cameras[0])] > 0).all())


def test_rims_that_views_on_one_side_confirm_and_those_on_the_other_look_past_go(cameras: Cameras):
    wide, exact, plate = seen(cameras, wider=3.0), seen(cameras), on_plate(cameras[0])
    beside = on_plate(cameras[0], wider=3.0) & ~on_plate(cameras[0], wider=1.0) & ~plate.any(0)
    kept = without_seen_through(wide[0], [*wide[1:5], *exact[5:]], cameras, SETTINGS)
    assert (kept.inverse_depth[beside] == 0).double().mean() > 0.9
    assert bool((kept.inverse_depth[on_plate(cameras[0], wider=-1.0)] > 0).all())


def test_what_no_other_view_measured_stays(cameras: Cameras):
    views = [measured(torch.full((HEIGHT, WIDTH), GROUND)) for _ in range(COUNT)]
    nothing = measured(torch.zeros(HEIGHT, WIDTH))
    views[0].inverse_depth[PATCH] *= 1.25
    kept = without_seen_through(views[0], [nothing] * (COUNT - 1), cameras, SETTINGS)
    assert torch.equal(kept.inverse_depth, views[0].inverse_depth)


def test_depth_that_is_noisy_everywhere_is_not_looked_through(cameras: Cameras):
    draw = torch.Generator().manual_seed(0)
    views = [measured(GROUND * (1 + 0.04 * torch.randn(HEIGHT, WIDTH, generator=draw))) for _ in range(COUNT)]
    kept = without_seen_through(views[0], views[1:], cameras, SETTINGS)
    assert (kept.inverse_depth > 0).double().mean() > 0.99
