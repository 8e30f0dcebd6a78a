"""Several views of one fisheye frame: they cover it, and depth comes back along the frame's axis."""

import math
from dataclasses import replace

import pytest
import torch

from swimm3r.cameras import Cameras, image_directions, pixel_grid
from swimm3r.imaging.undistortion import covering_pinholes, pinhole_grid, undistorted
from swimm3r.sfm.plane_sweep.facets import Facets, facets_of, merged
from swimm3r.sfm.plane_sweep.views import on_frame_grid


def fisheye(width: int = 96, height: int = 64, diagonal: float = 150.0) -> Cameras:
    focal = math.hypot(width, height) / 2 / math.radians(diagonal / 2)
    K = torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)[None]
    return Cameras(K, torch.zeros(1, 4, dtype=torch.float64), pose, width, height, "OPENCV_FISHEYE")


@pytest.mark.parametrize("size", [(96, 64), (64, 96)])
def test_every_pixel_of_a_fisheye_is_in_a_facet(size: tuple[int, int]):
    lens = fisheye(*size)
    facets = facets_of(lens, 640)
    assert facets.per_frame == 3
    inside = torch.zeros(lens.height, lens.width, dtype=torch.bool)
    for view in facets.of_frame(0):
        column, row = (torch.from_numpy(a) for a in pinhole_grid(lens, facets.cameras[view], facets.turn_of(view)))
        there = (column > -0.5) & (row > -0.5)
        there &= (column < facets.cameras.width - 0.5) & (row < facets.cameras.height - 0.5)
        inside |= there.reshape(inside.shape)
    assert bool(inside.all())


def test_facets_have_not_many_times_the_pixels_of_their_frame():
    facets = facets_of(fisheye(480, 320), 640)
    assert facets.per_frame * facets.cameras.width * facets.cameras.height < 2.5 * 480 * 320


def test_other_lenses_have_the_one_view_they_had():
    narrow = fisheye(diagonal=90.0)
    straight = replace(narrow, distortion=torch.zeros(1, 0, dtype=torch.float64), model="PINHOLE")
    for lens in (narrow, straight):
        facets = facets_of(lens, 640)
        assert facets.per_frame == 1
        assert facets.turn_of(0) is None
        torch.testing.assert_close(facets.cameras.K, covering_pinholes(lens, 640).K)


def test_a_facet_shows_the_frame_along_its_own_rays():
    lens = fisheye(192, 128)
    facets = facets_of(lens, 640)
    directions = torch.nn.functional.normalize(image_directions(lens), dim=-1)
    everywhere = torch.ones(128, 192, dtype=torch.bool)
    for view in facets.of_frame(0):
        turn = facets.turn_of(view)
        shown, seen = undistorted(directions, everywhere, lens, facets.cameras[view], turn)
        own = torch.nn.functional.normalize(image_directions(facets.cameras[view]), dim=-1)
        assert turn is not None
        torch.testing.assert_close(shown[seen], (own @ turn.T.float())[seen], atol=2e-3, rtol=0)
        assert float(seen.float().mean()) > 0.5


def test_depth_of_a_slanted_plane_comes_back_along_the_frame_s_axis():
    lens = fisheye(288, 192)
    facets = facets_of(lens, 640)
    normal = torch.tensor([0.2, -0.1, 0.5], dtype=torch.float64)  # points X with normal . X = 1

    def inverse_depth(rays: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
        return (rays.double() @ (turn.T @ normal)).clamp(min=0)

    gray = torch.rand(192, 288, generator=torch.Generator().manual_seed(0))
    parts = []
    for view in facets.of_frame(0):
        camera, turn = facets.cameras[view], facets.turn_of(view)
        assert turn is not None
        q = inverse_depth(image_directions(camera), turn).float()
        parts.append(on_frame_grid(q, torch.ones_like(q), torch.zeros_like(q), gray, lens, camera, turn))
    rays = image_directions(lens)
    q, confidence = merged([q for q, _ in parts], [share for _, share in parts], rays, facets)
    expected = inverse_depth(rays, torch.eye(3, dtype=torch.float64)).float()
    told = (q > 0) & (expected > 0.05)
    assert float(told.float().mean()) > 0.6
    assert float(((q - expected).abs() / expected)[told].quantile(0.95)) < 0.015
    assert float(confidence[told].min()) > 0


def test_the_nearest_axis_decides_where_facets_overlap():
    turns = torch.stack([torch.eye(3), torch.diag(torch.tensor([1.0, -1.0, -1.0]))]).double()
    facets = Facets(fisheye(), turns)
    rays = torch.cat([pixel_grid(2, 2) * 0, torch.ones(2, 2, 1)], -1)
    q = [torch.full((2, 2), 0.5), torch.full((2, 2), 0.9)]
    found, _ = merged(q, q, rays, facets)
    torch.testing.assert_close(found, q[0])
