"""A small dive of known depth with an object in one frame."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from swimm3r.io import images
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import DepthMaps, Reconstruction

ROWS, COLUMNS = slice(24, 50), slice(30, 60)
MOVED = 3  # the frame with the object


@pytest.fixture
def filmed(dive, tmp_path: Path) -> tuple[Frames, Reconstruction]:
    """The flat dive with a black object in one frame, which has no depth there."""
    frames, rec = dive.frames, dive.rec
    shutil.copytree(rec.depth.folder, tmp_path / "sfm" / "z_depth")
    shutil.copytree(frames.frames[0].path.parent, tmp_path / "images")
    frames = replace(frames, frames=tuple(replace(frame, path=tmp_path / "images" / frame.name) for frame in frames))
    rec = replace(rec, depth=DepthMaps(tmp_path / "sfm" / "z_depth"))
    image = frames.image(MOVED).numpy().copy()
    image[ROWS, COLUMNS] = 0.0
    images.write_rgb(frames.frames[MOVED].path, image)
    depth = rec.depth[rec.names[MOVED]]
    z_depth = depth.z_depth.clone()
    z_depth[ROWS, COLUMNS] = 0
    rec.depth.write(rec.names[MOVED], replace(depth, z_depth=z_depth))
    return frames, rec


def moved(frames: Frames) -> torch.Tensor:
    """The object in its frame."""
    truth = torch.zeros(frames.height, frames.width, dtype=torch.bool)
    truth[ROWS, COLUMNS] = True
    return truth
