"""Training pairs: one crop for teacher and student, water at ray depth, and scores that know the truth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from swimm3r import water_types
from swimm3r.cameras import Cameras, pixel_grid, project, unproject
from swimm3r.datasets import PairSettings, make_pairs, read_tree
from swimm3r.datasets.pairs import Pair
from swimm3r.datasets.sequences import Lens, Sequence, Shot
from swimm3r.geometry import relative_poses
from swimm3r.io.images import write_rgb
from swimm3r.medium import remove_water
from swimm3r.sfm.distillation.pairs import PairData, TwoViews, split_data, trainable
from swimm3r.sfm.distillation.validation import absolute_relative, pose_error
from swimm3r.sfm.distillation.water_augmentation import nearest_known
from swimm3r.sfm.mast3r.matching import PixelMatches
from swimm3r.synthetic import DiveSettings, write_dive

WIDTH, HEIGHT = 80, 60  # the network's crop of it at 64 is 64 x 48


def made(folder: Path, with_raw: bool = True, lens: Lens | None = None) -> PairData:
    """Two shots of noise with a known depth and a hole in it."""
    rng = np.random.default_rng(0)
    shots = []
    for k in range(2):
        coarse = rng.integers(0, 255, (HEIGHT // 4, WIDTH // 4, 3), dtype=np.uint8)
        for kind in ("raw", "clean"):
            write_rgb(folder / kind / f"{k}.png", coarse.repeat(4, 0).repeat(4, 1))
        depth = np.full((HEIGHT, WIDTH), 2.0 + k, np.float32)
        depth[20:40, 20:40] = 0
        np.savez(folder / f"{k}.npz", z_depth=depth)
        raw = folder / "raw" / f"{k}.png" if with_raw else None
        shots.append(Shot(str(k), raw, folder / "clean" / f"{k}.png", folder / f"{k}.npz"))
    return PairData((Sequence("made", "made", tuple(shots), lens=lens),), ((0, Pair(0, 1)),), 64)


def drawn(seed: int):
    return torch.Generator().manual_seed(seed)


def colors(images: torch.Tensor) -> torch.Tensor:
    return ((images + 1) / 2).permute(0, 2, 3, 1)


def test_without_augmentation_teacher_and_student_see_the_same_crop(tmp_path: Path):
    item = made(tmp_path).item(0, 0.0, drawn(0))  # raw and clean are the same image here
    assert item.clean.shape == (2, 3, 48, 64)
    assert torch.equal(item.clean, item.raw)


def test_the_augmentation_is_the_clear_image_through_one_water_at_ray_depth(tmp_path: Path):
    item = made(tmp_path).item(0, 1.0, drawn(3))
    water = water_types.draw(drawn(3), 1.0)
    assert water is not None
    restored = remove_water(colors(item.raw), item.ray_depth, water, 0.0)
    known = item.valid
    torch.testing.assert_close(restored[known], colors(item.clean)[known], atol=2e-4, rtol=0)
    assert not torch.equal(item.raw, item.clean)
    assert torch.equal(item.sampled_medium, torch.stack([water.Binf, water.beta_D, water.beta_B]).expand(2, 3, 3))
    assert made(tmp_path).item(0, 0.0, drawn(3)).sampled_medium.isnan().all()  # as taken: nobody knows its water


def test_half_of_the_items_are_augmented(tmp_path: Path):
    data = made(tmp_path)
    changed = [not torch.equal((i := data.item(0, 0.5, drawn(seed))).raw, i.clean) for seed in range(60)]
    assert 18 < sum(changed) < 42


def test_holes_in_the_depth_get_water_but_no_loss(tmp_path: Path):
    item = made(tmp_path).item(0, 1.0, drawn(3))
    hole = ~item.valid
    assert 0.05 < hole.float().mean() < 0.12  # 400 of 4800 pixels
    assert (item.ray_depth[hole] == 0).all()
    at_hole = hole[:, None].expand_as(item.raw)
    assert (item.raw - item.clean)[at_hole].abs().mean() > 0.05


def test_where_nothing_is_seen_the_augmentation_shows_open_water(tmp_path: Path):
    data = made(tmp_path)
    write_rgb(tmp_path / "clean" / "0.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    item, water = data.item(0, 1.0, drawn(3)), water_types.draw(drawn(3), 1.0)
    assert water is not None
    torch.testing.assert_close(colors(item.raw)[0][~item.valid[0]], water.Binf.expand(int((~item.valid[0]).sum()), 3))
    assert (colors(item.raw)[0][item.valid[0]] < water.Binf).all()  # a black thing, nearer


def test_images_taken_in_air_always_get_water(tmp_path: Path):
    data = made(tmp_path, with_raw=False)
    for seed in range(5):
        item = data.item(0, 0.0, drawn(seed))
        assert not torch.equal(item.raw, item.clean)


def test_ray_depth_grows_toward_the_corners_as_the_lens_says(tmp_path: Path):
    K = np.array([[40.0, 0, WIDTH / 2], [0, 40.0, HEIGHT / 2], [0, 0, 1]])
    item = made(tmp_path, lens=Lens(WIDTH, HEIGHT, K)).item(0, 0.0, drawn(0))
    x, y = (32 - 0.5) / 32, (24 - 0.5) / 32  # of the corner pixel: f is 32 network pixels
    expected = 2.0 * (1 + x * x + y * y) ** 0.5
    assert item.ray_depth[0, 0, 0].item() == pytest.approx(expected, rel=1e-5)
    flat = made(tmp_path).item(0, 0.0, drawn(0))
    assert flat.ray_depth[0, 0, 0] == 2.0  # without a lens z stands for it


def test_gaps_are_filled_from_the_nearest_known_pixel():
    depth = torch.tensor([[1.0, 0.0, 0.0, 4.0], [1.0, 0.0, 0.0, 4.0]])
    assert nearest_known(depth).tolist() == [[1, 1, 4, 4], [1, 1, 4, 4]]


def test_only_training_shots_with_a_clean_image_are_trained_on(tmp_path: Path):
    (sequence,) = made(tmp_path).sequences
    one, two = sequence.shots
    pair = [[Pair(0, 1)]]
    assert len(trainable([sequence], pair)) == 1
    for other in (
        replace(two, split="test"), replace(two, clean=None), replace(two, raw=None, depth=None),
    ):  # fmt: skip
        assert trainable([replace(sequence, shots=(one, other))], pair) == []
    in_air = [replace(sequence, shots=(one, replace(two, raw=None)))]
    assert len(trainable(in_air, pair)) == 1
    assert trainable(in_air, pair, augmented=False) == []  # nothing else gives such a shot its raw image
    assert len(trainable([sequence], pair, augmented=False)) == 1


def test_validation_pairs_are_never_trained_on(tmp_path: Path):
    write_dive(DiveSettings(frames=6, width=48, height=32), tmp_path / "dive")
    sequences = read_tree(tmp_path).sequences
    pairs = [make_pairs(s, PairSettings(min_overlap=0.05, max_overlap=1.0)) for s in sequences]
    train, validation = split_data(sequences, pairs, 48, 3, 0)
    assert 0 < len(validation) <= 3
    assert not set(train.pairs) & set(validation.pairs)
    assert len(train) + len(validation) == len(pairs[0])
    few, _ = split_data(sequences, pairs, 48, 0, 4)
    assert len(few) == 4


def test_depth_is_scored_up_to_one_scale():
    truth = torch.tensor([1.0, 2.0, 4.0])
    assert absolute_relative(3 * truth, truth) == pytest.approx(0)
    assert absolute_relative(torch.tensor([1.0, 2.0, 8.0]), truth) == pytest.approx(1 / 3)


@pytest.fixture
def two_views() -> tuple[PixelMatches, TwoViews]:
    """Every twelfth pixel of a bumpy surface, where the second camera sees it."""
    K = torch.tensor([[[240.0, 0, 192], [0, 240.0, 128], [0, 0, 1]]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)[None].repeat(2, 1, 1)
    angle = torch.tensor(0.1)
    pose[1, :3, :3] = torch.tensor([[angle.cos(), 0, angle.sin()], [0, 1, 0], [-angle.sin(), 0, angle.cos()]])
    pose[1, :3, 3] = torch.tensor([0.4, 0.1, -0.2])
    cameras = Cameras(K.repeat(2, 1, 1), torch.zeros(2, 0), pose, 384, 256)
    xy1 = pixel_grid(256, 384)[::12, ::12].reshape(1, -1, 2).double()
    z = 2 + torch.rand(xy1.shape[1], generator=drawn(0)).double()[None]
    xy2, _ = project(cameras[1], unproject(cameras[0], xy1, z))
    inside = ((xy2[0] > 0) & (xy2[0] < torch.tensor([384, 256]))).all(-1)
    ends = [p[0][inside].floor().long() for p in (xy1, xy2)]
    matches = PixelMatches(ends[0], ends[1], torch.ones(int(inside.sum())))
    return matches, TwoViews(cameras[0], relative_poses(pose[1], pose[0]))


def test_true_matches_give_the_true_pose_as_far_as_whole_pixels_allow(two_views: tuple[PixelMatches, TwoViews]):
    error = pose_error(*two_views)
    assert error.rotation_deg < 2
    assert error.translation_deg < 6


def test_a_wrong_pose_is_wrong_by_its_angle(two_views: tuple[PixelMatches, TwoViews]):
    matches, truth = two_views
    turned = truth.second_from_first.clone()
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double()
    turned[:3, :3] = quarter @ turned[:3, :3]
    assert pose_error(matches, replace(truth, second_from_first=turned)).rotation_deg == pytest.approx(90, abs=2)
    turned[:3, 3] *= -1
    assert pose_error(matches, replace(truth, second_from_first=turned)).translation_deg > 174


def test_too_few_matches_are_no_pose(two_views: tuple[PixelMatches, TwoViews]):
    matches, truth = two_views
    few = PixelMatches(matches.xy1[:5], matches.xy2[:5], matches.confidence[:5])
    assert pose_error(few, truth).rotation_deg == 180
