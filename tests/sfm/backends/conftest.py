"""Two synthetic dives that an exact network knows, and what the MASt3R back end makes of the small one."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from tests.sfm.backends.exact_network import QUICK, Dive, ExactNetwork, make_dive

import swimm3r
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.backends import mast3r as mast3r_backend
from swimm3r.sfm.mast3r.settings import MatchingSettings
from swimm3r.sfm.mast3r_sfm import run_pairs
from swimm3r.sfm.settings import Mast3rSettings


@pytest.fixture
def dry(monkeypatch: pytest.MonkeyPatch) -> None:
    """The water has its own tests; `finished` is made with it."""
    monkeypatch.setattr(mast3r_backend, "with_water", lambda rec, *_: rec)


@pytest.fixture
def take(monkeypatch: pytest.MonkeyPatch) -> Callable[[ExactNetwork], None]:
    """Makes the back end find a network where it looks for a checkpoint."""

    def place(network: ExactNetwork) -> None:
        monkeypatch.setattr(run_pairs.checkpoint, "load", lambda path, device, dtype: network)

    return place


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Dive:
    """Six training frames of 128 x 96, which the network sees as they are."""
    folder = tmp_path_factory.mktemp("small")
    frames, truth = make_dive(folder, frames=7, width=128, height=96)
    settings = Mast3rSettings(weights=Path(__file__), graph="swin-2", size=128, alignment=QUICK)
    return Dive(frames, truth, settings)


@pytest.fixture(scope="session")
def large(tmp_path_factory: pytest.TempPathFactory) -> Dive:
    """Five training frames of the network's own size. A thin graph, fewer searches and half the iterations keep it
    short; SWIMM3R_FULL=1 takes every default instead."""
    frames, truth = make_dive(tmp_path_factory.mktemp("large"), frames=6, width=512, height=384)
    if os.environ.get("SWIMM3R_FULL"):
        return Dive(frames, truth, Mast3rSettings(weights=Path(__file__)))
    settings = Mast3rSettings(
        weights=Path(__file__),
        graph="swin-1",
        matching=MatchingSettings(subsample=16),
        alignment=replace(QUICK, coarse_iterations=150, fine_iterations=150),
    )
    return Dive(frames, truth, settings)


@pytest.fixture(scope="session")
def finished(small: Dive, tmp_path_factory: pytest.TempPathFactory) -> tuple[Reconstruction, Path]:
    folder = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        network = small.network()
        patch.setattr(run_pairs.checkpoint, "load", lambda *_: network)
        return swimm3r.reconstruct(small.frames, small.settings, folder), folder
