"""swimm3r visits from two runs to maps, places and page."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from tests.visits.conftest import BLEACHED, MOUND, ORIGIN, Visits, dome_volume

from swimm3r.cli.main import main
from swimm3r.errors import InputError, RegistrationError, UsageError
from swimm3r.visits import VisitSettings, write_visits
from swimm3r.visits.record import read_record


@pytest.fixture(scope="module")
def out(visits: Visits, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("compared") / "out"
    write_visits([visits.first, visits.later], folder)
    return folder


def places(out: Path) -> list[dict[str, str]]:
    with (out / "change_1_2" / "places.csv").open() as table:
        return list(csv.DictReader(table))


def test_the_mound_and_the_bleached_disc_are_the_places_that_have_changed(out: Path):
    by_kind = {kind: [each for each in places(out) if each["kind"] == kind] for kind in ("gained", "lost", "paler")}
    (mound,), (white,) = by_kind["gained"], by_kind["paler"]
    assert not by_kind["lost"]
    for found, (x, y) in ((mound, MOUND[:2]), (white, BLEACHED[:2])):
        assert float(found["x"]) == pytest.approx(ORIGIN[0] + x, abs=0.02)
        assert float(found["y"]) == pytest.approx(ORIGIN[1] + y, abs=0.02)
    assert float(mound["volume"]) == pytest.approx(dome_volume(), rel=0.1)
    assert abs(float(mound["volume"]) - dome_volume()) < 3 * float(mound["volume_std"])
    assert float(white["area"]) == pytest.approx(np.pi * BLEACHED[2] ** 2, rel=0.3)  # a rim of a cell
    assert float(white["lightness"]) > 10
    assert abs(float(white["height"])) < 0.003


def test_the_record_says_how_the_visits_were_aligned(out: Path):
    record = read_record(out)
    first, later = record.visits
    assert record.unit == "m"
    assert record.epsg == 32631
    assert first.alignment is None
    assert later.alignment is not None
    assert later.alignment.onto == "spring"
    assert later.alignment.source == "images"
    assert later.alignment.agreeing > 100
    assert later.alignment.level_std < 0.003
    (change,) = record.changes
    assert change.gains == pytest.approx((0.7**-2.2, 0.9**-2.2, 1.0), rel=0.1)  # stored values are not linear
    assert change.places == len(places(out))
    assert "gained" in str(record)


def test_layers_lie_on_one_grid_and_are_those_that_the_record_names(out: Path):
    record = read_record(out)
    (change,) = record.changes
    shapes = set()
    for name in change.files:
        assert (out / change.folder / name).is_file()
    for path in [*out.rglob("*.tif")]:
        with rasterio.open(path) as stored:
            shapes.add((stored.shape, stored.transform))
            assert stored.crs.to_epsg() == 32631
    assert len(shapes) == 1
    with rasterio.open(out / change.folder / "height_changed.tif") as stored:
        kinds = stored.read(1)
    area = (kinds == 2).sum() * record.gsd**2
    assert area == pytest.approx(change.gained_area, rel=1e-6)


def test_polygons_have_the_places_areas_and_figures(out: Path):
    document = json.loads((out / "change_1_2" / "places.geojson").read_text())
    assert document["crs"]["properties"]["name"].endswith("EPSG::32631")
    rows = {each["number"]: each for each in places(out)}
    for feature in document["features"]:
        area = sum(
            (1 if k == 0 else -1) * abs(shoelace(np.array(ring)))
            for part in feature["geometry"]["coordinates"]
            for k, ring in enumerate(part)
        )
        assert area == pytest.approx(float(rows[str(feature["id"])]["area"]), rel=1e-3)
        assert feature["properties"]["kind"] == rows[str(feature["id"])]["kind"]


def shoelace(ring: np.ndarray) -> float:
    x, y = (ring - ring[0]).T
    return float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum() / 2)


@pytest.mark.long
def test_a_visit_compared_with_an_unchanged_one_shows_nothing(visits: Visits, tmp_path: Path):
    from tests.visits.conftest import Seabed, write_visit

    again = tmp_path / "again"
    write_visit(again, Seabed(light=(0.6, 0.8, 0.9)), 7, place=False)
    record = write_visits([visits.first, again], tmp_path / "out")
    (change,) = record.changes
    assert change.places == 0
    assert change.compared_area > 0.5


def test_the_page_shows_both_visits_and_moves_its_slider(out: Path, open_page: Any):
    watched = open_page(out / "visits.html")
    page = watched.page
    assert page.locator("h1").inner_text() == "spring, autumn"
    stage = page.locator(".stage").first
    assert stage.locator("img.under").get_attribute("src").startswith("data:image/jpeg")
    page.locator("input[type=range]").first.fill("20")
    assert stage.evaluate("e => e.style.getPropertyValue('--at')") == "20%"
    before = stage.locator("img.under").get_attribute("src")
    page.get_by_label("changed places").check()
    assert stage.locator("img.under").get_attribute("src") != before
    page.locator(".frame button").nth(1).click()
    assert "Place 1" in page.locator(".name").first.inner_text()
    assert watched.errors == []
    assert watched.overflow == 0


@pytest.mark.long
def test_dives_of_different_places_are_refused_with_advice(
    visits: Visits, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(SystemExit) as left:
        main(["visits", str(visits.first), str(visits.elsewhere), "--out", str(tmp_path / "out")])
    assert left.value.code == RegistrationError.exit_code
    said = capsys.readouterr().err
    assert "elsewhere could not be aligned with spring" in said
    assert "Try:" in said
    assert not (tmp_path / "out").exists()


def test_one_run_and_a_run_given_twice_are_refused(visits: Visits, tmp_path: Path):
    with pytest.raises(UsageError, match="one run alone"):
        write_visits([visits.first], tmp_path / "out")
    with pytest.raises(UsageError, match="twice"):
        write_visits([visits.first, visits.later, visits.first], tmp_path / "out")
    with pytest.raises(InputError):
        write_visits([visits.first, tmp_path], tmp_path / "out")


@pytest.mark.long
def test_a_cell_size_beyond_memory_is_refused_with_one_that_fits(visits: Visits, tmp_path: Path):
    with pytest.raises(UsageError, match="cells") as refused:
        write_visits([visits.first, visits.later], tmp_path / "out", VisitSettings(gsd=1e-5))
    assert "--gsd" in refused.value.hint


@pytest.mark.long
def test_runs_with_georeferences_are_placed_by_them_where_images_do_not_tell(visits: Visits, tmp_path: Path):
    from tests.visits.conftest import Seabed, write_visit

    other = tmp_path / "other"
    write_visit(other, Seabed(seed=9), 5, place=True)
    record = write_visits([visits.first, other], tmp_path / "out")
    found = record.visits[1].alignment
    assert found is not None
    assert found.source == "georeference"
    assert found.error_px is None
    assert record.changes[0].gained_area == pytest.approx(0, abs=0.01)  # bounded by the place's uncertainty
