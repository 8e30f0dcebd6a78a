"""Repeat visits in the browser: one ground at a time, changes above it, and damaged folders named."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.browser import WatchedPage
from tests.viewer.test_in_browser import WINDOW, complaints, pick, shown, until

from swimm3r.cli.main import main
from swimm3r.errors import InputError
from swimm3r.io.files.atomic import write_text
from swimm3r.products.geotiff import RGBA, Band, MapFile
from swimm3r.products.grid import Grid
from swimm3r.scene.georeference import Georeference
from swimm3r.viewer.server import free_port, started_server
from swimm3r.viewer.settings import ViewerSettings
from swimm3r.viewer.visited_site import open_visited_site
from swimm3r.viewer.visits import VisitsViewer
from swimm3r.visits.page import COLORS
from swimm3r.visits.record import ChangeRecord, VisitRecord, VisitsRecord

SIDE, GSD = 40, 0.05
RED, BLUE = (200, 30, 30), (30, 30, 200)  # the ground at either visit
RAISED = np.s_[10:20, 15:25]
AT = Georeference(None, (100.0, 200.0, -10.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), 1.0)


def _layer(path: Path, values: np.ndarray, bands: tuple[Band, ...]) -> None:
    grid = Grid(0.0, SIDE * GSD, GSD, SIDE, SIDE)
    made = MapFile(path, grid, AT, bands, str(values.dtype))
    for window in grid.tiles(64):
        made.write(window, values)
    made.finish()


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Two visits of a flat floor, red and then blue, with a square that has risen by 20 cm."""
    out = tmp_path / "out"
    (out / "change_1_2").mkdir(parents=True)
    for k, color in enumerate((RED, BLUE)):
        height = np.full((SIDE, SIDE), -10.0, np.float32)
        height[RAISED] += 0.2 * k
        height[:3] = np.nan
        photo = np.full((4, SIDE, SIDE), 255, np.uint8)
        photo[:3] = np.array(color, np.uint8)[:, None, None]
        _layer(out / f"elevation_{k + 1}.tif", height, (Band("height", "m"),))
        _layer(out / f"orthophoto_{k + 1}.tif", photo, RGBA)
    kinds = np.ones((SIDE, SIDE), np.uint8)
    kinds[RAISED] = 2
    _layer(out / "change_1_2" / "height_changed.tif", kinds, (Band("kinds"),))
    write_text(
        out / "change_1_2" / "places.csv",
        f"number,kind,x,y,volume,lightness\n1,gained,{100 + 20 * GSD},{200 + 25 * GSD},0.05,\n",
    )
    visits = tuple(VisitRecord(name, name, 9, 4.0, True, None) for name in ("spring", "autumn"))
    change = ChangeRecord(
        "spring", "autumn", "change_1_2", 4.0, 0.25, 0, 0, 0, 0.05, 0.001, 0, 0, 0.002, 1.0, 0.0, None, None,
        (1.0, 1.0, 1.0), 1, ("height_changed.tif", "places.csv"),
    )  # fmt: skip
    VisitsRecord("m", GSD, SIDE, SIDE, None, 100.0, 200 + SIDE * GSD, 3.0, visits, (change,)).save(out)
    return out


@pytest.fixture
def serve() -> Iterator[Callable[[Path], str]]:
    """Serves a folder of visits, and ends that."""
    ended: list[Callable[[], None]] = []

    def start(folder: Path) -> str:
        settings = ViewerSettings(port=free_port("127.0.0.1", 18_600))
        viewer = VisitsViewer(open_visited_site(folder), settings, started_server(settings, "visits"))
        ended.append(viewer.close)
        return f"http://localhost:{viewer.port}"

    yield start
    for end in ended:
        end()


def test_cells_lie_where_the_maps_have_them_and_changes_above_both_grounds(site: Path):
    read = open_visited_site(site)
    (first, later), (change,) = read.grounds, read.changes
    assert len(first.xyz) == len(later.xyz) == (SIDE - 3) * SIDE  # unknown cells are left out
    assert (first.rgb == RED).all()
    assert np.ptp(later.xyz[:, 2]) == pytest.approx(0.2, abs=1e-5)
    assert len(change.cells.xyz) == 100
    assert (change.cells.rgb == COLORS["gained"]).all()
    assert (change.cells.xyz[:, 2] > later.xyz[:, 2].max()).all()
    middle = change.cells.xyz.mean(0)
    assert middle[:2] == pytest.approx([0.0, (SIDE / 2 - 15) * GSD], abs=1e-5)
    ((x, y, _), words) = change.labels[0]
    assert (x, y) == pytest.approx(tuple(middle[:2]), abs=1e-4)
    assert words == "1 gained +0.05 m³"


def test_a_missing_map_is_named_with_the_command_that_makes_it(site: Path):
    (site / "change_1_2" / "places.csv").unlink()
    with pytest.raises(InputError, match=r"places\.csv is missing") as refused:
        open_visited_site(site)
    assert "swimm3r visits" in refused.value.hint


def test_the_command_line_knows_a_folder_of_visits(site: Path, capsys: pytest.CaptureFixture[str]):
    (site / "elevation_2.tif").write_bytes(b"no map")
    with pytest.raises(SystemExit) as stop:
        main(["view", str(site)])
    assert stop.value.code == InputError.exit_code
    assert "elevation_2.tif" in capsys.readouterr().err


def test_a_browser_switches_between_the_visits_and_their_changes(
    site: Path, serve: Callable[[Path], str], open_page: Any
):
    watched: WatchedPage = open_page(serve(site), **WINDOW)

    def share(channel: int) -> float:
        seen = shown(watched)[180:]  # below the notice of viser
        others = np.delete(seen, channel, axis=-1).max(-1)
        return float((seen[..., channel] > others + 60).mean())

    until(lambda: share(2) > 0.03, watched)  # the later ground is blue
    assert 0.0005 < share(0) < share(2)  # with the risen square in red
    pick(watched, "spring to autumn", "none")
    until(lambda: share(0) < 0.0005, watched)
    pick(watched, "autumn", "spring")
    until(lambda: share(0) > 0.03, watched)
    assert complaints(watched) == []
