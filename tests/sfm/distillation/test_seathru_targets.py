"""Restored images for Sea-Thru: near the truth on synthetic water, made once, marked, and trained on."""

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch

from swimm3r.datasets import load, read_tree
from swimm3r.io.images import write_rgb
from swimm3r.medium import Medium, add_water, linear_from_srgb
from swimm3r.sfm.distillation.seathru_targets import with_made_targets

WATER = Medium(torch.tensor([0.08, 0.35, 0.4]), torch.tensor([0.5, 0.18, 0.14]), torch.tensor([0.4, 0.25, 0.2]))
HEIGHT, WIDTH = 60, 80


def clear_image(seed: int) -> torch.Tensor:
    """Sand of every color, half of the light reflected on average, as Sea-Thru supposes."""
    return torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    root = tmp_path / "seathru"
    for k in range(4):
        z = torch.linspace(1.0, 6.0 - k, HEIGHT)[:, None].repeat(1, WIDTH)
        raw = linear_from_srgb(add_water(clear_image(k), z, WATER))
        write_rgb(root / "D1" / "linearPNG" / f"T_S0295{k}.png", (raw.numpy() * 65535 + 0.5).astype(np.uint16))
        depth = z.numpy().astype(np.float32)
        depth[:3, :5] = 0  # a hole
        (root / "D1" / "depth").mkdir(parents=True, exist_ok=True)
        tifffile.imwrite(root / "D1" / "depth" / f"depthT_S0295{k}.tif", depth)
    return root


def test_what_is_made_is_nearer_to_the_clear_image_than_what_was_taken(scene: Path, tmp_path: Path):
    (made,) = with_made_targets(read_tree(scene).sequences, tmp_path / "made")
    for k in range(4):
        view = load(made, k)
        J = clear_image(k)
        restored, taken = ((image - J).abs().mean((0, 1)) for image in (view.clean, view.raw))
        assert restored.mean() < 0.8 * taken.mean()
        assert restored[0] < 0.6 * taken[0]  # red, where the water takes most
    assert load(made, 0).clean[:3, :5].isfinite().all()


def test_targets_are_marked_as_made_and_made_only_once(scene: Path, tmp_path: Path):
    sequences = read_tree(scene).sequences
    (first,) = with_made_targets(sequences, tmp_path / "made")
    assert any("made, not photographed" in note for note in first.notes)
    about = json.loads((tmp_path / "made" / "D1" / "made.json").read_text())
    assert len(about["images"]) == 4
    assert "Sea-Thru" in about["made_by"]
    image = tmp_path / "made" / "D1" / "T_S02950.png"
    stamp = image.stat().st_mtime_ns
    (second,) = with_made_targets(sequences, tmp_path / "made")
    assert image.stat().st_mtime_ns == stamp
    assert second == first
    assert not list(scene.rglob("made*"))


def test_an_interrupted_making_is_done_again(scene: Path, tmp_path: Path):
    sequences = read_tree(scene).sequences

    class StopError(Exception):
        pass

    def stop(what: str, done: int, total: int, /) -> None:
        if done == 2:
            raise StopError

    with pytest.raises(StopError):
        with_made_targets(sequences, tmp_path / "made", stop)
    (made,) = with_made_targets(sequences, tmp_path / "made")
    assert all(load(made, k).clean is not None for k in range(4))


def test_other_data_sets_keep_their_own_images(tmp_path: Path):
    for kind in ("raw", "clean"):
        write_rgb(tmp_path / "own" / kind / "a.png", np.zeros((8, 8, 3), np.uint8))
    sequences = read_tree(tmp_path / "own").sequences
    assert with_made_targets(sequences, tmp_path / "made") == sequences


def test_a_scene_without_usable_depth_is_left_out_with_a_note(scene: Path, tmp_path: Path):
    for path in (scene / "D1" / "depth").iterdir():
        tifffile.imwrite(path, np.zeros((HEIGHT, WIDTH), np.float32))
    (left,) = with_made_targets(read_tree(scene).sequences, tmp_path / "made")
    assert all(shot.clean is None for shot in left.shots)
    assert any("not for training" in note for note in left.notes)
