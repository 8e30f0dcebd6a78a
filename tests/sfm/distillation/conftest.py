"""A small network and eight pairs of a small dive."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from tests.sfm.distillation.training import pairs_of

from swimm3r.sfm.distillation.pairs import PairData
from swimm3r.sfm.mast3r.network import Mast3r
from swimm3r.synthetic import DiveSettings, write_dive


@pytest.fixture(scope="session")
def network(make_small_network: Callable[[], Mast3r]) -> Mast3r:
    return make_small_network()


@pytest.fixture(scope="session")
def dives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_dive(DiveSettings(frames=6, width=64, height=48, family="green"), folder / "green")
    return folder


@pytest.fixture(scope="session")
def eight(dives: Path) -> PairData:
    return pairs_of(dives)


@pytest.fixture(scope="session")
def none(eight: PairData) -> PairData:
    """Nothing to validate on."""
    return replace(eight, pairs=())
