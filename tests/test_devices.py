"""The chosen device, and the message where it is missing."""

import importlib.util
import logging

import pytest
import torch

from swimm3r import devices
from swimm3r.errors import DeviceError


def with_gpu(monkeypatch: pytest.MonkeyPatch, *, warp: bool) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object() if warp else None)


def test_auto_takes_the_first_accelerator_that_is_here(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert devices.chosen("auto").type == "mps"
    assert devices.for_maps().type == "cpu"  # Warp has no kernels for it
    with_gpu(monkeypatch, warp=True)
    assert devices.chosen("auto").type == devices.for_maps().type == "cuda"
    assert devices.chosen("cpu").type == devices.for_maps("cpu").type == "cpu"


def test_a_device_that_is_not_here_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for choose in (devices.chosen, devices.for_maps):
        with pytest.raises(DeviceError, match="there is no cuda device"):
            choose("cuda")


def test_a_gpu_without_warp_is_not_left_idle_in_silence(monkeypatch, caplog):
    with_gpu(monkeypatch, warp=False)
    with caplog.at_level(logging.WARNING):
        assert devices.for_maps().type == "cpu"
    assert "pip install 'swimm3r[cuda]'" in caplog.text
    with pytest.raises(DeviceError, match="NVIDIA Warp"):
        devices.for_maps("cuda")


def test_too_little_memory_says_what_to_make_smaller():
    with pytest.raises(DeviceError, match="too small for this map") as caught, devices.memory_for("this map", "less"):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20 GiB\nmore")
    assert (caught.value.cause, caught.value.hint) == ("CUDA out of memory. Tried to allocate 20 GiB", "less")
