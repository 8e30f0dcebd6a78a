"""Tables of habitat figures: squares, polygons and lines of a GeoJSON file, in any coordinates, and bad files."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import rasterio
from tests.products.conftest import ORIGIN, SCALE_STD, Seabed, height

from swimm3r.errors import InputError
from swimm3r.products import ProductSettings, write_products
from swimm3r.products.geotiff import crs_of
from swimm3r.products.grid import Grid, Window
from swimm3r.products.habitat.areas import along, read_areas
from swimm3r.products.habitat.figures import NAMES, figures
from swimm3r.products.habitat.tables import Lattice, relief_std
from swimm3r.products.record import ProductsRecord
from swimm3r.progress import silent
from swimm3r.scene.georeference import Georeference

SQUARE = [[0.2, 0.1], [0.8, 0.1], [0.8, 0.9], [0.2, 0.9], [0.2, 0.1]]
CUT = [[0.4, 0.3], [0.6, 0.3], [0.6, 0.4], [0.4, 0.4], [0.4, 0.3]]
LINE = [[0.1, 0.0], [0.9, 1.0]]
PLACE = Georeference(32631, ORIGIN, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), 1.0)
LOCAL = Georeference(None, (0.0, 0.0, 0.0), PLACE.rotation, None)


def on_map(nodes: list[list[float]]) -> list[list[float]]:
    return [[x + ORIGIN[0], y + ORIGIN[1]] for x, y in nodes]


def feature(kind: str, coordinates: Any, name: str | None = None) -> dict[str, Any]:
    properties = {} if name is None else {"name": name}
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}


def written(path: Path, *features: dict[str, Any], crs: str | None = None) -> Path:
    document: dict[str, Any] = {"type": "FeatureCollection", "features": list(features)}
    if crs is not None:
        document["crs"] = {"type": "name", "properties": {"name": crs}}
    path.write_text(json.dumps(document))
    return path


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def made(seabed: Seabed, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ProductsRecord]:
    folder = tmp_path_factory.mktemp("tables")
    areas = written(
        folder / "areas.geojson",
        feature("Polygon", [on_map(SQUARE), on_map(CUT)], "reef"),
        feature("Polygon", [on_map([[90, 90], [91, 90], [91, 91]])], "far"),
        feature("LineString", on_map(LINE), "transect"),
        feature("MultiPolygon", [], "empty"),
        feature("LineString", on_map([LINE[0], LINE[0]]), "clicked twice"),
    )
    areas.write_text("\ufeff" + areas.read_text(), encoding="utf-8")  # as editors of Windows write it
    settings = ProductSettings(areas=areas, habitat_resolution=0.02, habitat_cell=0.4, mesh=False, cloud=False)
    return folder / "products", write_products(seabed.folder, folder / "products", settings, silent)


def true_heights(spacing: float) -> np.ndarray:
    """Heights of the seabed over the square, the first row in the north."""
    x, y = np.meshgrid(np.arange(0.2, 0.8, spacing), np.arange(0.9, 0.1, -spacing))
    return height(x, y)


def test_a_polygon_has_the_area_and_the_ruggedness_of_its_ground(made: tuple[Path, ProductsRecord]):
    (row,) = table(made[0] / "areas.csv")
    assert row["name"] == "reef"
    truth = figures(true_heights(0.02), 0.02)
    assert truth is not None
    assert float(row["planar_area_m2"]) == pytest.approx(0.6 * 0.8 - 0.2 * 0.1, rel=1e-5)
    assert float(row["planar_area_std_m2"]) == pytest.approx(2 * SCALE_STD * float(row["planar_area_m2"]), rel=1e-3)
    for name in ("rugosity", "chain_rugosity"):
        assert float(row[name]) == pytest.approx(getattr(truth, name), rel=0.01)
    assert float(row["mean_slope_deg"]) == pytest.approx(truth.mean_slope_deg, rel=0.05)
    assert float(row["relief_m"]) == pytest.approx(truth.relief, rel=0.05)
    assert float(row["relief_std_m"]) > SCALE_STD * truth.relief * 0.9
    assert float(row["resolution_m"]) == pytest.approx(0.02, abs=0.006)


def test_the_part_of_a_polygon_off_the_map_counts_as_not_covered(seabed: Seabed, tmp_path: Path):
    wide = [[0.2, 0.1], [10.2, 0.1], [10.2, 0.9], [0.2, 0.9]]
    areas = written(tmp_path / "wide.json", feature("Polygon", [on_map(wide)]))
    write_products(
        seabed.folder,
        tmp_path / "out",
        ProductSettings(areas=areas, habitat_resolution=0.02, mesh=False, cloud=False),
        silent,
    )
    (row,) = table(tmp_path / "out" / "areas.csv")
    assert float(row["coverage"]) == pytest.approx(float(row["planar_area_m2"]) / 8, rel=1e-5)
    assert 0.05 < float(row["coverage"]) < 0.2


def test_what_lies_outside_is_named(made: tuple[Path, ProductsRecord]):
    assert any("far, clicked twice of" in note for note in made[1].notes)
    assert "far" in str(made[1])


def test_a_profile_follows_the_ground(made: tuple[Path, ProductsRecord]):
    rows = table(made[0] / "profiles.csv")
    assert {row["name"] for row in rows} == {"transect", "clicked twice"}
    x, y, z = (np.array([float(row[key]) for row in rows]) for key in ("easting", "northing", "height_m"))
    np.testing.assert_allclose(z, height(x - ORIGIN[0], y - ORIGIN[1]) + ORIGIN[2], atol=4e-3)
    (line,) = table(made[0] / "lines.csv")
    assert float(line["length_m"]) == pytest.approx(np.hypot(0.8, 1.0), rel=1e-5)
    assert float(line["length_std_m"]) == pytest.approx(SCALE_STD * float(line["length_m"]), rel=1e-3)
    assert 1 < float(line["chain_rugosity"]) < 1.2


def test_heights_are_read_piece_by_piece(made: tuple[Path, ProductsRecord], monkeypatch: pytest.MonkeyPatch):
    record = made[1]
    grid = Grid(record.west - ORIGIN[0], record.north - ORIGIN[1], record.gsd, record.rows, record.columns)
    heights = Lattice(grid, PLACE, 2, made[0])
    window = Window(-3, 5, 80, 60)
    whole = heights.heights(window)
    monkeypatch.setattr("swimm3r.products.habitat.tables._PIECE", 1000)
    np.testing.assert_array_equal(heights.heights(window), whole)
    assert np.isfinite(whole).mean() > 0.5
    assert heights.heights(Window(0, 0, 0, 7)).shape == (0, 7)


def test_the_relief_is_as_uncertain_as_the_scale():
    known, unknown = (replace(PLACE, scale_std=std) for std in (0.02, None))
    assert relief_std(2.0, known, 0.01) == pytest.approx(np.hypot(0.04, np.sqrt(2) * 0.01))
    assert relief_std(2.0, unknown, 0.01) is None
    assert relief_std(2.0, LOCAL, 0.01) == pytest.approx(np.sqrt(2) * 0.01)  # in units of the run, which are exact


def test_squares_are_a_table_and_a_map_of_the_same_figures(made: tuple[Path, ProductsRecord]):
    rows, record = table(made[0] / "habitat.csv"), made[1]
    with rasterio.open(made[0] / "habitat.tif") as file:
        assert file.descriptions == NAMES
        values = file.read()
        for row in rows:
            r, c = (int(number) - 1 for number in row["name"].split("-"))
            assert values[NAMES.index("rugosity"), r, c] == pytest.approx(float(row["rugosity"]), rel=1e-5)
            middle = file.transform @ (c + 0.5, r + 0.5)
            assert (float(row["easting"]), float(row["northing"])) == pytest.approx(middle, abs=1e-3)
    assert record.habitat is not None
    assert record.habitat.squares == len(rows) > 3


def test_coordinates_are_read_in_the_system_that_the_file_declares(tmp_path: Path):
    back = pyproj.Transformer.from_crs(32631, 4326, always_xy=True)
    degrees = [list(back.transform(x, y)) for x, y in on_map(SQUARE)]
    plain = written(tmp_path / "plain.json", feature("Polygon", [on_map(SQUARE)]))
    declared = written(
        tmp_path / "declared.json", feature("Polygon", [on_map(SQUARE)]), crs="urn:ogc:def:crs:EPSG::32631"
    )
    by_range = written(tmp_path / "degrees.json", feature("Polygon", [degrees]))
    crs84 = written(tmp_path / "crs84.json", feature("Polygon", [degrees]), crs="urn:ogc:def:crs:OGC:1.3:CRS84")
    for path in (plain, declared, by_range, crs84):
        ((area,), _) = read_areas(path, PLACE)
        np.testing.assert_allclose(area.parts[0][0], SQUARE, atol=1e-6)


def test_a_run_without_a_place_takes_local_coordinates_alone(tmp_path: Path):
    ((area,), _) = read_areas(written(tmp_path / "a.json", feature("Polygon", [SQUARE])), LOCAL)
    np.testing.assert_allclose(area.parts[0][0], SQUARE)
    with pytest.raises(InputError, match="no place on the map"):
        read_areas(written(tmp_path / "b.json", feature("Polygon", [SQUARE]), crs="EPSG:32631"), LOCAL)


def test_names_are_distinct_and_parts_of_a_line_are_numbered(tmp_path: Path):
    path = written(
        tmp_path / "a.json",
        feature("Polygon", [SQUARE], "a"),
        feature("MultiPolygon", [[SQUARE], [CUT]], "a"),
        feature("MultiLineString", [LINE, LINE[::-1]], "line"),
        feature("Polygon", [CUT]),
    )
    areas, lines = read_areas(path, LOCAL)
    assert [area.name for area in areas] == ["a", "a (2)", "4"]
    assert len(areas[1].parts) == 2
    assert [line.name for line in lines] == ["line 1", "line 2"]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "line 1"),
        ("[]", "object"),
        ('{"type": "FeatureCollection"}', "features"),
        ('{"type": "FeatureCollection", "features": []}', "no polygon"),
        ('{"type": "Point", "coordinates": [1, 2]}', "Point"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1, 0]]]}', "2 points"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1, 0], ["a", 1]]]}', "float"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [NaN, 1]]]}', "finite"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1]]]}', "inhomogeneous|finite"),
        ('{"type": "Polygon", "coordinates": null}', "no coordinates"),
        ('{"type": "MultiPolygon", "coordinates": null}', "no coordinates"),
        ('{"type": "MultiPolygon", "coordinates": []}', "no polygon"),
        ('{"type": "Polygon", "coordinates": [5]}', "coordinates"),
        ('{"type": "Polygon", "coordinates": [[1, 2, 3]]}', "coordinates"),
        ('{"type": "Polygon", "coordinates": [[[0,0],[1,0],[1,1]]], "crs": {"properties": {"name": "x"}}}', "no EPSG"),
        ('{"type": "Polygon", "coordinates": [[[0,0],[1,0],[1,1]]], "crs": 7}', "crs"),
        ('{"type": "FeatureCollection", "features": [3]}', "feature 1"),
    ],
)
def test_a_file_that_is_no_geojson_of_areas_is_refused_by_name(tmp_path: Path, text: str, why: str):
    path = tmp_path / "areas.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"areas\.json") as error:
        read_areas(path, LOCAL)
    assert __import__("re").search(why, str(error.value)), error.value


def test_a_missing_file_is_named(tmp_path: Path):
    with pytest.raises(InputError, match="missing"):
        read_areas(tmp_path / "none.json", LOCAL)


def test_points_along_a_line_are_evenly_spaced_and_keep_its_ends():
    points, distance = along(np.array([[0.0, 0], [3, 0], [3, 4]]), 0.5)
    assert (len(points), distance[-1]) == (15, 7)
    np.testing.assert_allclose(points[[0, -1]], [[0, 0], [3, 4]])
    np.testing.assert_allclose(np.diff(distance), 0.5)


def test_reference_systems_that_do_not_exist_are_named(tmp_path: Path, seabed: Seabed):
    path = written(tmp_path / "areas.json", feature("Polygon", [SQUARE]), crs="EPSG:99999")
    with pytest.raises(InputError, match="EPSG:99999"):
        read_areas(path, PLACE)
    with pytest.raises(InputError, match="EPSG:99999"):
        crs_of(replace(PLACE, epsg=99999))
