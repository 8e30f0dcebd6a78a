"""The fast forms of the projection: Numba's, and Warp's where it is installed, on its CPU device."""

import importlib
import importlib.util

import pytest

_NEEDED = {"cpu_project": "numba", "cuda_project": "warp"}
FORMS = [
    pytest.param(
        name,
        id=needs,
        marks=pytest.mark.skipif(
            importlib.util.find_spec(needs) is None, reason=f"{needs} is not installed: its projection was not run"
        ),
    )
    for name, needs in _NEEDED.items()
]


def form_called(name: str):
    """The module of one of FORMS."""
    return importlib.import_module(f"swimm3r.splat.projection.{name}")
