"""The plan of a map in blocks: every piece of ground in exactly one, all alike in area."""

import math

import pytest
import torch

from swimm3r.scene.surface import Surface, surface_of
from swimm3r.splat.blocks.part import BlockViews, part_of, stretches_of, views_of_blocks
from swimm3r.splat.blocks.plan import PlannedBlock, plan_blocks
from swimm3r.splat.blocks.training import of_block
from swimm3r.splat.ground import GroundPlane, Window, held_by_any, plane_of
from swimm3r.splat.settings import BlockSettings, DensifySettings, InitialSettings, UwbsSettings
from swimm3r.splat.views import TrainingViews, filled, median_z_depth


def l_shaped(n: int = 4000) -> Surface:
    """Ground of uneven outline, tilted in space."""
    rng = torch.Generator().manual_seed(3)
    uv = torch.rand(n, 2, generator=rng, dtype=torch.float64) * torch.tensor([12.0, 7.0])
    uv = uv[(uv[:, 0] < 4) | (uv[:, 1] < 3)]
    turn = torch.linalg.qr(torch.randn(3, 3, generator=rng, dtype=torch.float64)).Q
    xyz = torch.cat([uv, 0.1 * torch.rand(len(uv), 1, generator=rng, dtype=torch.float64)], -1) @ turn.mT
    return Surface(xyz, torch.full((len(uv),), 0.01, dtype=torch.float64), 0.1)


@pytest.mark.parametrize("largest", [3.0, 5.5, 7.0, 1000.0])
def test_every_point_lies_in_exactly_one_block_and_blocks_are_alike_in_area(largest):
    surface = l_shaped()
    plan = plan_blocks(surface, 1.0, BlockSettings(largest=largest))
    total = float(surface.area.sum())
    assert len(plan) == math.ceil(total / largest)
    far = 1e4 * torch.randn(500, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    for points in (surface.xyz, far):
        assert torch.stack([block.window.holds(points) for block in plan]).sum(0).eq(1).all()
    own = torch.stack([surface.area[block.window.holds(surface.xyz)].sum() for block in plan])
    assert own.max() < 1.1 * total / len(plan)
    assert own.min() > 0.9 * total / len(plan)
    assert all(block.area >= float(area) for block, area in zip(plan, own, strict=True))


def test_neighbors_have_different_turns_and_share_no_open_ground():
    surface = l_shaped()
    plan = plan_blocks(surface, 1.0, BlockSettings(largest=2.0))
    assert len(plan) > 12
    assert len({block.turn for block in plan}) <= 6
    for block in plan:
        wide = block.window.widened(block.margin)
        for other in plan:
            if other is not block and wide.meets(other.window.widened(other.margin)):
                assert other.turn != block.turn
        open_ground = wide.holds(surface.xyz) & ~held_by_any([plan[j].window for j in block.before], surface.xyz)
        assert block.open_area == pytest.approx(float(surface.area[open_ground].sum()))
        own = float(surface.area[block.window.holds(surface.xyz)].sum())
        assert own <= block.open_area <= block.area + 1e-9


def test_a_point_on_an_edge_lies_in_the_block_whose_lower_edge_it_is():
    before, behind = Window(GroundPlane((0, 0, 0), (1, 0, 0), (0, 1, 0))).halves(0, 2.0)
    edge = torch.tensor([[2.0, 5.0, 1.0]])
    assert not before.holds(edge)
    assert behind.holds(edge)
    assert before.widened(0.1).holds(edge)


def test_the_ground_of_a_wall_is_the_wall():
    rng = torch.Generator().manual_seed(0)
    wall = torch.rand(500, 3, generator=rng) * torch.tensor([5.0, 3.0, 0.1])
    uv = plane_of(wall).coordinates(wall)
    torch.testing.assert_close((uv.amax(0) - uv.amin(0)).float(), torch.tensor([5.0, 3.0]), atol=0.2, rtol=0)


def test_area_is_counted_in_images(tiny_dive):
    """The wall is 5.2 by 1.6 and uneven, an image at its depth of 3 shows 3.2 by 2.4."""
    depth = median_z_depth(tiny_dive.rec)
    area = float(surface_of(tiny_dive.rec, depth).area.sum())
    assert 0.8 * 5.2 * 1.6 < area * 3.2 * 2.4 < 3.5 * 5.2 * 1.6


def test_no_limit_is_one_block(tiny_dive):
    depth = median_z_depth(tiny_dive.rec)
    assert len(plan_blocks(surface_of(tiny_dive.rec, depth), depth, BlockSettings(largest=0.0))) == 1


def test_primitives_are_in_proportion_to_area():
    settings = UwbsSettings(
        initial=InitialSettings(primitives=1000),
        densify=DensifySettings(cap_max=3000),
        full_area=8.0,
        blocks=BlockSettings(largest=16),
    )
    block = PlannedBlock(Window(GroundPlane((0, 0, 0), (1, 0, 0), (0, 1, 0))), 0.2, 4.0, open_area=4.0)
    half = of_block(settings, block, BlockViews(("a",) * 30, 10.0))
    assert (half.initial.primitives, half.densify.cap_max) == (500, 1500)
    assert half.iterations == 0.75 * settings.blocks.steps * settings.iterations
    assert half.weights.opacity == pytest.approx(settings.weights.opacity / 3)
    assert half.weights.scale == pytest.approx(settings.weights.scale / 3)


def test_a_block_is_trained_on_the_frames_that_see_it_and_the_points_in_its_window(tiny_dive):
    rec = tiny_dive.rec
    middle = Window(plane_of(rec.cloud.xyz))
    left, right = middle.halves(0, -0.7 if middle.plane.across[0] > 0 else 0.7)
    plan = [PlannedBlock(left, 0.2, 1.0), PlannedBlock(right, 0.2, 1.0)]
    seen_by = views_of_blocks(rec, rec.names, plan)
    for window, found in zip((left, right), seen_by, strict=True):
        images = 0.0
        for name in rec.names:
            share = window.holds(_points(rec, name)).float().mean()
            assert (name in found.names) == (share >= 0.02) or 0.01 < share < 0.03
            images += float(window.widened(0.2).holds(_points(rec, name)).float().mean()) * (name in found.names)
        assert abs(found.images - images) < 0.03 * len(found.names)
    part = part_of(rec, seen_by[0].names, left)
    assert part.names == seen_by[0].names
    assert torch.equal(part.cameras.cam2world[0], rec.cameras.cam2world[rec.index(part.names[0])])
    assert left.holds(part.cloud.xyz).all()
    assert 0 < len(part.cloud.xyz) < len(rec.cloud.xyz)


@pytest.mark.parametrize("images", [0.5, 1.0, 100.0])
def test_the_stretches_see_as_much_ground_as_asked_for_and_hold_its_points(tiny_dive, images):
    rec = tiny_dive.rec
    surface = surface_of(rec, median_z_depth(rec))
    part = stretches_of(rec, rec.names, surface, images)
    cells = torch.cat([surface.cells_of(_points(rec, name)) for name in part.names])
    seen = torch.zeros(len(surface.area), dtype=torch.bool)
    seen[cells[cells >= 0]] = True
    assert (float(surface.area[seen].sum()) >= images) == (images < 100)
    assert (part.names == rec.names) == (images == 100)
    assert part.names == tuple(name for name in rec.names if name in part.names)
    assert torch.equal(part.cloud.xyz, rec.cloud.xyz[seen[surface.cells_of(rec.cloud.xyz)]])


def test_every_cell_of_a_surface_holds_its_center_and_none_what_lies_elsewhere(tiny_dive):
    surface = surface_of(tiny_dive.rec, median_z_depth(tiny_dive.rec))
    assert torch.equal(surface.cells_of(surface.xyz), torch.arange(len(surface.xyz)))
    above = surface.xyz + torch.tensor([0.0, 0.0, 100.0])
    assert (surface.cells_of(above) == -1).all()
    beside = surface.cells_of(surface.xyz + torch.tensor([surface.edge, 0.0, 0.0]))
    found = beside >= 0
    assert 0 < found.sum() < len(found)
    moved = surface.xyz[beside[found]] - surface.xyz[found]
    assert torch.allclose(moved, torch.tensor([surface.edge, 0.0, 0.0], dtype=torch.float64), atol=1e-9)


def test_pixels_whose_surface_lies_outside_the_window_take_no_part(tiny_dive):
    rec, frames = tiny_dive.rec, tiny_dive.frames
    window, _ = Window(plane_of(rec.cloud.xyz)).halves(0, 0.0)
    settings = UwbsSettings(long_side=64)
    views, all_of_it = TrainingViews(rec, frames, settings, 1.0, window), TrainingViews(rec, frames, settings, 1.0)
    view, whole = views[3], all_of_it[3]
    inside = window.holds(_points(rec, view.name)).reshape(48, 64)
    known = whole.z_depth > 0
    assert torch.equal(view.seen[known], (whole.seen & inside)[known])
    assert not view.z_depth[known & ~inside].any()
    assert torch.equal(view.z_depth[known & inside], whole.z_depth[known & inside])
    assert 0.2 < view.seen.float().mean() < 0.8


def test_unknown_depth_is_that_of_the_next_pixel():
    z = torch.tensor([[0.0, 2.0, 0.0, 0.0, 5.0], [0.0, 2.0, 0.0, 0.0, 5.0]])
    found = filled(z)
    assert found is not None
    assert torch.equal(found, torch.tensor([[2.0, 2.0, 2.0, 5.0, 5.0]] * 2))
    assert filled(torch.zeros(2, 3)) is None


def _points(rec, name):
    from swimm3r.cameras import pixel_grid, unproject

    z = filled(rec.depth[name].z_depth)
    pixels = pixel_grid(*z.shape).reshape(1, -1, 2).double()
    return unproject(rec.cameras[rec.index(name)], pixels, z.reshape(1, -1).double())[0]
