"""Answers of the MASt3R back end to a network that is wrong, and to settings and files that do not fit."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.sfm.backends.exact_network import Dive, ExactNetwork

import swimm3r
from swimm3r.cameras import cameras_of
from swimm3r.errors import DeviceError, InputError, RegistrationError, Swimm3rError, UsageError, WeightsError
from swimm3r.io.cameras_json import CameraTable

pytestmark = pytest.mark.usefixtures("dry")


class Strangers(ExactNetwork):
    """Frames of the two halves of the dive have nothing in common; `alone` makes all frames strangers."""

    alone = False

    def descriptors(self, view, which):
        found = super().descriptors(view, which)
        a, b = (int(tokens[0, 0, 0]) for tokens in view.tokens)
        if self.alone or (a < self.border) != (b < self.border):
            found.descriptors[:] = 0.2
        return found

    border = 3


class OneStranger(Strangers):
    border = 5


class Hermits(Strangers):
    alone = True


class NotANumber(ExactNetwork):
    def pointmap(self, view, which):
        found = super().pointmap(view, which)
        found.points[0, 5, 7] = torch.nan
        return found


@pytest.mark.parametrize(
    ("kind", "error", "code", "message"),
    [
        (Hermits, RegistrationError, 6, "not one pixel of the 6 frames matches"),
        (Strangers, RegistrationError, 6, "2 groups without enough matches between them, of 3, 3 frames"),
        (NotANumber, WeightsError, 4, "pointmap is not finite at 1 of 12,288 pixels"),
    ],
)
def test_what_the_network_may_say_wrong(
    kind: type[ExactNetwork],
    error: type[Swimm3rError],
    code: int,
    message: str,
    small: Dive,
    tmp_path: Path,
    take: Callable[[ExactNetwork], None],
):
    take(small.network(kind=kind))
    with pytest.raises(error) as caught:
        swimm3r.reconstruct(small.frames, small.settings, tmp_path)
    assert message in caught.value.what
    assert caught.value.exit_code == code
    assert caught.value.hint


def test_a_single_stray_frame_is_left_out_under_a_warning(
    small: Dive, tmp_path: Path, take: Callable[[ExactNetwork], None]
):
    take(small.network(kind=OneStranger))
    rec = swimm3r.reconstruct(small.frames, replace(small.settings, min_share=0.8), tmp_path)
    assert rec.names == small.frames.train.names[:5]
    assert "1 of 6 frames match no other" in rec.warnings[0].what


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"graph": "vidoe"}, UsageError, "no pair graph 'vidoe'"),
        ({"focal": 2.8}, UsageError, "a focal length of 2.8 px does not fit"),
        ({"camera": "OPENCV", "k1": 0.1}, UsageError, "must be known before the network"),
        ({"focal": 200.0, "k1": 0.1}, UsageError, "PINHOLE has no k1"),
        ({"weights": Path("/nowhere/mast3r.pth")}, WeightsError, "there are no weights at /nowhere/mast3r.pth"),
        ({"device": "mps"}, DeviceError, "there is no mps device"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_settings_that_cannot_work_are_refused(
    change: dict, error: type[Swimm3rError], message: str, small: Dive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    with pytest.raises(error, match=message):
        swimm3r.reconstruct(small.frames, replace(small.settings, **change), tmp_path)


def test_a_lamp_beside_the_daylight_of_an_adapter_is_refused(small: Dive):
    adapted = replace(small.settings, adapter=Path("adapter.safetensors"))
    with pytest.raises(UsageError, match="--adapter and --light lamp exclude each other"):
        replace(adapted, light="lamp")
    assert replace(adapted, light="auto").light == "auto"


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"focal": 100.0}, UsageError, "--known and --focal contradict each other"),
        ({"bundle_adjustment": True}, UsageError, "--known and --bundle-adjustment contradict"),
        ({}, InputError, "none of the 6 frames is in"),
    ],
    ids=lambda value: next(iter(value), "names") if isinstance(value, dict) else "",
)
def test_known_cameras_that_do_not_fit_are_refused(
    change: dict, error: type[Swimm3rError], message: str, small: Dive, tmp_path: Path
):
    table = CameraTable(
        ("reef.jpg",), 128, 96, "PINHOLE", small.cameras.K[:1].numpy(), np.zeros((1, 0)), np.eye(4)[None]
    )
    cameras_of(table).save(tmp_path / "cameras.json", table.names, table.times, table.units)
    with pytest.raises(error, match=message):
        swimm3r.reconstruct(small.frames, replace(small.settings, known=tmp_path / "cameras.json", **change), tmp_path)
