"""The clip of two planes and what structure from motion makes of it, made once."""

from pathlib import Path

import pytest
from tests.sfm.colmap.two_planes import SETTINGS, camera_path, render

from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap import poses as colmap


@pytest.fixture(scope="session")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Frames:
    return render(camera_path(), tmp_path_factory.mktemp("images"))


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sfm")


@pytest.fixture(scope="session")
def rec(frames: Frames, folder: Path) -> Reconstruction:
    return colmap.reconstruct(frames, SETTINGS, folder)
