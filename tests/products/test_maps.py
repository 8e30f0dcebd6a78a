"""Maps of an analytic seabed: heights, colors, place, holes, and how they are made in tiles."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
import torch
from tests.products.conftest import ORIGIN, SCALE_STD, Seabed, color, height, in_water

from swimm3r.cli.main import main
from swimm3r.errors import DeviceError, InputError, UsageError
from swimm3r.evaluate.images import psnr
from swimm3r.products import ProductSettings, write_products
from swimm3r.products.elevation import _medians, gradients, hill_shade
from swimm3r.products.grid import Grid, Window, chosen_gsd, grid_of
from swimm3r.products.preview import decimals_of
from swimm3r.products.record import ProductsRecord, read_record
from swimm3r.progress import silent
from swimm3r.scene.georeference import GEOREFERENCE
from swimm3r.scene.reconstruction import DepthMap, DepthMaps

MAPS = ProductSettings(mesh=False, cloud=False)


@pytest.fixture(scope="module")
def made(seabed: Seabed, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ProductsRecord]:
    out = tmp_path_factory.mktemp("maps") / "products"
    return out, write_products(seabed.folder, out, MAPS, silent)


def cell_middles(file: rasterio.DatasetReader) -> tuple[np.ndarray, np.ndarray]:
    """x and y of all cells in metres from the survey's origin, by the file's own transform."""
    columns, rows = np.meshgrid(np.arange(file.width) + 0.5, np.arange(file.height) + 0.5)
    x, y = file.transform @ (columns, rows)
    return x - ORIGIN[0], y - ORIGIN[1]


def values(path: Path) -> np.ndarray:
    with rasterio.open(path) as file:
        return file.read().astype(np.float64)


def test_elevation_is_that_of_the_seabed_at_its_place_on_the_map(made: tuple[Path, ProductsRecord]):
    with rasterio.open(made[0] / "elevation.tif") as file:
        found = file.read(1).astype(np.float64)
        x, y = cell_middles(file)
        assert file.crs.to_epsg() == 32631
    known = ~np.isnan(found)
    error = found[known] - (height(x, y)[known] + ORIGIN[2])
    assert known.mean() > 0.75
    assert np.sqrt((error**2).mean()) < 2e-3  # of a metre of altitude
    assert np.median(np.abs(error)) < 5e-4


@pytest.mark.parametrize(("name", "levels"), [("orthophoto", 255), ("orthophoto_physical", 65535)])
def test_orthophotos_show_the_seabed_without_water(made: tuple[Path, ProductsRecord], name: str, levels: int):
    with rasterio.open(made[0] / f"{name}.tif") as file:
        rgba = file.read().transpose(1, 2, 0) / levels
        x, y = cell_middles(file)
    shown = rgba[..., 3] == 1
    assert shown.mean() > 0.75
    truth = torch.from_numpy(color(x, y)[shown])
    assert psnr(torch.from_numpy(rgba[..., :3][shown]), truth) > 32


def test_the_orthophoto_as_filmed_keeps_the_water(made: tuple[Path, ProductsRecord]):
    with rasterio.open(made[0] / "orthophoto_filmed.tif") as file:
        rgba = file.read().transpose(1, 2, 0) / 255
        x, y = cell_middles(file)
    shown = rgba[..., 3] == 1
    assert psnr(torch.from_numpy(rgba[..., :3][shown]), torch.from_numpy(in_water(color(x, y)[shown]))) > 34


def test_files_are_cloud_optimized_share_one_grid_and_say_their_units(made: tuple[Path, ProductsRecord]):
    folder, record = made
    maps = [name for name in record.files if name.endswith(".tif") and name != "habitat.tif"]
    assert len(maps) == 8
    for name in maps:
        with rasterio.open(folder / name) as file:
            assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            assert (file.width, file.height) == (record.columns, record.rows)
            assert file.transform.a == pytest.approx(record.gsd)
            assert (file.transform.c, file.transform.f) == pytest.approx((record.west, record.north))
            assert not any(each.name.startswith(".swimm3r") for each in folder.iterdir())
    with rasterio.open(folder / "elevation.tif") as file:
        assert file.units == ("m",)
        assert np.isnan(file.nodata)


def test_cells_lie_on_multiples_of_their_size(made: tuple[Path, ProductsRecord]):
    record = made[1]
    for edge in (record.west, record.north):
        assert abs(edge / record.gsd - round(edge / record.gsd)) < 1e-4


def test_tiles_leave_no_trace(seabed: Seabed, made: tuple[Path, ProductsRecord], tmp_path: Path):
    write_products(seabed.folder, tmp_path / "tiled", ProductSettings(mesh=False, cloud=False, tile=64), silent)
    for name in ("elevation", "hillshade", "orthophoto", "views"):
        whole, tiled = (values(folder / f"{name}.tif") for folder in (made[0], tmp_path / "tiled"))
        assert np.nanquantile(np.abs(whole - tiled), 0.999) <= (1e-4 if name == "elevation" else 2)


def test_the_record_is_read_back_and_tells_units_and_uncertainty(made: tuple[Path, ProductsRecord]):
    folder, record = made
    assert read_record(folder) == record
    assert record.unit == "m"
    assert record.scale_std == SCALE_STD
    assert "±" in str(record)
    assert record.views is not None
    assert record.views > 1


def test_holes_stay_holes(seabed: Seabed, tmp_path: Path):
    run = tmp_path / "run"
    shutil.copytree(seabed.folder, run)
    survey = seabed.survey()
    maps = DepthMaps(run / "sfm" / "z_depth")
    for i, name in enumerate(survey.rec.names):  # nobody measured the mound
        points, depth = survey.points(i), maps[name]
        away = np.hypot(points.xyz[..., 0] - 0.5, points.xyz[..., 1] - 0.5) > 0.15
        maps.write(name, DepthMap(depth.z_depth * torch.from_numpy(away), depth.confidence))
    write_products(run, None, MAPS, silent)
    with rasterio.open(run / "products" / "elevation.tif") as file:
        found = file.read(1)
        x, y = cell_middles(file)
    with rasterio.open(run / "products" / "orthophoto.tif") as file:
        alpha = file.read(4)
    inside = np.hypot(x - 0.5, y - 0.5) < 0.13
    assert np.isnan(found[inside]).all()
    assert not alpha[inside].any()
    told = json.loads((run / "summary.json").read_text())["products"]
    assert told["area"] == pytest.approx(np.isfinite(found).sum() * told["gsd"] ** 2)
    assert told["area_std"] == pytest.approx(2 * SCALE_STD * told["area"])
    assert (told["unit"], "elevation.tif" in told["files"]) == ("m", True)


def test_maps_made_anew_name_what_is_of_an_earlier_time_and_no_record_outlives_its_maps(
    seabed: Seabed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    out, coarse = tmp_path / "products", ProductSettings(mesh=False, cloud=False, gsd=0.04)
    first = write_products(seabed.folder, out, coarse, silent)
    replace(first, files=(*first.files, "mesh.glb")).save(out)
    (out / "mesh.glb").touch()
    assert any("mesh.glb" in note for note in write_products(seabed.folder, out, coarse, silent).notes)

    def interrupted(*_: object) -> list[str]:
        raise KeyboardInterrupt

    monkeypatch.setattr("swimm3r.products.write.write_solids", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_products(seabed.folder, out, replace(coarse, gsd=0.05), silent)
    with rasterio.open(out / "elevation.tif") as file:
        assert file.res == pytest.approx((0.05, 0.05))
    assert read_record(out) is None  # that of cells of 4 cm would place and size the new ones wrongly


def test_without_georeference_up_is_from_the_scene_and_the_unit_stays_unknown(seabed: Seabed, tmp_path: Path):
    run = tmp_path / "run"
    shutil.copytree(seabed.folder, run)
    (run / GEOREFERENCE).unlink()
    record = write_products(run, None, MAPS, silent)
    assert record.unit == "units"
    assert record.epsg is None
    with rasterio.open(run / "products" / "elevation.tif") as file:
        assert file.crs is None
        found = file.read(1)
    # the plane of the ground is taken as level: the relief is that of waves and mound, in units of the run
    assert np.nanmax(found) - np.nanmin(found) < 0.35 / 0.4


def test_a_cell_size_that_would_need_a_huge_map_is_refused(seabed: Seabed):
    with pytest.raises(UsageError, match=r"would have .* of them"):
        grid_of(seabed.survey(), 1e-6)


def test_a_run_without_depth_is_refused(seabed: Seabed, tmp_path: Path):
    run = tmp_path / "run"
    shutil.copytree(seabed.folder, run, ignore=shutil.ignore_patterns("z_depth"))
    with pytest.raises(InputError, match="no depth maps"):
        write_products(run, None, MAPS, silent)


def test_a_missing_package_names_the_extra(seabed: Seabed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(__import__("sys").modules, "rasterio", None)
    with pytest.raises(DeviceError, match="rasterio") as error:
        write_products(seabed.folder, tmp_path / "out", MAPS, silent)
    assert "swimm3r[geo]" in error.value.hint


def test_chosen_cell_sizes_are_round_and_not_below_the_footprint():
    assert [chosen_gsd(value) for value in (0.0052, 0.006, 0.0081, 1.0, 13.0)] == [0.006, 0.006, 0.01, 1.0, 15.0]


def test_tiles_cover_every_cell_once():
    grid, seen = Grid(0, 0, 1, 130, 70), np.zeros((130, 70), int)
    for window in grid.tiles(64):
        seen[window.row : window.row + window.rows, window.column : window.column + window.columns] += 1
    assert (seen == 1).all()


def test_slopes_point_up_to_the_east_and_to_the_north():
    grid = Grid(0, 10, 0.5, 20, 20)
    x, y = np.meshgrid(*grid.centers(Window(0, 0, 20, 20)))
    east, north = gradients(0.3 * x - 0.2 * y, 0.5)
    np.testing.assert_allclose(east[1:-1, 1:-1], 0.3)
    np.testing.assert_allclose(north[1:-1, 1:-1], -0.2)


def test_slopes_towards_the_light_are_brighter_than_level_ground():
    x, y = np.meshgrid(np.arange(5.0), -np.arange(5.0))
    level, facing, averted = (hill_shade(k * (x - y), 1.0)[2, 2] for k in (0, 0.5, -0.5))
    assert averted < level < facing


def test_the_command_prints_the_figures_and_the_report_shows_the_maps(
    seabed: Seabed, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    run = tmp_path / "run"
    shutil.copytree(seabed.folder, run)
    main(["products", str(run), "--no-mesh", "--no-cloud", "--gsd", "0.02"])
    printed = capsys.readouterr().out
    assert "cells of 0.02 m" in printed
    assert "± 1.00%, from a scale bar" in printed
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "Maps from above" in page
    assert page.count("Orthophoto without water") >= 1
    assert "products/" in page


def test_marks_of_a_color_bar_tell_deep_heights_apart():
    assert f"{-1855.5:.{decimals_of(0.5)}f}" == "-1855.50"
    assert [decimals_of(step) for step in (0.004, 0.5, 1.0, 12.0, 300.0)] == [4, 2, 1, 0, 0]


def test_run_makes_the_products_of_what_it_finished(
    seabed: Seabed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    run = tmp_path / "run"
    shutil.copytree(seabed.folder, run)
    monkeypatch.setattr("swimm3r.cli.pipeline.run.run_stages", lambda *given: None)
    main(["run", str(tmp_path), "--out", str(run), "--preset", "fast", "--products"])
    record = read_record(run / "products")
    assert record is not None
    assert {"orthophoto.tif", "elevation.tif", "habitat.csv", "mesh.glb", "cloud.laz"} <= set(record.files)
    assert "cells of" in capsys.readouterr().out


def test_run_asks_for_the_packages_before_its_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("swimm3r.cli.pipeline.run.run_stages", lambda *given: pytest.fail("the work began"))
    monkeypatch.setitem(__import__("sys").modules, "laspy", None)
    with pytest.raises(SystemExit) as stop:
        main(["run", str(tmp_path), "--out", str(tmp_path / "run"), "--preset", "fast", "--products"])
    assert stop.value.code == 5
    assert "swimm3r[geo]" in capsys.readouterr().err


@pytest.mark.parametrize("settings", [{"gsd": 50.0}, {"min_views": 200}])
def test_a_map_without_any_height_is_refused_and_leaves_nothing(seabed: Seabed, tmp_path: Path, settings: dict):
    with pytest.raises(InputError, match="no cell of the map"):
        write_products(seabed.folder, tmp_path / "out", replace(MAPS, **settings), silent)
    assert not (tmp_path / "out").exists()


def test_cells_that_many_views_show_are_kept_however_many_are_asked_for():
    views = np.array([[60, 30]], np.uint16)
    heights, weights = np.zeros((32, 1, 2)), np.ones((32, 1, 2), np.float32)
    height, _, _ = _medians(heights, weights, views, 40)
    assert np.isfinite(height).tolist() == [[True, False]]
