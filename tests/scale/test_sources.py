"""Scale bars, named points, lasers, heights and ground control: known truth, and every wrong input by name."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.scale.conftest import HEIGHT, ORIGIN, SCALE, TURN, WIDTH, Survey, write_csv

from swimm3r.errors import InputError, UsageError
from swimm3r.scale.control import fit_control
from swimm3r.scale.estimate import estimate_scale
from swimm3r.scale.marked_points import FrameNames, read_distances, read_points, read_scale_bars
from swimm3r.scale.navigation.geodesy import geodetic_from_local, utm_zone
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scale.solve import ScaleEstimate, solve_scale
from swimm3r.scale.sources import ground_below, placed_points, scale_sources
from swimm3r.scale.triangulation import PoorGeometryError, ScenePoint, Sighting, scale_of_shape, triangulate
from swimm3r.scene.georeference import up_from_scene
from swimm3r.scene.reconstruction import DepthMap, DepthMaps

BAR = np.array([[1.0, 0.4, 0.05], [1.4, 0.7, 0.02]])  # metres; 0.5008 long
LENGTH = float(np.linalg.norm(BAR[1] - BAR[0]))


def words_of(survey: Survey, ends: np.ndarray, length: float, noise: float = 0.0, frames: int = 4) -> tuple[str, ...]:
    """--scale-bar's words for a bar, as some of the frames show it."""
    xy, seen = survey.pixels(ends)
    xy = xy + noise * np.random.default_rng(0).normal(size=xy.shape)
    chosen = np.flatnonzero(seen.all(1))[:frames]
    assert len(chosen) == frames
    marks = [f"{survey.rec.names[i]}:{x:.4f},{y:.4f}" for i in chosen for x, y in xy[i]]
    return (*marks, f"{length:.6f}")


def solved(survey: Survey, **options):
    return estimate_scale(survey.rec, survey.frames, ScaleSettings(**options)).solution


def names_of(survey: Survey) -> FrameNames:
    return FrameNames(survey.rec.names, WIDTH, HEIGHT, ["held.png"])


def test_a_scale_bar_gives_the_scale(survey):
    found = solved(survey, scale_bar=words_of(survey, BAR, LENGTH), point_std=0.1)
    assert found.scale == pytest.approx(SCALE, rel=2e-4)


def test_the_standard_deviation_of_a_bar_is_that_of_repeated_marks(survey):
    xy, seen = survey.pixels(BAR)
    chosen = np.flatnonzero(seen.all(1))[:5]
    logs, stds = [], []
    for seed in range(80):
        noisy = xy + np.random.default_rng(seed).normal(size=xy.shape)
        points = [
            triangulate(survey.rec.cameras, [Sighting(int(i), tuple(noisy[i, k])) for i in chosen], 1.0) for k in (0, 1)
        ]
        scale, std = scale_of_shape(points, np.array([[0.0], [LENGTH]]), 0.0)
        logs.append(np.log(scale / SCALE))
        stds.append(std)
    assert np.std(logs) == pytest.approx(np.mean(stds), rel=0.25)
    assert abs(np.mean(logs)) < 4 * np.std(logs) / np.sqrt(len(logs))


def test_two_bars_are_weighted_by_their_lengths(survey):
    long = np.array([[1.4, -0.3, 0.0], [1.6, 1.2, 0.1]])
    words = (
        *words_of(survey, BAR, LENGTH * 1.01),
        *words_of(survey, long, float(np.linalg.norm(long[1] - long[0])), frames=2),
    )
    found = solved(survey, scale_bar=words, length_std=0.01)
    assert abs(found.scale / SCALE - 1) < 0.005
    assert [each.estimate.source for each in found.sources] == ["scale bar 1", "scale bar 2"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("0003.png:10,20", "0003.png:90,20", "0.5"), "marked in one frame only (0003.png)"),
        (("0003.png:10,20", "0003.png:90,20", "0004.png:9,9", "0.5"), "1 point(s) in 0004.png"),
        (("0003.png:10,20", "0003.png:90,20", "0004.png:9,9", "0004.png:95,9"), "has no length"),
        (("nosuch.png:10,20", "0003.png:90,20", "0.5"), "frame nosuch.png, which this run does not have"),
        (("held.png:10,20", "held.png:90,20", "0.5"), "frame held.png, which has no pose"),
        (("0003.png:1000,20", "0003.png:90,20", "0.5"), "outside of the frame"),
        (("0003:10,20", "0003:90,20", "0004:9,9", "0004:95,9", "half"), "'half' is neither"),
        (("0003:10,20", "0003:90,20", "0004:9,9", "0004:95,9", "-1"), "-1 m long"),
    ],
)
def test_a_scale_bar_that_cannot_be_used_is_named(survey, words, said):
    with pytest.raises((InputError, UsageError)) as told:
        read_scale_bars(words, names_of(survey))
    assert said in str(told.value)


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ("left/0001.png", 0), ("right/0001.png", 2), ("left/0001", 0), ("right/0001.jpg", 2), ("0003", 3),
        ("0003.jpg", 3), ("0002.png", 1), ("dive/prepare/0003.png", 3),
    ],
)  # fmt: skip
def test_short_names_of_frames_tell_one(given, found):
    names = FrameNames(("left/0001.png", "left/0002.png", "right/0001.png", "0003.png"), 10, 10, ["right/0004.png"])
    assert names.sighting("here", given, 1, 1).frame == found


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("0001.png", "several are called so: left/0001.png, right/0001.png"), ("0001", "several"),
        ("right/0002.png", "has no pose"), ("right/0002", "has no pose"), ("0004", "has no pose"),
        ("middle/0003.png", "does not have"), (".", "does not have"),
    ],
)  # fmt: skip
def test_a_frame_of_another_camera_is_never_taken_for_one_without_a_pose(given, said):
    placed = ("left/0001.png", "right/0001.png", "left/0002.png", "left/0003.png")
    names = FrameNames(placed, 10, 10, ["right/0002.png", "0004.png"])
    with pytest.raises(InputError, match=said):
        names.sighting("here", given, 1, 1)


def test_exchanged_ends_in_one_frame_are_named(survey):
    words = list(words_of(survey, BAR, LENGTH))
    words[2], words[3] = words[3], words[2]
    with pytest.raises(InputError, match="contradict each other") as told:
        solved(survey, scale_bar=tuple(words))
    assert "exchanged" in told.value.cause


def test_a_point_seen_from_one_place_has_no_depth(survey):
    with pytest.raises(PoorGeometryError, match="one frame only"):
        triangulate(survey.rec.cameras, [Sighting(3, (100.0, 100.0))], 1.0)
    twin = replace(survey.rec.cameras, cam2world=survey.rec.cameras.cam2world[[3] * 48])
    with pytest.raises(PoorGeometryError, match="nearly the same place"):
        triangulate(twin, [Sighting(3, (100.0, 100.0)), Sighting(4, (100.0, 100.0))], 1.0)


def write_points(path: Path, survey: Survey, points: dict[str, np.ndarray]) -> Path:
    xy, seen = survey.pixels(np.stack(list(points.values())))
    rows = [
        f"{name},{survey.rec.names[i]},{xy[i, k, 0]:.5f},{xy[i, k, 1]:.5f}"
        for k, name in enumerate(points)
        for i in np.flatnonzero(seen[:, k])
    ]
    path.write_text("name,frame,x,y\n" + "\n".join(rows) + "\n")
    return path


def test_distances_between_named_points(survey, tmp_path):
    points = write_points(tmp_path / "p.csv", survey, {"A": BAR[0], "B": BAR[1]})
    distances = tmp_path / "d.csv"
    distances.write_text(f"from;to;length;std\nA;B;{LENGTH};0.0005\n")
    found = solved(survey, points=points, distances=distances)
    assert found.scale == pytest.approx(SCALE, rel=1e-4)
    assert found.sources[0].estimate.source == "distance A to B"


def test_a_distance_to_an_unknown_point_is_named(survey, tmp_path):
    points = write_points(tmp_path / "p.csv", survey, {"A": BAR[0], "B": BAR[1]})
    (tmp_path / "d.csv").write_text("from,to,length\nA,C,0.5\n")
    with pytest.raises(InputError, match="speaks of C"):
        solved(survey, points=points, distances=tmp_path / "d.csv")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name,frame,x\nA,0003.png,1\n", "no column y"),
        ("name,frame,x,y\n", "no rows"),
        ("name,frame,x,y\nA,0003.png,one,2\n", "line 2: x is 'one'"),
        ("name,frame,x,y\nA,0003.png,1\n", "line 2 is not complete"),
        ("", "no column name"),
    ],
)
def test_a_table_of_points_that_cannot_be_used_is_named(survey, tmp_path, text, said):
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(InputError, match=said):
        read_points(tmp_path / "p.csv", names_of(survey))


def test_a_length_of_zero_is_refused(tmp_path):
    (tmp_path / "d.csv").write_text("from,to,length\nA,B,0\n")
    with pytest.raises(InputError, match="positive"):
        read_distances(tmp_path / "d.csv")


def test_the_height_of_the_camera_gives_the_scale(survey):
    heights = ground_below(survey.rec, up_from_scene(survey.rec)[2])
    np.testing.assert_allclose(heights * SCALE, survey.position[:, 2], atol=0.05)
    assert solved(survey, camera_height=float(survey.position[:, 2].mean())).scale == pytest.approx(SCALE, rel=0.01)


def test_the_altimeter_is_one_source_beside_the_navigation(survey, tmp_path):
    nav = write_csv(tmp_path / "nav.csv", survey, altitude=survey.position[:, 2])
    found = solved(survey, nav=nav, altimeter=True)
    by_name = {each.estimate.source: each.estimate for each in found.sources}
    assert by_name["altimeter"].scale == pytest.approx(SCALE, rel=0.02)
    assert by_name["altimeter"].std > 0.09
    lost = np.where(np.arange(len(survey.position)) % 3, survey.position[:, 2], -1.0)  # no echo, as sounders write it
    found = solved(survey, nav=write_csv(tmp_path / "lost.csv", survey, altitude=lost), altimeter=True)
    assert found.sources[1].estimate.scale == pytest.approx(SCALE, rel=0.02)
    with pytest.raises(InputError, match="no altitude"):
        solved(survey, nav=write_csv(tmp_path / "bare.csv", survey), altimeter=True)


def test_laser_dots_count_across_the_axis_even_on_a_slope(survey, tmp_path):
    depth = DepthMaps(tmp_path / "z_depth")
    name = survey.rec.names[5]
    column = torch.linspace(0, 1, WIDTH)
    z = (5 + 2 * column).expand(HEIGHT, WIDTH).contiguous()  # in the run's unit, falling off to the right
    depth.write(name, DepthMap(z, torch.ones_like(z)))
    spacing, focal = 0.1, float(survey.rec.cameras.K[0, 0, 0])
    ends = []
    for side in (-0.5, 0.5):  # beams parallel to the optical axis meet the slope
        x = WIDTH / 2
        for _ in range(50):
            x = WIDTH / 2 + focal * (side * spacing / SCALE) / (5 + 2 * (x - 0.5) / (WIDTH - 1))
        ends.append(x)
    (tmp_path / "dots.csv").write_text(f"frame,x1,y1,x2,y2\n{name},{ends[0]},{HEIGHT / 2},{ends[1]},{HEIGHT / 2}\n")
    rec = replace(survey.rec, depth=depth)
    settings = ScaleSettings(laser_dots=tmp_path / "dots.csv", laser_spacing=spacing)
    (found,) = scale_sources(rec, survey.frames, settings, None).estimates
    assert found.scale == pytest.approx(SCALE, rel=0.005)
    assert found.std < 0.1


def estimates(*pairs: tuple[float, float]) -> list[ScaleEstimate]:
    return [ScaleEstimate(f"source {k}", scale, std) for k, (scale, std) in enumerate(pairs)]


def test_sources_are_weighted_by_their_variance_on_the_logarithm():
    found = solve_scale(estimates((1.0, 0.01), (1.01, 0.01), (1.0, 1.0)))
    assert found.scale == pytest.approx(np.sqrt(1.01), rel=1e-3)
    assert found.std == pytest.approx(0.01 / np.sqrt(2), rel=0.05)


def test_both_sources_together_are_not_worse_than_the_better():
    found = solve_scale(estimates((1.0, 0.002), (1.005, 0.01)))
    assert found.std <= 0.002
    assert abs(found.scale - 1) < 0.0005


def test_the_scale_of_the_unit_does_not_matter():
    one, other = (
        solve_scale(estimates(*((s * k, e) for s, e in ((1, 0.01), (1.02, 0.02), (0.99, 0.03))))) for k in (1, 77)
    )
    assert other.scale == pytest.approx(77 * one.scale)
    assert other.std == pytest.approx(one.std)


def test_one_wrong_source_among_several_is_named_and_not_followed():
    found = solve_scale(estimates((1.0, 0.003), (1.002, 0.003), (0.999, 0.003), (1.2, 0.003)))
    assert [each.estimate.source for each in found.outliers] == ["source 3"]
    assert found.scale == pytest.approx(1.0, rel=0.003)


def test_two_sources_that_contradict_each_other_are_refused():
    with pytest.raises(InputError, match="source 0 and source 1 contradict each other"):
        solve_scale(estimates((1.0, 0.003), (1.2, 0.003)))


def test_sources_that_scatter_more_than_they_say_widen_the_result():
    found = solve_scale(estimates((1.0, 0.002), (1.01, 0.002), (0.99, 0.002)))
    assert found.std > 0.002


def test_no_source_is_an_error():
    with pytest.raises(InputError, match="no source"):
        solve_scale([])


def test_a_source_without_a_standard_deviation_cannot_be():
    with pytest.raises(ValueError, match="standard deviation"):
        ScaleEstimate("bar", 1.0, 0.0)


def test_noise_of_corners_does_not_enlarge_a_shape():
    rng = np.random.default_rng(0)
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    covariance = 0.05**2 * np.eye(3)
    scales = []
    for _ in range(2000):
        points = [ScenePoint(np.array([*xy, 0.0]) + 0.05 * rng.normal(size=3), covariance, 0.0, 0, 2) for xy in square]
        scales.append(scale_of_shape(points, square, 0.0)[0])
    assert np.mean(np.log(scales)) == pytest.approx(0, abs=0.003)


GROUND = {
    "a": np.array([0.5, 0.3, 0.02]), "b": np.array([3.5, 0.4, 0.0]), "c": np.array([2.0, 1.4, 0.1]),
    "d": np.array([1.2, 1.0, 0.05]), "e": np.array([3.0, 1.1, -0.05]),
}  # fmt: skip


def write_control(path: Path, change=lambda g: g, roles: dict[str, str] | None = None, **moved: np.ndarray) -> Path:
    place = {name: moved.get(name, xyz) for name, xyz in GROUND.items()}
    geodetic = geodetic_from_local(np.stack(list(place.values())), ORIGIN)
    rows = [
        f"{name},{a!r},{b!r},{-h!r},{(roles or {}).get(name, 'control')}"
        for name, (a, b, h) in zip(place, change(geodetic).tolist(), strict=True)
    ]
    path.write_text("name,latitude,longitude,depth,role\n" + "\n".join(rows) + "\n")
    return path


@pytest.fixture
def marks(survey, tmp_path) -> Path:
    return write_points(tmp_path / "points.csv", survey, GROUND)


def test_ground_control_places_the_run_and_check_points_tell_its_accuracy(survey, marks, tmp_path):
    control = write_control(tmp_path / "c.csv", roles={"e": "check"})
    found = estimate_scale(survey.rec, survey.frames, ScaleSettings(points=marks, control=control))
    assert found.solution.scale == pytest.approx(SCALE, rel=1e-5)
    assert found.control is not None
    assert found.control.rms("check") < 1e-4
    np.testing.assert_allclose(found.georeference.R[2], TURN[:, 2], atol=1e-4)
    local = found.georeference.to_local(survey.in_run(GROUND["e"])) - found.georeference.to_local(
        survey.in_run(GROUND["a"])
    )
    assert np.linalg.norm(local) == pytest.approx(np.linalg.norm(GROUND["e"] - GROUND["a"]), rel=1e-4)


def test_eastings_of_control_points_beside_latitudes_need_their_system(survey, marks, tmp_path):
    pyproj = pytest.importorskip("pyproj")
    epsg = utm_zone(ORIGIN.latitude, ORIGIN.longitude)
    latitude, longitude, height = geodetic_from_local(np.stack(list(GROUND.values())), ORIGIN).T
    east, north = pyproj.Transformer.from_crs(4326, epsg, always_xy=True).transform(longitude, latitude)
    stated = np.stack([east, north, height], -1)
    rows = [f"{name},{e!r},{n!r},{h!r}" for name, (e, n, h) in zip(GROUND, stated.tolist(), strict=True)]
    control = tmp_path / "c.csv"
    control.write_text("name,easting,northing,height\n" + "\n".join(rows) + "\n")
    settings = ScaleSettings(points=marks, control=control, nav=write_csv(tmp_path / "nav.csv", survey))
    with pytest.raises(UsageError, match="different reference systems") as told:
        estimate_scale(survey.rec, survey.frames, settings)
    assert "--nav-crs" in told.value.hint
    found = estimate_scale(survey.rec, survey.frames, replace(settings, nav_crs=f"EPSG:{epsg}")).georeference
    ground = found.to_crs(survey.in_run(np.stack(list(GROUND.values()))))
    np.testing.assert_allclose(ground, stated, atol=2e-3)


def fitted(survey: Survey, marks: Path, control: Path):
    settings = ScaleSettings(points=marks, control=control)
    points = placed_points(survey.rec, read_points(marks, names_of(survey)), 1.0, "points")
    return fit_control(points, up_from_scene(survey.rec)[2], settings)


def test_a_wrong_check_point_shows_in_its_residual_alone(survey, marks, tmp_path):
    off = GROUND["e"] + [0.1, 0, 0]
    found = fitted(survey, marks, write_control(tmp_path / "c.csv", roles={"e": "check"}, e=off))
    assert found.rms("check") == pytest.approx(0.1, abs=1e-3)
    assert found.rms("control") < 1e-3


def test_a_wrong_control_point_is_named(survey, marks, tmp_path):
    control = write_control(tmp_path / "c.csv", b=GROUND["b"] + [0, 0, 0.6])
    with pytest.raises(InputError, match="control point b"):
        fitted(survey, marks, control)


def test_exchanged_columns_of_control_points_are_named(survey, marks, tmp_path):
    control = tmp_path / "c.csv"
    rows = [f"{name},{4e6 + xyz[1]},{5e5 + xyz[0]},{xyz[2]}" for name, xyz in GROUND.items()]
    control.write_text("name,easting,northing,height\n" + "\n".join(rows) + "\n")
    with pytest.raises(InputError) as told:
        fitted(survey, marks, control)
    assert "swapped" in told.value.cause


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name,easting,northing,height\na,0.5,0.3,0\nb,3.5,0.4,0\n", "2 control points"),
        ("name,easting,northing,height\nq,0.5,0.3,0\nr,3.5,0.4,0\ns,3,4,5\n", "0 control points"),
        ("name,easting,northing,height\na,0.5,0.3,0\na,3.5,0.4,0\n", "two points named a"),
        ("name,easting,northing,height,role\na,0.5,0.3,0,anchor\n", "role 'anchor'"),
        ("easting,northing,height\n0.5,0.3,0\n", "no column name"),
        ("name,latitude,longitude,depth\na,100,0.3,0\nb,101,0.4,0\nc,102,3,4\n", "beyond 90"),
    ],
)
def test_control_points_that_cannot_be_used_are_named(survey, marks, tmp_path, text, said):
    (tmp_path / "c.csv").write_text(text)
    with pytest.raises(InputError, match=said):
        fitted(survey, marks, tmp_path / "c.csv")


def test_control_points_on_a_line_are_refused(survey, tmp_path):
    line = {name: np.array([0.4 + 0.9 * k, 0.4 + 0.2 * k, 0.0]) for k, name in enumerate("abcd")}
    marks = write_points(tmp_path / "p.csv", survey, line)
    rows = [f"{name},{x},{y},{z}" for name, (x, y, z) in line.items()]
    (tmp_path / "c.csv").write_text("name,easting,northing,height\n" + "\n".join(rows) + "\n")
    with pytest.raises(InputError, match="on a line"):
        fitted(survey, marks, tmp_path / "c.csv")


@pytest.mark.parametrize(
    "options",
    [
        {"markers": "aruco-4x4-50"},
        {"marker_size": 0.1},
        {"laser_dots": Path("a.csv")},
        {"distances": Path("a.csv")},
        {"crs": "EPSG"},
        {"scale_bar": (), "control": Path("a.csv")},
    ],
)
def test_options_that_need_each_other_say_so(options):
    with pytest.raises(UsageError):
        ScaleSettings(**options)
