"""Blocks on disk: a view takes those that it sees, in a memory of bounded size."""

from dataclasses import replace

import pytest
import torch
from tests.splat.cut import in_blocks

from swimm3r.cameras import Cameras
from swimm3r.errors import InputError
from swimm3r.export.gaussians import clear_difference, clear_gaussians
from swimm3r.splat.block_store import BlockEntry, PartCache, nbytes, no_primitives, write_block
from swimm3r.splat.map_file import load_map
from swimm3r.splat.pose_refinement import in_sight
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.rendering import SplatMap


def looking(x: float, z: float = 0.0, width: int = 64, height: int = 48) -> Cameras:
    K = torch.tensor([[[90.0, 0, width / 2], [0, 90, height / 2], [0, 0, 1]]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)[None].clone()
    pose[0, 0, 3], pose[0, 2, 3] = x, z
    return Cameras(K, torch.zeros(1, 0, dtype=torch.float64), pose, width, height)


@pytest.fixture
def turned_wall(wall) -> SplatMap:
    """Primitives of all shapes, whose centers move with the direction."""
    scene = wall(1500)
    rng = torch.Generator().manual_seed(2)
    return replace(scene, primitives=scene.primitives._replace(lower=0.2 * torch.randn(1500, 15, generator=rng)))


def test_views_of_blocks_are_those_of_the_whole_map(turned_wall, tmp_path):
    cut = in_blocks(turned_wall, tmp_path)
    drawn = 0
    for x in torch.linspace(-3, 3, 9).tolist():
        for z in (0.0, 0.5):
            camera = looking(x, z)
            whole, found = turned_wall.render(camera), cut.render(camera)
            for name in ("rgb", "clear", "backscatter", "z_depth", "alpha"):
                torch.testing.assert_close(getattr(found, name), getattr(whole, name), atol=1e-3, rtol=1e-3)
            drawn += len(cut.blocks.seen_by(view_camera(camera)))
    assert drawn < 0.8 * 18 * 6  # some were left out


def test_a_view_of_no_block_shows_the_water(turned_wall, tmp_path):
    out = in_blocks(turned_wall, tmp_path).render(looking(0.0, 50.0))
    assert not out.alpha.any()
    torch.testing.assert_close(out.rgb, out.medium.Binf)


def test_far_blocks_are_drawn_from_few_primitives_that_look_alike(wall, tmp_path):
    scene = wall(6000)
    cut = in_blocks(scene, tmp_path)
    near, far = view_camera(looking(0.0)), view_camera(looking(0.0, -60.0))
    assert not any(entry.is_far(near) for entry in cut.blocks.entries)
    assert all(entry.is_far(far) for entry in cut.blocks.entries)
    assert sum(len(p.xyz) for p in cut.blocks.seen_by(far)) < 6000 / 5
    whole, found = scene.render(looking(0.0, -60.0)), cut.render(looking(0.0, -60.0))
    assert (whole.clear - found.clear).square().mean() < 10**-2.5  # 25 dB, of colors that fill 12 x 4 pixels
    assert abs(float((whole.alpha - found.alpha).mean())) < 0.01


def test_blocks_stay_in_a_memory_of_bounded_size(wall, tmp_path):
    cut = in_blocks(wall(3000), tmp_path)
    assert cut.blocks is not None
    one = max(nbytes(p) for p in cut.blocks.parts())
    held = PartCache(max_bytes=2 * one)
    blocks = replace(cut.blocks, cache=held)
    for _ in range(2):
        for _part in blocks.parts():
            assert held.nbytes <= 2 * one
    first = blocks.read(blocks.entries[0])
    assert blocks.read(blocks.entries[0]) is first
    for entry in blocks.entries[1:4]:
        blocks.read(entry)
    assert blocks.read(blocks.entries[0]) is not first


def test_a_map_in_blocks_is_saved_and_read_again(turned_wall, tmp_path):
    cut = in_blocks(turned_wall, tmp_path / "here")
    cut.save(tmp_path / "here" / "map.safetensors")
    load_map(tmp_path / "here" / "map.safetensors").save(tmp_path / "there" / "map.safetensors")
    again = load_map(tmp_path / "there" / "map.safetensors")
    assert again.blocks.folder == tmp_path / "there"
    assert again.count == 1500
    assert "1,500 primitives in 6 blocks" in repr(again)
    assert torch.equal(again.render(looking(0.3)).rgb, cut.render(looking(0.3)).rgb)


def test_a_part_of_a_map_is_taken_block_by_block(turned_wall, tmp_path):
    def left(xyz: torch.Tensor) -> torch.Tensor:
        return xyz[:, 0] < 0.2

    cut = in_blocks(turned_wall, tmp_path).within(left)
    whole = turned_wall.within(left)
    torch.testing.assert_close(cut.render(looking(0.0)).rgb, whole.render(looking(0.0)).rgb, atol=2e-5, rtol=1e-4)
    with pytest.raises(ValueError, match="part of a map"):
        cut.save(tmp_path / "map.safetensors")


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (lambda path: path.unlink(), "is missing"),
        (lambda path: path.write_bytes(path.read_bytes()[:-40]), "is not a block of this map"),
        (lambda path: write_block(path, no_primitives(), "key"), "holds 0 primitives"),
        (lambda path: write_block(path, no_primitives(), "other"), "another training"),
    ],
)
@pytest.mark.parametrize("file", ["0002.safetensors", "0002_coarse.safetensors"])
def test_a_damaged_block_is_named_with_what_makes_it_again(wall, tmp_path, harm, said, file):
    in_blocks(wall(600), tmp_path).save(tmp_path / "map.safetensors")
    harm(tmp_path / "blocks" / file)
    with pytest.raises(InputError, match=said) as raised:
        list(load_map(tmp_path / "map.safetensors").blocks.parts(coarse="coarse" in file))
    assert file in raised.value.what
    assert "trains this block again" in raised.value.hint


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"file": "../../etc/x.safetensors"}, "outside its folder"),
        ({"primitives": -1}, "-1 primitives"),
        ({"low": (9.0, 0.0, 0.0), "high": (0.0, 1.0, 1.0)}, "ends before it begins"),
    ],
)
def test_entries_are_checked(change, said):
    entry = BlockEntry("blocks/0000.safetensors", 5, 1, 0.1, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match=said):
        replace(entry, **change)


def test_pose_refinement_sees_the_primitives_of_the_whole_map(turned_wall, tmp_path):
    cut = in_blocks(turned_wall, tmp_path)
    for x in (-1.0, 0.4):
        whole, found = (in_sight(scene, looking(x)) for scene in (turned_wall, cut))
        assert {tuple(row) for row in found.xyz.tolist()} == {tuple(row) for row in whole.xyz.tolist()}


def test_an_export_asks_for_each_block_the_cameras_that_see_it(turned_wall, tmp_path):
    cut = in_blocks(turned_wall, tmp_path)
    views = [looking(x) for x in torch.linspace(-2.5, 2.5, 7).tolist()]
    cameras = replace(views[0], K=torch.cat([v.K for v in views]), distortion=torch.zeros(7, 0, dtype=torch.float64),
                      cam2world=torch.cat([v.cam2world for v in views]))  # fmt: skip
    whole, found = (clear_gaussians(scene, cameras) for scene in (turned_wall, cut))
    order = [g.xyz[:, 0].argsort() for g in (whole, found)]
    for name in ("xyz", "rgb", "opacity", "covariance"):
        a, b = getattr(whole, name)[order[0]], getattr(found, name)[order[1]]
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-3)
    difference = clear_difference(cut, found, cameras[[1, 5]])
    assert abs(difference.psnr - clear_difference(turned_wall, whole, cameras[[1, 5]]).psnr) < 0.1
