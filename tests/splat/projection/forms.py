"""The fast forms of the projection: Numba's, and Warp's where it is installed, on its CPU device."""

import importlib
from importlib.util import find_spec
from types import ModuleType

import pytest

FORMS = [
    "cpu_project",
    pytest.param(
        "cuda_project",
        marks=pytest.mark.skipif(find_spec("warp") is None, reason="warp-lang is missing: its kernel did not run"),
    ),
]


def form_called(name: str) -> ModuleType:
    """The module of one of FORMS."""
    return importlib.import_module(f"swimm3r.splat.projection.{name}")
