"""The viewer under load: time to the first picture, pictures per second while moving, and memory over many views.

    python benchmarks/viewer.py RUN [--changes 500] [--browsers 3] [--size 640x360] [--chromium PATH]

A server is started for RUN, a finished run. Clients speak viser's protocol and move along the cameras of the run, 30
views a second; they count the pictures that arrive and do not show them. With --chromium, headless browsers of that
program move instead, by dragging: WebGL is then drawn by the same processors, as nobody would do.
"""

import argparse
import asyncio
import math
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec.msgpack
import numpy as np
import viser
import zstandard
from websockets.asyncio.client import ClientConnection, connect

from swimm3r.geometry import quaternion_from_rotation
from swimm3r.viewer.scene_nodes import vertical_fov
from swimm3r.viewer.viewed_run import ViewedRun, open_viewed_run

PICTURE = "BackgroundImageMessage"
VIEWS_PER_S = 30


@dataclass
class Client:
    """A connection and the pictures that came over it."""

    socket: ClientConnection
    size: tuple[int, int]
    arrived: list[float] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)  # bytes
    last: bytes = b""

    async def listen(self) -> None:
        """Note every picture until the connection closes."""
        async for raw in self.socket:
            assert isinstance(raw, bytes)
            if holds_picture(raw):
                self.arrived.append(time.perf_counter())
                self.sizes.append(len(raw))
                self.last = raw

    @property
    def picture_size(self) -> str:
        """Width and height of the last picture."""
        at = self.last.rindex(b"\xff\xc0\x00\x11\x08") + 5  # of JPEG's start of frame: height and width follow
        height, width = (int.from_bytes(self.last[at + k : at + k + 2], "big") for k in (0, 2))
        return f"{width}x{height}"

    async def look(self, run: ViewedRun, at: float) -> None:
        """Send a camera between those of two frames; `at` is in frames, along the dive and back."""
        last = len(run.cameras) - 1
        at = abs((at + last) % (2 * last) - last) if last else 0.0
        i = min(int(at), max(0, last - 1))
        center = run.cameras.centers[i] + (at - i) * (run.cameras.centers[min(last, i + 1)] - run.cameras.centers[i])
        R = run.cameras.cam2world[i, :3, :3]
        position = (center * run.scale).tolist()
        ahead = ((center + R[:, 2] * run.median_depth) * run.scale).tolist()
        message: dict[str, Any] = {
            "type": "ViewerCameraMessage", "wxyz": quaternion_from_rotation(R).tolist(), "position": position,
            "fov": vertical_fov(run.cameras[i]), "near": 0.02, "far": 1000.0, "image_height": self.size[1],
            "image_width": self.size[0], "look_at": ahead, "up_direction": (-R[:, 1]).tolist(),
        }  # fmt: skip
        await self.socket.send(msgspec.msgpack.encode(message))


def holds_picture(raw: bytes) -> bool:
    """Return whether a window of viser's messages brings a picture."""
    packed = int.from_bytes(raw[8:16], "little")
    sent = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(raw[16 : 16 + packed]))
    return any(message["type"] == PICTURE and message["rgb_data"] is not None for message in sent["messages"])


async def connected(port: int, size: tuple[int, int]) -> Client:
    """A new client."""
    protocol = f"viser-v{viser.__version__}"
    socket = await connect(f"ws://localhost:{port}", subprotocols=[protocol], max_size=None)  # type: ignore[arg-type]
    return Client(socket, size)


def resident_mb(process: int) -> float:
    """Memory of a process, MB."""
    text = Path(f"/proc/{process}/status").read_text()
    found = re.search(r"VmRSS:\s+(\d+)", text)
    assert found is not None
    return int(found[1]) / 1024


async def measure(run: ViewedRun, process: int, port: int, size: tuple[int, int], changes: int, browsers: int) -> None:
    """Print the table of one server."""
    began = time.perf_counter()
    first = await connected(port, size)
    listening = [asyncio.create_task(first.listen())]
    await first.look(run, 0.0)
    while not first.arrived:
        await asyncio.sleep(0.005)
    print(f"first picture {first.arrived[0] - began:.2f} s after connecting")
    await asyncio.sleep(2.0)
    print(f"memory {resident_mb(process):.0f} MB with one client")

    rate, sent = await moved(run, [first], 5 * VIEWS_PER_S, 0.0)
    print(
        f"one client, window {size[0]}x{size[1]}: {rate[0]:.1f} pictures per second of {first.picture_size},"
        f" {sent / 1024:.0f} KB each"
    )

    clients = [first, *[await connected(port, size) for _ in range(browsers - 1)]]
    listening += [asyncio.create_task(client.listen()) for client in clients[1:]]
    rows = 5
    for row in range(rows):
        rate, _ = await moved(run, clients, changes // rows, row * changes / rows)
        moving = clients[-1].picture_size
        await asyncio.sleep(1.0)
        shown = ", ".join(f"{each:.1f}" for each in rate)
        print(
            f"{browsers} clients, {(row + 1) * changes // rows} views each: {shown} pictures per second"
            f" of {moving}, memory {resident_mb(process):.0f} MB"
        )
    for client in clients:
        await client.socket.close()
    for task in listening:
        task.cancel()


async def moved(run: ViewedRun, clients: list[Client], views: int, start: float) -> tuple[list[float], float]:
    """Move every client through so many views; pictures per second of each, and the mean size of a picture."""
    began, before = time.perf_counter(), [len(client.arrived) for client in clients]
    for number in range(views):
        for k, client in enumerate(clients):
            await client.look(run, 0.05 * (start + number) + k)
        await asyncio.sleep(max(0.0, began + (number + 1) / VIEWS_PER_S - time.perf_counter()))
    seconds = time.perf_counter() - began
    counts = [len(client.arrived) - count for client, count in zip(clients, before, strict=True)]
    return [count / seconds for count in counts], float(np.mean(clients[0].sizes[before[0] :] or [math.nan]))


def in_browsers(program: str, port: int, size: tuple[int, int], browsers: int) -> None:
    """The same in headless browsers that drag the view for ten seconds."""
    from playwright.sync_api import sync_playwright

    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=program, args=flags)
        counts: list[list[float]] = []
        pages = []
        for _ in range(browsers):
            page = chromium.new_page(viewport={"width": size[0], "height": size[1]})
            arrived: list[float] = []

            def watch(socket: Any, arrived: list[float] = arrived) -> None:
                socket.on("framereceived", lambda raw: _note(raw, arrived))

            page.on("websocket", watch)
            began = time.perf_counter()
            page.goto(f"http://localhost:{port}")
            while not arrived and time.perf_counter() < began + 60:
                page.wait_for_timeout(20)
            print(f"browser {len(pages) + 1}: first picture {arrived[0] - began:.2f} s after its address was entered")
            counts.append(arrived)
            pages.append(page)
            page.wait_for_timeout(2000)
            page.mouse.move(size[0] / 3, size[1] / 2)
            page.mouse.down()
            before, began = len(arrived), time.perf_counter()
            while time.perf_counter() < began + 5:
                angle = 4 * (time.perf_counter() - began)
                page.mouse.move(size[0] / 3 + 60 * math.sin(angle), size[1] / 2 + 20 * math.cos(angle))
            page.mouse.up()
            rate = (len(arrived) - before) / (time.perf_counter() - began)
            print(f"browser {len(pages)}: {rate:.1f} pictures per second while dragging, {len(pages)} connected")
        chromium.close()


def _note(raw: Any, arrived: list[float]) -> None:
    if isinstance(raw, bytes) and holds_picture(raw):
        arrived.append(time.perf_counter())


def main() -> None:
    """Print the measurements."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--changes", type=int, default=500)
    parser.add_argument("--browsers", type=int, default=3)
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--chromium", default="")
    arguments = parser.parse_args()
    width, height = map(int, arguments.size.split("x"))
    command = [sys.executable, "-m", "swimm3r", "view", str(arguments.run), "--port", "18800"]
    began = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        lines = [next(server.stdout)]
        while not lines[-1].startswith("Ctrl-C"):
            lines.append(next(server.stdout))
        found = re.search(r"http://localhost:(\d+)", "".join(lines))
        assert found is not None
        port = int(found[1])
        print(f"serving {time.perf_counter() - began:.1f} s after the command")
        try:
            if arguments.chromium:
                in_browsers(arguments.chromium, port, (width, height), arguments.browsers)
            else:
                run = open_viewed_run(arguments.run, "cpu")
                asyncio.run(measure(run, server.pid, port, (width, height), arguments.changes, arguments.browsers))
        finally:
            began = time.perf_counter()
            server.send_signal(signal.SIGINT)
            server.wait(30)
        print(f"ended {time.perf_counter() - began:.1f} s after Ctrl-C with exit code {server.returncode}")


if __name__ == "__main__":
    main()
