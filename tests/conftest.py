"""The suite runs with every shape annotation of the package checked (jaxtyping + beartype); users never pay for it."""

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does
os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(__file__).parents[1] / ".venv" / "numba-cache"))

from tests.checked_types import check_annotations

check_annotations("swimm3r")

import av
import numpy as np
import pytest
import torch
from tests.browser import WatchedPage, headless_chromium, reason_to_skip, watched_page

from swimm3r.sfm.mast3r.network import Architecture, Mast3r
from swimm3r.synthetic import dive as synthetic_dive

THREADS = int(os.environ.get("SWIMM3R_TEST_THREADS", "1"))  # two xdist workers share two cores
torch.set_num_threads(THREADS)

FIRST_FILES = (
    "pipeline/test_run.py",  # compiles the kernels, while the other worker is at files that need none of them
    "prepare/test_rotation.py", "tasks/test_tasks.py", "docs/test_site.py", "docs/test_settings.py",
    "cli/test_help.py", "test_architecture.py", "test_words.py", "prepare/test_video.py", "scale/test_navigation.py",
    # of more than 20 seconds: started early, so that no worker ends long after the other
    "visits/test_visits.py", "batch/test_run.py", "examples/test_examples.py", "splat/test_elsewhere.py",
    "sfm/medium/least_squares/test_lamp_fit.py", "sfm/colmap/chunks/test_long_clip.py", "sfm/test_ends_of_ranges.py",
    "sfm/colmap/test_poses.py", "visits/test_alignment.py", "localization/test_online.py",
    "localization/test_localizer.py", "splat/recipes/test_recipes.py", "splat/blocks/test_block_training.py",
    "viewer/test_in_browser.py", "test_readme.py",
)  # fmt: skip

SHARED = Path(os.environ.get("SWIMM3R_SHARED", Path(__file__).parents[2] / "shared"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort the tests of `FIRST_FILES` before the others, in that order; each file's tests keep theirs."""
    rank = {Path(__file__).parent / name: place for place, name in enumerate(FIRST_FILES)}
    items.sort(key=lambda item: rank.get(item.path, len(rank)))


@pytest.fixture(autouse=True)
def fresh() -> Iterator[None]:
    """Every test draws the same numbers in every run, and finds threads and messages as a new process has them."""
    torch.manual_seed(0)
    _as_in_a_new_process()
    yield
    _as_in_a_new_process()


def _as_in_a_new_process() -> None:
    """Take back what a test that runs commands or engines may leave behind."""
    torch.set_num_threads(THREADS)
    logging.getLogger("swimm3r").setLevel(logging.NOTSET)


@pytest.fixture(scope="session", autouse=True)
def seafloors() -> Iterator[Any]:
    """Keep the last two seafloors, each of which takes 3 seconds to make; `seafloors.cache_clear()` forgets them."""
    with pytest.MonkeyPatch.context() as patch:
        kept = lru_cache(maxsize=2)(synthetic_dive.make_seafloor)
        patch.setattr(synthetic_dive, "make_seafloor", kept)
        yield kept


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real footage and reference numbers, which are not part of the repository ($SWIMM3R_SHARED)."""
    if not (SHARED / "data").is_dir():
        pytest.skip(f"{SHARED} is not here: nothing was checked against real footage or reference numbers")
    return SHARED


@pytest.fixture(scope="session")
def chromium() -> Iterator[object]:
    """The system's browser, started once; None where there is none."""
    if reason_to_skip():
        yield None
        return
    with headless_chromium() as browser:
        yield browser


@pytest.fixture
def open_page(chromium: Any, request: pytest.FixtureRequest) -> Iterator[Callable[..., WatchedPage]]:
    """Opens a file or an address in the system's Chromium, see `tests.browser.watched_page`; pages end with the test.

    Skips where there is no browser, and says what was not checked.
    """
    if reason := reason_to_skip():
        pytest.skip(f"{reason}: not checked in a browser: {request.node.name.removeprefix('test_').replace('_', ' ')}")
    opened: list[WatchedPage] = []

    def open_one(target: str | Path | None = None, **options: Any) -> WatchedPage:
        opened.append(watched_page(chromium, target, **options))
        return opened[-1]

    yield open_one
    for watched in opened:
        watched.page.context.close()


@pytest.fixture
def write_video() -> Callable[..., Path]:
    """Encodes uint8 RGB frames; `times` in seconds (30 per second by default), further options go to the stream."""

    def write(
        path: Path,
        frames: Iterable[np.ndarray],
        times: Sequence[float] | None = None,
        codec: str = "libx264",
        **stream_options: object,
    ) -> Path:
        tick = Fraction(1, 6000)
        with av.open(str(path), "w") as file:
            options = {"preset": "ultrafast", "crf": "8"} if codec == "libx264" else {}
            if codec == "libx265":
                options = {"preset": "ultrafast", "x265-params": "log-level=none"}
            stream: Any = file.add_stream(codec, rate=30, options=options)
            stream.pix_fmt, stream.codec_context.time_base = "yuv420p", tick
            for name, value in stream_options.items():
                setattr(stream.codec_context, name, value)
            for i, image in enumerate(frames):
                if i == 0:
                    stream.height, stream.width = image.shape[:2]
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), "rgb24")
                frame.pts, frame.time_base = round((times[i] if times is not None else i / 30) / tick), tick
                file.mux(stream.encode(frame))
            file.mux(stream.encode())
        return path

    return write


@pytest.fixture(scope="session")
def make_small_network() -> Callable[[], Mast3r]:
    """Networks of MASt3R's published shape, thousands of times smaller, always with the same random weights."""

    def make() -> Mast3r:
        small = Architecture(
            encoder_dim=64, encoder_depth=2, encoder_heads=1, decoder_dim=64, decoder_depth=4, decoder_heads=1,
            dpt_layer_dims=(4, 6, 8, 10), dpt_feature_dim=8, dpt_last_dims=(4, 4), local_hidden_dim=64,
            descriptor_dim=6,
        )  # fmt: skip
        with torch.random.fork_rng():
            torch.manual_seed(0)
            return Mast3r(small).eval().requires_grad_(False)

    return make


@pytest.fixture(scope="session")
def small_network(make_small_network: Callable[[], Mast3r]) -> Mast3r:
    """One of them, for tests that leave it as it is."""
    return make_small_network()
