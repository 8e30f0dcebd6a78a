"""A map knows what its training frames saw: by projection, by depth, and along rays into open water."""

from dataclasses import replace

import pytest
import torch

from swimm3r.cameras import Cameras, resized
from swimm3r.splat.map_file import load_map
from swimm3r.splat.projection.observed import TrainingCoverage, coverage_from, coverage_of
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.train_map import seen_in_training

WIDTH, HEIGHT = 48, 32


def looking_ahead(x: float = 0.0, turn: float = 0.0) -> Cameras:
    """A pinhole camera at (x, 0, 0), turned about its vertical axis."""
    pose = torch.eye(4, dtype=torch.float64)
    angle = torch.tensor(turn, dtype=torch.float64)
    pose[0, 0] = pose[2, 2] = angle.cos()
    pose[0, 2], pose[2, 0] = angle.sin(), -angle.sin()
    pose[0, 3] = x
    K = torch.tensor([[[40.0, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]]], dtype=torch.float64)
    return Cameras(K, torch.zeros(1, 0, dtype=torch.float64), pose[None], WIDTH, HEIGHT)


def coverage(z: torch.Tensor, alpha: torch.Tensor | None = None, seen: torch.Tensor | None = None) -> TrainingCoverage:
    """The record of one camera ahead."""
    alpha = torch.ones_like(z) if alpha is None else alpha
    seen = torch.ones_like(z, dtype=torch.bool) if seen is None else seen
    return coverage_of(looking_ahead(), [z], [alpha], [seen])


WALL = torch.full((HEIGHT, WIDTH), 3.0)


def point(x: float, z: float) -> torch.Tensor:
    return torch.tensor([[x, 0.0, z]])


def test_a_surface_in_view_is_seen_and_one_behind_it_or_beside_is_not():
    saw = coverage(WALL)
    assert saw.sees(point(0.0, 3.0)).all()
    assert saw.sees(point(0.0, 1.0)).all()  # a frame sees through the water before a surface
    for hidden in (point(0.0, 4.0), point(0.0, -3.0), point(3.0, 3.0)):
        assert not saw.sees(hidden).any()
    assert saw.needs(point(0.0, 3.6)).all()
    assert not saw.needs(point(0.0, 4.5)).any()


def test_a_view_from_a_training_pose_is_observed_and_one_turned_away_is_not():
    saw = coverage(WALL)
    opaque = torch.ones(HEIGHT, WIDTH)
    assert saw.of_view(looking_ahead(), WALL, opaque).all()
    aside = saw.of_view(looking_ahead(x=1.8), WALL, opaque)
    assert aside[:, :20].all()  # the two overlap by half
    assert not aside[:, -20:].any()
    assert not saw.of_view(looking_ahead(turn=3.14), WALL, opaque).any()


def test_what_a_mask_excludes_is_not_observed():
    admitted = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    admitted[:, : WIDTH // 2] = False
    observed = coverage(WALL, seen=admitted).of_view(looking_ahead(), WALL, torch.ones(HEIGHT, WIDTH))
    assert not observed[:, : WIDTH // 2 - 4].any()
    assert observed[:, WIDTH // 2 + 4 :].all()


def test_a_hole_counts_from_two_and_a_half_pixels_of_the_small_images_on():
    def holes(*corners: tuple[int, int], side: int) -> torch.Tensor:
        """Pixels of ten times as fine a view that are unseen where squares of the small images were excluded."""
        admitted = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
        for row, column in corners:
            admitted[row : row + side, column : column + side] = False
        fine = resized(looking_ahead(), 10 * WIDTH, 10 * HEIGHT)
        shape = (10 * HEIGHT, 10 * WIDTH)
        return ~coverage(WALL, seen=admitted).of_view(fine, torch.full(shape, 3.0), torch.ones(shape))

    assert not holes((10, 20), side=1).any()
    large = holes((10, 20), side=4)
    assert large[105:135, 205:235].all()
    assert not large[:, :190].any()
    assert holes((0, 20), side=2)[:12, 205:215].all()  # the border cuts it: it may go on


def test_open_water_is_observed_where_a_frame_looked_into_it():
    alpha = torch.ones(HEIGHT, WIDTH)
    alpha[: HEIGHT // 2] = 0
    observed = coverage(WALL, alpha).of_view(looking_ahead(), torch.zeros(HEIGHT, WIDTH), torch.zeros(HEIGHT, WIDTH))
    assert observed[: HEIGHT // 2 - 4].all()
    assert not observed[HEIGHT // 2 + 4 :].any()  # a hole in the ground: the frame saw ground there


def test_open_water_is_observed_up_to_the_edge_of_the_ground():
    alpha = torch.ones(HEIGHT, WIDTH)
    alpha[: HEIGHT // 2] = 0
    assert torch.equal(coverage(WALL, alpha).z_depth.isinf()[0], alpha == 0)
    shown = torch.where(alpha > 0, WALL, 0.0)
    assert coverage(WALL, alpha).of_view(looking_ahead(), shown, alpha).all()


def test_a_hole_of_a_pixel_in_the_map_is_no_open_water():
    alpha = torch.ones(HEIGHT, WIDTH)
    alpha[10, 20] = 0
    assert bool(coverage(WALL, alpha).z_depth.isfinite().all())


def test_the_order_of_the_frames_does_not_matter():
    views = [looking_ahead(0.3 * k) for k in range(70)]
    cameras = replace(views[0], K=views[0].K.repeat(70, 1, 1), distortion=torch.zeros(70, 0).double(),
                      cam2world=torch.cat([v.cam2world for v in views]))  # fmt: skip
    opaque, admitted = torch.ones(HEIGHT, WIDTH), torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    saw = coverage_of(cameras, [WALL] * 70, [opaque] * 70, [admitted] * 70)
    points = torch.stack([torch.linspace(-5, 30, 200), torch.zeros(200), torch.full((200,), 3.0)], -1)
    assert torch.equal(saw.sees(points), saw.sees(points, torch.tensor([20.0, 0, 0])))
    assert 0.5 < saw.sees(points).float().mean() < 0.8


def test_the_record_comes_back_from_a_map_and_a_damaged_one_is_refused(wall, tmp_path):
    alpha = torch.ones(HEIGHT, WIDTH)
    alpha[:10] = 0
    saw = coverage(WALL, alpha)
    assert saw.z_depth.isinf().any()
    scene: SplatMap = replace(wall(50), coverage=saw)
    scene.save(tmp_path / "map.safetensors")
    stored = load_map(tmp_path / "map.safetensors").coverage
    assert stored is not None
    assert torch.equal(stored.z_depth, saw.z_depth)
    assert torch.equal(stored.cameras.cam2world, saw.cameras.cam2world)
    assert coverage_from({}) is None
    with pytest.raises(ValueError, match="small depth images"):
        coverage_from({**saw.tensors(), "seen.z_depth": -3 * WALL[None]})


def test_training_frames_of_a_map_are_observed_and_ground_beside_the_dive_is_not(tiny_dive):
    saw = seen_in_training(tiny_dive.truth, tiny_dive.rec, tiny_dive.frames, tiny_dive.rec.names)
    scene = replace(tiny_dive.truth, coverage=saw)
    for k in (1, 4, 7):
        observed = scene.render(tiny_dive.cameras[k]).observed
        assert observed is not None
        assert observed.float().mean() > 0.99
    away = tiny_dive.cameras[4]
    away = replace(away, cam2world=away.cam2world.clone())
    away.cam2world[0, 0, 3] += 6
    beyond = scene.render(away).observed
    assert beyond is not None
    assert not beyond.any()
    assert tiny_dive.truth.render(away).observed is None


def test_primitives_that_no_frame_saw_are_no_part_of_the_observed_map(tiny_dive):
    saw = seen_in_training(tiny_dive.truth, tiny_dive.rec, tiny_dive.frames, tiny_dive.rec.names)
    scene = replace(tiny_dive.truth, coverage=saw)
    p = scene.primitives
    lost = p._replace(xyz=torch.cat([p.xyz[:-2], torch.tensor([[40.0, 0, 3], [0, 0, 9.0]])]))
    assert replace(scene, primitives=lost).observed_part().count <= scene.observed_part().count
    kept = replace(scene, primitives=lost).observed_part().primitives.xyz
    assert kept[:, 0].max() < 10
    assert kept[:, 2].max() < 5
    assert len(kept) >= int(saw.sees(p.xyz[:-2]).sum())
    shown = [replace(scene, primitives=lost).render(tiny_dive.cameras[k]).rgb for k in (1, 4, 7)]
    left = [replace(scene, primitives=lost).observed_part().render(tiny_dive.cameras[k]).rgb for k in (1, 4, 7)]
    assert max(float((a - b).abs().mean()) for a, b in zip(shown, left, strict=True)) < 2e-3
