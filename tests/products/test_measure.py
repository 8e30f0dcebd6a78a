"""Distances, areas and volumes on an analytic seabed, their standard deviations, and points that cannot be measured."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.products.conftest import FOCAL, HEIGHT, ORIGIN, SCALE_STD, WIDTH, Seabed, height, poses

from swimm3r.cli.main import main
from swimm3r.errors import InputError, UsageError
from swimm3r.products import ProductSettings, write_products
from swimm3r.products.measure import Measurement, areas, lengths, measure_run
from swimm3r.products.picked_points import PickedPoint, picked
from swimm3r.products.survey import Survey
from swimm3r.progress import silent
from swimm3r.scene.georeference import load_georeference, save_georeference
from swimm3r.scene.reconstruction import DepthMap, DepthMaps


@pytest.fixture(scope="module")
def run(seabed: Seabed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the run with its maps."""
    folder = tmp_path_factory.mktemp("measure") / "run"
    shutil.copytree(seabed.folder, folder)
    write_products(folder, None, ProductSettings(mesh=False, cloud=False, gsd=0.01), silent)
    return folder


def pixel_of(x: float, y: float, frame: int) -> str:
    """The pixel at which a frame shows a place of the seabed."""
    pose = poses()[frame]
    seen = pose[:3, :3].T @ (np.array([x, y, float(height(np.array(x), np.array(y)))]) - pose[:3, 3])
    u, v = FOCAL * seen[:2] / seen[2] + [WIDTH / 2, HEIGHT / 2]
    assert 1 < u < WIDTH - 1
    assert 1 < v < HEIGHT - 1
    return f"{frame:04d}.png:{u:.3f},{v:.3f}"


def on_map(x: float, y: float, z: float | None = None) -> str:
    return f"@{x + ORIGIN[0]:.4f},{y + ORIGIN[1]:.4f}" + ("" if z is None else f",{z + ORIGIN[2]:.4f}")


def place(x: float, y: float) -> np.ndarray:
    return np.array([x, y, float(height(np.array(x), np.array(y)))])


def by_name(found: list[Measurement], begin: str) -> Measurement:
    (one,) = [each for each in found if each.name.startswith(begin)]
    return one


def test_a_distance_between_pixels_of_two_frames_is_that_on_the_seabed(run: Path):
    found = measure_run(run, distance=[pixel_of(0.05, 0.1, 0), pixel_of(0.55, 0.45, 5)])
    truth = place(0.55, 0.45) - place(0.05, 0.1)
    assert found[0].value == pytest.approx(np.linalg.norm(truth), abs=3e-3)
    assert found[0].unit == "m"
    assert found[0].std is not None
    assert found[0].std == pytest.approx(np.hypot(SCALE_STD * found[0].value, np.sqrt(2) / FOCAL), rel=0.2)
    assert by_name(found, "horizontal").value == pytest.approx(np.hypot(*truth[:2]), abs=3e-3)
    assert by_name(found, "difference in height").value == pytest.approx(truth[2], abs=3e-3)


def test_map_coordinates_take_their_height_from_the_map_or_bring_it(run: Path):
    by_map = measure_run(run, distance=[on_map(0.1, 0.2), on_map(0.7, 0.8)])[0]
    exact = measure_run(run, distance=[on_map(0.1, 0.2, 0.0), on_map(0.7, 0.8, 0.0)])[0]
    assert by_map.value == pytest.approx(np.linalg.norm(place(0.7, 0.8) - place(0.1, 0.2)), abs=2e-3)
    assert exact.value == pytest.approx(0.6 * np.sqrt(2), abs=1e-4)
    assert exact.std == pytest.approx(SCALE_STD * exact.value, rel=1e-6)


def test_a_longer_line_has_its_segments_and_their_sum(run: Path):
    found = measure_run(run, distance=[on_map(0, 0, 0), on_map(0.3, 0, 0), on_map(0.3, 0.4, 0)])
    assert [one.value for one in found[:3]] == pytest.approx([0.3, 0.4, 0.7], abs=1e-3)
    assert by_name(found, "horizontal").value == pytest.approx(0.5, abs=1e-3)


def test_areas_are_those_of_the_outline_in_its_plane_from_above_and_of_the_surface(run: Path):
    outline = [on_map(x, y, 0.5 * x) for x, y in ((0.1, 0.1), (0.7, 0.1), (0.7, 0.9), (0.1, 0.9))]
    found = measure_run(run, area=outline)
    assert by_name(found, "area in the plane").value == pytest.approx(0.48 * np.sqrt(1.25), rel=1e-3)
    planar = by_name(found, "area from above")
    assert planar.value == pytest.approx(0.48, rel=1e-3)
    assert planar.std == pytest.approx(2 * SCALE_STD * 0.48, rel=1e-2)
    assert by_name(found, "perimeter").value == pytest.approx(1.6 + 1.2 * np.sqrt(1.25), rel=1e-3)
    assert 1.0 < by_name(found, "area of the surface").value / planar.value < 1.2


def test_a_triangle_is_an_outline(run: Path):
    found = measure_run(run, area=[on_map(x, y) for x, y in ((0.1, 0.1), (0.9, 0.1), (0.5, 0.9))])
    assert by_name(found, "area from above").value == pytest.approx(0.32, rel=1e-3)
    assert by_name(found, "area of the surface").value >= 0.32


def test_the_volume_of_the_mound_is_that_of_its_integral(run: Path):
    corners = ((0.2, 0.2), (0.8, 0.2), (0.8, 0.8), (0.2, 0.8))
    found = measure_run(run, volume=[on_map(*corner, -0.05) for corner in corners])
    x, y = np.meshgrid(np.linspace(0.2, 0.8, 301), np.linspace(0.2, 0.8, 301))
    truth = (height(x, y) + 0.05).mean() * 0.36
    net = by_name(found, "volume net")
    assert net.value == pytest.approx(truth, rel=0.02)
    assert net.unit == "m³"
    assert by_name(found, "volume above").value - by_name(found, "volume below").value == pytest.approx(net.value)
    assert net.std == pytest.approx(3 * SCALE_STD * net.value, rel=0.1)


def test_an_outline_that_reaches_beyond_the_map_is_measured_in_part(run: Path):
    outline = [on_map(x, y, 0.0) for x, y in ((0.5, 0.2), (20.5, 0.2), (20.5, 0.6), (0.5, 0.6))]  # the map ends at 1.6
    found = measure_run(run, area=outline, volume=outline)
    for name in ("area of the surface", "volume net"):
        (share,) = re.findall(r"(\d+)% of", by_name(found, name).name)
        assert 3 <= int(share) <= 6


def test_deviations_are_those_of_a_simulation(seabed: Seabed):
    survey = seabed.survey()
    exact = replace(survey, place=replace(survey.place, scale_std=0.0))
    rng = np.random.default_rng(0)
    corners = np.array([[0.0, 0, 0], [1, 0, 0.2], [1.2, 1, 0], [0, 1.1, -0.1]])
    sigma = np.diag([0.01, 0.02, 0.03]) ** 2
    drawn = corners + rng.normal(size=(2000, 4, 3)) * np.sqrt(np.diag(sigma))

    def points(xyz: np.ndarray) -> list[PickedPoint]:
        return [PickedPoint("p", one, sigma, True, 3) for one in xyz]

    for told, name in ((lengths, "whole length"), (lambda p, s: areas(p, s, None), "area in the plane")):
        std = by_name(told(points(corners), exact), name).std
        values = [by_name(told(points(xyz), exact), name).value for xyz in drawn[:400]]
        assert std == pytest.approx(np.std(values), rel=0.1)


def test_figures_against_the_level_are_as_uncertain_as_up(seabed: Seabed):
    survey = seabed.survey()
    exact = replace(survey, place=replace(survey.place, scale_std=0.0, rotation_std_deg=(0.5, 2.0, 9.0)))
    guessed = replace(survey, place=replace(survey.place, scale_std=0.0, rotation_std_deg=None))
    measured = replace(guessed, rec=replace(guessed.rec, up=(0.0, 0.0, 1.0)))
    north = [PickedPoint("p", np.array([0.0, y, 0.2 * y]), np.zeros((3, 3)), True, 3) for y in (0.0, 10.0)]
    corners = [[0.0, 0, 0], [2.0, 0, 2], [2.0, 1, 2], [0.0, 1, 0]]  # sloping by 45 degrees to the west
    outline = [PickedPoint("p", np.array(xyz), np.zeros((3, 3)), True, 3) for xyz in corners]
    rise, level = (by_name(lengths(north, exact), name).std for name in ("difference", "horizontal"))
    assert rise == pytest.approx(10 * np.radians(0.5), rel=1e-3)
    assert level == pytest.approx(2 * np.radians(0.5), rel=1e-3)
    assert by_name(areas(outline, exact, None), "area from above").std == pytest.approx(2 * np.radians(2.0), rel=1e-3)
    assert by_name(areas(outline, exact, None), "area in the plane").std == pytest.approx(0, abs=1e-6)
    assert by_name(lengths(north, measured), "difference").std == pytest.approx(10 * np.radians(1.0), rel=1e-3)
    for told in (*lengths(north, guessed), *areas(outline, guessed, None)):
        assert (told.std is None) == told.name.startswith(("horizontal", "difference", "area from above"))


def test_depth_maps_that_disagree_make_a_point_uncertain(seabed: Seabed, tmp_path: Path):
    survey = seabed.survey()
    noisy = DepthMaps(tmp_path)
    rng = np.random.default_rng(0)
    for name in survey.rec.names:
        depth = survey.rec.depth[name]
        noisy.write(name, DepthMap(depth.z_depth * (1 + 0.02 * rng.normal()), depth.confidence))
    other = Survey(survey.folder, replace(survey.rec, depth=noisy), survey.frames, survey.place)
    text = pixel_of(0.5, 0.5, 5)
    exact, uncertain = (np.sqrt(np.trace(picked(one, text, None).covariance)) for one in (survey, other))
    assert uncertain > 1.2 * exact
    assert picked(other, text, None).others >= 2


def test_without_the_deviation_of_the_scale_none_is_told(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    copied = tmp_path / "run"
    shutil.copytree(run, copied, ignore=shutil.ignore_patterns("products"))
    georeference = load_georeference(copied)
    assert georeference is not None
    save_georeference(copied, replace(georeference, scale_std=None))
    main(["measure", str(copied), "--distance", on_map(0, 0, 0), on_map(1, 0, 0)])
    assert "1 (standard deviation not known) m" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("point", "why"),
    [
        ("0000.png", "neither a frame"),
        ("0000.png:5", "1 coordinates"),
        ("0000.png:a,b", "no numbers"),
        ("0000.png:nan,3", "not finite"),
        ("0000.png:500,3", "96 x 72 pixels"),
        ("0000.png:-1,3", "96 x 72 pixels"),
        ("nobody.png:5,3", "no frame with a pose"),
        ("@1", "1 coordinates"),
        ("@1,2,3,4", "4 coordinates"),
        ("", "neither a frame"),
        (":", "no frame with a pose"),
    ],
)
def test_what_is_no_point_is_refused_in_words(run: Path, point: str, why: str):
    with pytest.raises(UsageError, match=re.escape(why)):
        measure_run(run, distance=[point, on_map(0, 0, 0)])


def test_too_few_points_and_none_are_refused(run: Path):
    with pytest.raises(UsageError, match="at least 3 points"):
        measure_run(run, area=[on_map(0, 0), on_map(1, 0)])
    with pytest.raises(UsageError, match="nothing to measure"):
        measure_run(run)


def test_places_without_a_measurement_are_refused(run: Path):
    with pytest.raises(InputError, match="no height was measured at"):
        measure_run(run, distance=[on_map(50, 50), on_map(0, 0)])
    with pytest.raises(InputError, match="no height was measured inside"):
        measure_run(run, volume=[on_map(x, y, 0) for x, y in ((50, 50), (51, 50), (51, 51))])


def test_a_pixel_without_depth_names_the_nearest_with(seabed: Seabed, tmp_path: Path):
    run = tmp_path / "run"
    shutil.copytree(seabed.folder, run)
    maps = DepthMaps(run / "sfm" / "z_depth")
    depth = maps["0000.png"]
    z = depth.z_depth.clone()
    z[:, :40] = torch.zeros(HEIGHT, 40)
    maps.write("0000.png", DepthMap(z, depth.confidence))
    with pytest.raises(InputError, match="no depth was measured") as error:
        measure_run(run, distance=["0000.png:10.5,20.5", "0000.png:60,30"])
    assert "0000.png:40.5,20.5" in error.value.hint


def test_volumes_need_maps_and_maps_of_an_earlier_scale_are_refused(seabed: Seabed, run: Path, tmp_path: Path):
    outline = [on_map(x, y, 0) for x, y in ((0, 0), (1, 0), (1, 1))]
    with pytest.raises(InputError, match="no elevation map"):
        measure_run(seabed.folder, volume=outline)
    rescaled = tmp_path / "run"
    shutil.copytree(run, rescaled)
    georeference = load_georeference(rescaled)
    assert georeference is not None
    save_georeference(rescaled, replace(georeference, scale=0.5))
    with pytest.raises(InputError, match="another scale or place"):
        measure_run(rescaled, volume=outline)
