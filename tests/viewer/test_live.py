"""The page of a training: pictures while somebody watches, within their share of the time, and the same map."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.splat.conftest import TinyDive
from tests.viewer.test_layers import frame_view

from swimm3r.progress import silent
from swimm3r.splat import train
from swimm3r.splat.settings import DensifySettings, InitialSettings, UwbsSettings
from swimm3r.splat.training.observer import TrainingStep
from swimm3r.viewer.layers import LayerChoice, Picture
from swimm3r.viewer.live import LiveView
from swimm3r.viewer.server import free_port
from swimm3r.viewer.settings import ViewerSettings

TRAINING = UwbsSettings(
    iterations=12, initial=InitialSettings(primitives=300, scale=2.0), densify=DensifySettings(cap_max=400)
)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def page(tmp_path: Path, clock: Clock) -> Iterator[LiveView]:
    found = LiveView(tmp_path / "run", ViewerSettings(port=free_port("127.0.0.1", 18_300)), silent, clock=clock)
    yield found
    found.close()


def watched_by_one(page: LiveView, monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Pretend that one browser is connected; returns the pictures that it gets."""
    pictures: list[bool] = []
    monkeypatch.setattr(page.server, "get_clients", lambda: {7: object()})
    assert page._viewer is not None
    page._viewer.loop.add(7, lambda picture, in_full: pictures.append(in_full))
    page._viewer.loop.ask(7, (frame_view(page._viewer.painter.run), LayerChoice()))
    return pictures


def last_step(tiny_dive: TinyDive, folder: Path) -> TrainingStep:
    steps: list[TrainingStep] = []
    train(tiny_dive.rec, tiny_dive.frames, TRAINING, folder, silent, observer=steps.append)
    return steps[-1]


def test_a_watched_training_ends_with_the_bits_of_one_that_is_not(
    tiny_dive: TinyDive, tmp_path: Path, page: LiveView, clock: Clock, monkeypatch: pytest.MonkeyPatch
):
    pictures: list[list[bool]] = []

    def observe(step: TrainingStep) -> None:
        clock.now += 10.0  # so that there is time for everything
        page.observe(step)
        if step.step == 1:
            pictures.append(watched_by_one(page, monkeypatch))

    unwatched = train(tiny_dive.rec, tiny_dive.frames, TRAINING, tmp_path / "a", silent)
    watched = train(tiny_dive.rec, tiny_dive.frames, TRAINING, tmp_path / "b", silent, observer=observe)
    same = [torch.equal(a, b) for a, b in zip(unwatched.primitives, watched.primitives, strict=True)]
    assert all(same)
    assert len(pictures[0]) >= 1
    shown = page._viewer.painter.run.scene
    assert torch.equal(shown.primitives.xyz, watched.primitives.xyz)  # the page ends with the finished map
    assert page._chart is not None
    assert page._image.label.startswith("Test frame 8.png" if len(tiny_dive.frames.test) == 1 else "T")


def test_a_page_that_fails_ends_with_a_warning_and_the_training_goes_on(
    tiny_dive: TinyDive,
    tmp_path: Path,
    page: LiveView,
    clock: Clock,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
):
    asked: list[int] = []

    def failing(step: TrainingStep, last: bool) -> None:
        asked.append(step.step)
        raise RuntimeError("no memory for pictures")

    monkeypatch.setattr(page, "_show", failing)
    monkeypatch.setattr(page.server, "get_clients", lambda: {7: object()})
    unwatched = train(tiny_dive.rec, tiny_dive.frames, TRAINING, tmp_path / "a", silent)
    watched = train(tiny_dive.rec, tiny_dive.frames, TRAINING, tmp_path / "b", silent, observer=page.observe)
    assert len(asked) == 1
    assert "the page of the run ends, the run goes on: RuntimeError: no memory for pictures" in caplog.text
    assert torch.equal(unwatched.primitives.xyz, watched.primitives.xyz)
    page.progress("scoring", 1, 2)  # and after it


def test_without_a_browser_nothing_is_drawn(tiny_dive: TinyDive, tmp_path: Path, page: LiveView, clock: Clock):
    step = last_step(tiny_dive, tmp_path)
    for number in range(1, 50):
        clock.now += 1.0
        page.observe(replace(step, step=number, iterations=100))
    assert page.share_spent == 0
    assert page._chart is None


@pytest.mark.parametrize("seconds", [0.05, 1.0])
def test_pictures_take_their_share_of_the_time_and_no_more(
    tiny_dive: TinyDive,
    tmp_path: Path,
    page: LiveView,
    clock: Clock,
    monkeypatch: pytest.MonkeyPatch,
    seconds: float,
):
    step = last_step(tiny_dive, tmp_path)
    page.observe(replace(step, step=1, iterations=3000))
    watched_by_one(page, monkeypatch)

    def slow(*_: object) -> Picture:
        clock.now += seconds
        return Picture(np.zeros((2, 2, 3), np.uint8), None)

    monkeypatch.setattr(page._viewer.painter, "draw", slow)
    monkeypatch.setattr(page, "_draw_image", slow)
    for number in range(2, 2000):
        clock.now += 0.1
        page._viewer.loop.ask(7, (frame_view(page._viewer.painter.run), LayerChoice()))
        page.observe(replace(step, step=number, iterations=3000))
    assert 0.05 < page.share_spent < 0.13


def test_progress_is_passed_on_and_shown(tmp_path: Path, clock: Clock):
    told: list[tuple[str, int, int]] = []
    settings = ViewerSettings(port=free_port("127.0.0.1", 18_400))
    page = LiveView(tmp_path / "run", settings, lambda *said: told.append(said), clock=clock)
    try:
        clock.now += 1.0
        page.progress("matching frames", 3, 12)
        assert told == [("matching frames", 3, 12)]
        assert page._status.content == "**matching frames**: 3 of 12"
        assert page._bar.value == 25.0
    finally:
        page.close()
