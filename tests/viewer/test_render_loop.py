"""Turns of the browsers: the latest camera, sizes that keep the pace, fairness, and a clean end."""

import threading
from dataclasses import dataclass, field

import pytest

from swimm3r.viewer.render_loop import RenderLoop
from swimm3r.viewer.settings import ViewerSettings

SETTINGS = ViewerSettings(moving_side=640, full_side=1280, pictures_per_second=5)


@dataclass
class Renderer:
    """A renderer that takes `cost` seconds for a megapixel of a square picture, by a clock of its own."""

    cost: float
    now: float = 100.0
    drawn: list[tuple[object, int, bool]] = field(default_factory=list)

    def draw(self, request: object, side: int, in_full: bool) -> object:
        self.now += self.cost * side**2 / 1e6
        self.drawn.append((request, side, in_full))
        return request

    def clock(self) -> float:
        return self.now

    def loop(self) -> RenderLoop:
        return RenderLoop(self.draw, SETTINGS, self.clock)


def connect(loop: RenderLoop, *browsers: int) -> dict[int, list[tuple[object, bool]]]:
    got: dict[int, list[tuple[object, bool]]] = {browser: [] for browser in browsers}
    for browser in browsers:
        loop.add(browser, lambda picture, in_full, browser=browser: got[browser].append((picture, in_full)))
    return got


def test_the_latest_camera_wins():
    renderer = Renderer(0.1)
    loop = renderer.loop()
    got = connect(loop, 1)
    for number in range(10):
        loop.ask(1, number)
    assert loop.turn()
    assert not loop.turn()
    assert got[1] == [(9, False)]


def test_a_camera_at_rest_gets_one_picture_in_full():
    renderer = Renderer(0.1)
    loop = renderer.loop()
    got = connect(loop, 1)
    loop.ask(1, "here")
    loop.turn()
    assert not loop.turn()
    renderer.now += 0.5
    assert loop.turn()
    assert not loop.turn()
    assert got[1] == [("here", False), ("here", True)]
    assert [side for _, side, _ in renderer.drawn] == [640, 1280]


@pytest.mark.parametrize(("cost", "side"), [(0.1, 640), (2.0, 300), (1000.0, 160)])
def test_the_size_adapts_so_that_the_pace_holds(cost: float, side: int):
    renderer = Renderer(cost)
    loop = renderer.loop()
    connect(loop, 1)
    for number in range(40):
        loop.ask(1, number)
        loop.turn()
    assert loop.side == pytest.approx(side, rel=0.3)
    if cost < 100:
        started = renderer.now
        for number in range(20):
            loop.ask(1, number)
            loop.turn()
        assert 20 / (renderer.now - started) >= SETTINGS.pictures_per_second


def test_the_size_recovers_when_the_computer_does():
    renderer = Renderer(5.0)
    loop = renderer.loop()
    connect(loop, 1)
    for number in range(30):
        loop.ask(1, number)
        loop.turn()
    assert loop.side < 300
    renderer.cost = 0.05
    for number in range(30):
        loop.ask(1, number)
        loop.turn()
    assert loop.side == SETTINGS.moving_side


def test_no_picture_in_full_is_planned_for_more_than_a_second():
    renderer = Renderer(2.0)
    loop = renderer.loop()
    connect(loop, 1)
    for number in range(20):
        loop.ask(1, number)
        loop.turn()
    renderer.now += 1.0
    before = renderer.now
    loop.turn()
    assert renderer.drawn[-1][2]
    assert renderer.now - before <= 1.1


def test_browsers_that_move_take_turns_and_share_the_pace():
    renderer = Renderer(0.2)
    loop = renderer.loop()
    got = connect(loop, 1, 2, 3)
    for number in range(90):
        for browser in (1, 2, 3):
            loop.ask(browser, number)
        loop.turn()
    assert {len(pictures) for pictures in got.values()} == {30}
    assert loop.side < 640  # a third of the time each
    started, before = renderer.now, len(got[2])
    for number in range(60):
        for browser in (1, 2, 3):
            loop.ask(browser, number)
        loop.turn()
    assert (len(got[2]) - before) / (renderer.now - started) >= 0.95 * SETTINGS.pictures_per_second


def test_a_browser_at_rest_is_not_starved_by_one_that_moves():
    renderer = Renderer(0.4)
    loop = renderer.loop()
    got = connect(loop, 1, 2)
    loop.ask(2, "rest")
    for number in range(40):
        loop.ask(1, number)
        loop.turn()
    assert ("rest", True) in got[2]
    assert sum(in_full for _, in_full in got[2]) == 1


def test_a_browser_that_left_is_forgotten():
    renderer = Renderer(0.1)
    loop = renderer.loop()
    got = connect(loop, 1, 2)
    loop.ask(1, "a")
    loop.remove(1)
    loop.ask(1, "b")  # a message that was on its way
    assert not loop.turn()
    assert got[1] == []


def test_a_new_map_is_drawn_for_everyone():
    renderer = Renderer(0.1)
    loop = renderer.loop()
    got = connect(loop, 1, 2)
    for browser in (1, 2):
        loop.ask(browser, "here")
    while loop.turn():
        pass
    loop.ask_again()
    while loop.turn():
        pass
    assert [len([p for p, in_full in got[b] if not in_full]) for b in (1, 2)] == [2, 2]


def test_what_a_picture_raises_ends_the_loop_and_is_kept():
    def fail(request: object, side: int, in_full: bool) -> object:
        raise ValueError("no picture")

    loop = RenderLoop(fail, SETTINGS)
    connect(loop, 1)
    loop.ask(1, "here")
    loop.run()
    assert isinstance(loop.failure, ValueError)
    assert loop.stopped


def test_stop_ends_a_loop_that_waits():
    loop = Renderer(0.0).loop()
    thread = threading.Thread(target=loop.run)
    thread.start()
    loop.stop()
    thread.join(2)
    assert not thread.is_alive()
