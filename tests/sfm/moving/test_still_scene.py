"""Moving objects in an image of known pose, by the frames of a reconstruction."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from tests.sfm.moving.conftest import COLUMNS, MOVED, ROWS, moved

from swimm3r.io import images
from swimm3r.scene.frame_changes import MovingMasks
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.moving.still_scene import beside_edges, still_scene


def test_an_image_that_is_not_of_the_reconstruction_is_asked_by_its_pose(
    filmed: tuple[Frames, Reconstruction],
) -> None:
    frames, rec = filmed
    image, lens = frames.image(MOVED), rec.cameras[MOVED]
    others = [i for i in range(len(rec.names)) if i != MOVED]
    fewer = replace(rec, names=tuple(rec.names[i] for i in others), cameras=rec.cameras[others])
    found, truth = still_scene(fewer, frames).moving_in(lens, image), moved(frames)
    assert (found & truth).sum() > 0.9 * truth.sum()
    assert (found & ~truth).sum() < 0.15 * truth.sum()


def test_masks_of_the_frames_around_an_image_tell_what_moves_with_the_camera(
    filmed: tuple[Frames, Reconstruction], tmp_path: Path
) -> None:
    frames, rec = filmed
    names = [name for i, name in enumerate(rec.names) if i != MOVED]
    nowhere = replace(rec, names=tuple(names), cameras=rec.cameras[[rec.index(name) for name in names]])
    for name in names:  # no frame measured anything where the object is
        z_depth = rec.depth[name].z_depth.clone()
        z_depth[:, 20:70] = 0
        rec.depth.write(name, replace(rec.depth[name], z_depth=z_depth))
    masked = tmp_path / "masks" / f"{names[MOVED]}.png"
    masked.parent.mkdir()
    images.write_mask(masked, ~moved(frames).numpy())
    image = frames.image(frames.index(names[MOVED])).numpy().copy()
    image[ROWS, COLUMNS] = 0.0
    images.write_rgb(frames.frames[frames.index(names[MOVED])].path, image)
    scene = still_scene(replace(nowhere, moving=MovingMasks(masked.parent)), frames)
    lens, filmed_there, truth = rec.cameras[MOVED], frames.image(MOVED), moved(frames)
    assert not scene.moving_in(lens, filmed_there)[truth].any()
    found = scene.moving_in(lens, filmed_there, neighbors=[names[MOVED - 1], names[MOVED]])
    assert (found & truth).sum() > 0.9 * truth.sum()
    assert (found & ~truth).sum() < 0.15 * truth.sum()


def test_surfaces_end_a_pixel_before_depth_edges_and_slopes_and_gaps_are_none() -> None:
    z_depth = np.tile(np.linspace(2, 2.5, 12, dtype=np.float32), (8, 1))
    assert not beside_edges(z_depth).any()
    z_depth[:, 6:] *= 1.5
    z_depth[:, 3] = 0
    assert np.array_equal(np.flatnonzero(beside_edges(z_depth)[4]), [5, 6])
