"""Navigation against the path of the cameras: known similarities, clocks, mountings, and slips that have a message."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from tests.scale.conftest import ORIGIN, SCALE, TURN, Survey, lines, survey_along, write_csv

from swimm3r.errors import InputError, UsageError
from swimm3r.scale.estimate import estimate_scale
from swimm3r.scale.navigation import geodesy
from swimm3r.scale.navigation.alignment import Path, align
from swimm3r.scale.navigation.fit import fit_navigation, path_of
from swimm3r.scale.navigation.geodesy import Origin, geodetic_from_local, grid_at, local_from_geodetic, utm_zone
from swimm3r.scale.navigation.latency import find_latency
from swimm3r.scale.navigation.matching import FrameTimes, match_names, match_times
from swimm3r.scale.navigation.time_offset import find_offset
from swimm3r.scale.settings import ScaleSettings


def times_of(survey: Survey, shift: float = 0.0) -> FrameTimes:
    return FrameTimes(survey.rec.names, "utc", survey.seconds + shift)


def aligned(survey: Survey, position=None, settings: ScaleSettings | None = None, **options):
    settings = settings or ScaleSettings()
    matched = match_times(survey.navigation(position, **options), times_of(survey), 0.0, 5.0)
    return align(path_of(survey.rec, matched, settings), settings)


def dense(survey: Survey, step: float = 0.1, noise: float = 0.0, seed: int = 0):
    """Navigation more often than frames, by interpolation, with noise."""
    seconds = np.arange(survey.seconds[0] - 5, survey.seconds[-1] + 5, step)
    position = np.stack([np.interp(seconds, survey.seconds, column) for column in survey.position.T], -1)
    position = position + noise * np.random.default_rng(seed).normal(size=position.shape)
    return replace(survey.navigation(), position=position, time=seconds, attitude=None)


def test_exact_positions_give_the_similarity_to_the_last_digits(survey):
    found = aligned(survey)
    assert found.scale == pytest.approx(SCALE, rel=1e-9)
    np.testing.assert_allclose(found.R, TURN.T, atol=1e-8)
    assert found.rms < 1e-7


def test_the_attitude_shows_the_mounting_of_the_camera(survey):
    found = aligned(survey)
    assert found.mount is not None
    turn = Rotation.from_matrix(
        found.mount.T @ survey.attitude[0].T @ TURN.T @ survey.rec.cameras.cam2world[0, :3, :3].numpy()
    )
    assert np.degrees(turn.magnitude()) < 1e-6
    assert found.attitude_residual_deg == pytest.approx(0, abs=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("step", [1.0, 0.4])
def test_the_standard_deviation_of_the_scale_is_that_of_repeated_dives(step):
    """By positions at the frames' times, and by ones between which positions are interpolated."""
    survey = survey_along(lines(each=12))
    errors = []
    for seed in range(40):
        log = dense(survey, step=step, noise=0.1, seed=seed)
        settings = ScaleSettings()
        found = align(path_of(survey.rec, match_times(log, times_of(survey), 0.0, 5.0), settings), settings)
        errors.append(np.log(found.scale / SCALE) / found.scale_std)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(1, abs=0.25)
    assert abs(np.mean(errors)) < 3 / np.sqrt(len(errors))


def test_a_few_wild_positions_do_not_pull_the_scale(survey):
    wild = survey.position + 0.02 * np.random.default_rng(0).normal(size=survey.position.shape)
    wild[[3, 17, 30]] += [[8, 0, 0], [0, -9, 3], [5, 5, 5]]
    found = aligned(survey, wild)
    assert found.scale == pytest.approx(SCALE, rel=0.01)
    assert set(np.flatnonzero(found.outliers)) == {3, 17, 30}


def test_a_lever_arm_is_taken_off_by_the_attitude(survey):
    lever = np.array([0.6, -0.2, 0.9])
    vehicle = survey.position - survey.attitude @ lever
    found = aligned(survey, vehicle, ScaleSettings(lever_arm=(0.6, -0.2, 0.9)))
    assert found.scale == pytest.approx(SCALE, rel=1e-9)
    assert aligned(survey, vehicle).rms > 0.01


def test_positions_without_height_are_enough(survey):
    flat = survey.position * [1, 1, 0]
    std = np.tile([np.nan, np.nan, np.inf], (len(flat), 1))
    found = aligned(survey, flat, std=std)
    assert found.scale == pytest.approx(SCALE, rel=1e-4)


def rising_and_sinking(count: int = 3) -> Survey:
    """A survey that rises and sinks by more than a meter."""
    path = lines(count)
    return survey_along(path + np.stack([0 * path[:, 0], 0 * path[:, 0], 0.7 * np.sin(np.arange(len(path)) / 4)], -1))


def depths_of(survey: Survey, noise: float = 0.0) -> dict:
    rng = np.random.default_rng(0)
    return {
        "position": survey.position * [0, 0, 1] + noise * rng.normal(size=survey.position.shape) * [0, 0, 1],
        "std": np.tile([np.inf, np.inf, 0.1], (len(survey.position), 1)),
        "attitude": None,
    }


def test_depths_alone_give_scale_and_up():
    survey = rising_and_sinking()
    found = aligned(survey, **depths_of(survey))
    assert found.scale == pytest.approx(SCALE, rel=1e-3)
    assert (found.R @ TURN[:, 2])[2] > np.cos(np.radians(0.5))
    noisy = aligned(survey, **depths_of(survey, 0.1))
    assert abs(np.log(noisy.scale / SCALE)) < 3 * noisy.scale_std < 0.3


def test_depths_alone_say_nothing_of_heading_east_and_north():
    survey = rising_and_sinking()
    found = aligned(survey, **depths_of(survey))
    assert found.rotation_std_deg[2] >= 90
    assert found.rotation_std_deg[:2].max() < 10
    assert found.center_std[:2].min() > 1e3
    assert found.center_std[2] < 0.1


@pytest.mark.parametrize("shift", [-1.1, 0.6])
def test_depths_alone_show_the_offset_between_clocks(shift: float):
    survey = rising_and_sinking()
    log = dense(survey, step=1.0)
    log = replace(log, std=np.tile([np.inf, np.inf, 0.1], (len(log), 1)))
    log = replace(log, position=log.position * [0, 0, 1])
    found = find_offset(log, times_of(survey, -shift), survey.rec.cameras.centers.numpy(), (-3.0, 3.0), 5.0)
    assert found is not None
    assert found.seconds == pytest.approx(shift, abs=0.1)


def test_the_log_of_a_dive_computer_gives_a_run_its_scale(tmp_path):
    survey = rising_and_sinking()
    seconds, depths = survey.seconds, -survey.position[:, 2] + 12
    path = tmp_path / "log.csv"
    rows = "".join(f"{t!r},{d!r}\n" for t, d in zip(seconds.tolist(), depths.round(1).tolist(), strict=True))
    path.write_text("time,depth [m]\n" + rows)
    found = fit_navigation(survey.rec, survey.frames, ScaleSettings(nav=path))
    assert found.alignment.scale == pytest.approx(SCALE, rel=0.03)


def test_along_a_straight_line_the_ground_lies_below_the_cameras():
    line = np.stack([np.arange(20) * 0.3, np.zeros(20), np.full(20, 2.0)], -1)
    survey = survey_along(line)
    found = aligned(survey, attitude=None)
    assert (found.R @ TURN[:, 2])[2] > np.cos(np.radians(2))
    assert found.rotation_std_deg.max() > 10  # and the standard deviation says that this is a prior's word


def test_a_stated_mounting_turns_a_straight_line_by_the_attitude():
    line = np.stack([np.arange(20) * 0.3, np.zeros(20), np.full(20, 2.0)], -1)
    found = aligned(survey_along(line), settings=ScaleSettings(camera_mount="down", mount_std=1.0))
    assert found.rotation_std_deg.max() < 2


@pytest.mark.parametrize("shift", [-1.3, 0.0, 0.3, 1.7])
def test_the_offset_between_clocks_is_found(survey, shift):
    centers = survey.rec.cameras.centers.numpy()
    found = find_offset(dense(survey, noise=0.02), times_of(survey, -shift), centers, (-2.0, 2.0), 5.0)
    assert found is not None
    assert found.seconds == pytest.approx(shift, abs=0.05)
    assert abs(found.seconds - shift) < 4 * found.std


def test_the_standard_deviation_of_the_offset_is_that_of_repeated_dives(survey):
    centers = survey.rec.cameras.centers.numpy()
    log = dense(survey, step=0.5)
    path = CubicSpline(survey.seconds, survey.position)(log.time)
    draws = [path + 0.1 * np.random.default_rng(seed).normal(size=path.shape) for seed in range(80)]
    logs = [replace(log, position=position) for position in draws]
    found = [find_offset(log, times_of(survey, -0.3), centers, (-0.5, 1.0), 5.0) for log in logs]
    errors = [(each.seconds - 0.3) / each.std for each in found if each is not None]
    assert len(errors) == 80
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(1, abs=0.2)


def test_the_scale_is_as_uncertain_as_the_offset_of_the_clocks(tmp_path):
    """Along a straight path that gains speed, an offset changes the scale."""
    along = np.cumsum(np.linspace(0.1, 0.6, 30))
    survey = survey_along(np.stack([along, np.zeros(30), np.full(30, 2.0)], -1))
    noise = 0.05 * np.random.default_rng(0).normal(size=survey.position.shape)
    stated = survey.geodetic(survey.position + noise)
    columns = {"latitude": stated[:, 0], "longitude": stated[:, 1], "depth": -stated[:, 2], "heading": None}
    file = write_csv(tmp_path / "nav.csv", survey, **columns)
    found, given = (fit_navigation(survey.rec, survey.frames, ScaleSettings(nav=file, nav_offset=o)) for o in (None, 0))
    assert found.offset is not None
    assert found.offset.std > 0.05
    assert found.alignment.scale_std > 1.2 * given.alignment.scale_std


def test_the_offset_of_a_clip_without_a_date_is_found_anywhere(survey):
    centers = survey.rec.cameras.centers.numpy()
    clip = FrameTimes(survey.rec.names, "clip", survey.seconds[10:30] - survey.seconds[10])
    found = find_offset(
        dense(survey, noise=0.01), clip, centers[10:30], (survey.seconds[0] - 5, survey.seconds[-1] - 15), 5.0
    )
    assert found is not None
    assert found.seconds == pytest.approx(survey.seconds[10], abs=0.1)


def test_a_straight_path_at_constant_speed_shows_no_offset(tmp_path):
    line = np.stack([np.arange(20) * 0.3, np.zeros(20), np.full(20, 2.0)], -1)
    survey = survey_along(line)
    fit = fit_navigation(survey.rec, survey.frames, ScaleSettings(nav=write_csv(tmp_path / "nav.csv", survey)))
    assert any("does not show an offset" in note for note in fit.notes)
    assert fit.alignment.scale == pytest.approx(SCALE, rel=1e-5)


def test_noisy_navigation_off_by_a_third_of_a_second_gives_the_scale_within_one_percent(tmp_path):
    survey = survey_along(lines(count=4, each=20))
    rng = np.random.default_rng(3)
    noisy = survey.geodetic(survey.position + 0.1 * rng.normal(size=survey.position.shape))
    file = write_csv(
        tmp_path / "nav.csv", survey, time=survey.seconds + 0.3, latitude=noisy[:, 0], longitude=noisy[:, 1],
        depth=-noisy[:, 2], heading=survey.angles[:, 0] + rng.normal(size=80), pitch=survey.angles[:, 1]
        + rng.normal(size=80), roll=survey.angles[:, 2] + rng.normal(size=80),
    )  # fmt: skip
    fit = fit_navigation(survey.rec, survey.frames, ScaleSettings(nav=file))
    assert fit.alignment.scale == pytest.approx(SCALE, rel=0.01)
    assert fit.offset is not None
    assert fit.offset.seconds == pytest.approx(0.3, abs=0.15)


def heaving(speed: float = 0.12) -> Survey:
    """Stills every 3 s from a vehicle that heaves and turns about."""
    t = np.arange(24) * 3.0
    return survey_along(
        np.stack([speed * t + 0.3 * np.sin(t / 5), 0.4 * np.cos(t / 7), 4 + np.sin(t / 9)], -1), spacing=3.0
    )


def named(survey: Survey, latency: float, noise: float = 0.02, seed: int = 0) -> tuple[Path, np.ndarray]:
    """Positions and moments of the frames, by a navigation whose clock is ahead."""
    path = CubicSpline(survey.seconds, survey.position)
    position = path(survey.seconds - latency) + noise * np.random.default_rng(seed).normal(size=survey.position.shape)
    navigation = replace(survey.navigation(position), names=survey.rec.names)
    matched = match_names(navigation, survey.rec.names)
    assert matched is not None
    return path_of(survey.rec, matched, ScaleSettings()), survey.seconds


@pytest.mark.parametrize("latency", [-0.6, *(pytest.param(each, marks=pytest.mark.long) for each in (0.0, 0.45))])
def test_the_latency_of_named_positions_is_found_with_its_standard_deviation(latency):
    survey = heaving()
    found = [find_latency(*named(survey, latency, seed=seed), ScaleSettings()) for seed in range(2)]
    errors = [each.seconds - latency for each in found if each is not None]
    assert len(errors) == 2
    assert np.abs(errors).max() < 0.15
    assert np.sqrt(np.mean(np.square(errors))) < 2 * np.mean([each.std for each in found if each is not None])


def test_along_a_straight_path_at_constant_speed_the_latency_stays_that_of_the_prior():
    line = np.stack([np.arange(20) * 0.3, np.zeros(20), np.full(20, 2.0)], -1)
    found = find_latency(*named(survey_along(line), 0.4), ScaleSettings())
    assert found is not None
    assert found.seconds == pytest.approx(0, abs=0.3)
    assert found.std == pytest.approx(0.5, rel=0.2)


def test_a_latency_of_named_positions_does_not_reach_the_scale(tmp_path):
    survey = heaving()
    path = CubicSpline(survey.seconds, survey.position)
    noise = 0.02 * np.random.default_rng(1).normal(size=survey.position.shape)
    stated = survey.geodetic(path(survey.seconds - 0.5) + noise)
    columns = {"latitude": stated[:, 0], "longitude": stated[:, 1], "depth": -stated[:, 2], "image": survey.rec.names}
    file = write_csv(tmp_path / "nav.csv", survey, **columns)
    with_offset, without = (
        fit_navigation(survey.rec, survey.frames, ScaleSettings(nav=file, nav_latency_std=std)) for std in (0.5, 0.0)
    )
    assert with_offset.by == "name"
    assert without.offset is None
    assert abs(np.log(with_offset.alignment.scale / SCALE)) < 2 * with_offset.alignment.scale_std
    assert with_offset.alignment.rms < 0.7 * without.alignment.rms


def test_local_metres_of_latitude_and_longitude_are_exact():
    rng = np.random.default_rng(0)
    local = rng.uniform(-3000, 3000, (50, 3))
    back = local_from_geodetic(geodetic_from_local(local, ORIGIN), ORIGIN)
    np.testing.assert_allclose(back, local, atol=1e-7)


def test_the_grid_of_a_zone_agrees_with_its_projection():
    pyproj = pytest.importorskip("pyproj")
    origin = Origin(41.3, 4.9, -850.0)
    epsg = utm_zone(origin.latitude, origin.longitude)
    assert epsg == 32631
    grid = grid_at(epsg, origin)
    steps = np.array([[100.0, 0, 0], [0, 100.0, 0], [60.0, -80.0, 0]])
    project = pyproj.Transformer.from_crs(4326, epsg, always_xy=True)
    latitude, longitude, _ = geodetic_from_local(steps, origin).T
    true = np.stack(project.transform(longitude, latitude), -1) - [grid.easting, grid.northing]
    cos, sin = np.cos(grid.convergence), np.sin(grid.convergence)
    np.testing.assert_allclose(grid.scale * steps[:, :2] @ np.array([[cos, -sin], [sin, cos]]).T, true, atol=2e-4)


def test_georeferenced_centers_lie_where_the_projection_puts_the_navigation(survey, tmp_path):
    pyproj = pytest.importorskip("pyproj")
    found = estimate_scale(survey.rec, survey.frames, ScaleSettings(nav=write_csv(tmp_path / "nav.csv", survey)))
    place = found.georeference
    assert place.epsg == utm_zone(ORIGIN.latitude, ORIGIN.longitude)
    latitude, longitude, height = survey.geodetic().T
    project = pyproj.Transformer.from_crs(4326, place.epsg, always_xy=True)
    true = np.stack([*project.transform(longitude, latitude), height], -1)
    np.testing.assert_allclose(place.to_crs(survey.rec.cameras.centers.numpy()), true, atol=2e-3)


@pytest.mark.parametrize(
    ("epsg", "latitude", "longitude"), [(27700, 50.3, -4.1), (31466, 54.2, 7.9), (26717, 25.1, -80.3)]
)
def test_positions_of_satellites_land_where_a_national_system_has_them(epsg, latitude, longitude, tmp_path):
    """The systems of Great Britain, Germany and Florida are of other datums than WGS 84: 45 to 187 m away."""
    pyproj = pytest.importorskip("pyproj")
    survey = survey_along(lines())
    place = Origin(latitude, longitude, -8.0)
    stated = geodetic_from_local(survey.position, place)
    columns = {"latitude": stated[:, 0], "longitude": stated[:, 1], "depth": -stated[:, 2]}
    file = write_csv(tmp_path / "nav.csv", survey, **columns)
    found = estimate_scale(survey.rec, survey.frames, ScaleSettings(nav=file, crs=f"EPSG:{epsg}")).georeference
    true = pyproj.Transformer.from_crs(4326, epsg, always_xy=True).transform(stated[:, 1], stated[:, 0])
    np.testing.assert_allclose(found.to_crs(survey.rec.cameras.centers.numpy())[:, :2], np.stack(true, -1), atol=0.02)
    assert found.geodetic is not None
    np.testing.assert_allclose(found.geodetic, (latitude, longitude), atol=3e-4)


def test_eastings_of_a_national_system_land_where_they_are_on_the_globe(tmp_path):
    pyproj = pytest.importorskip("pyproj")
    survey = survey_along(lines())
    east, north = 250_000.0 + survey.position[:, 0], 50_000.0 + survey.position[:, 1]
    columns = {"latitude": None, "longitude": None, "heading": None, "pitch": None, "roll": None}
    file = write_csv(tmp_path / "nav.csv", survey, **columns, easting=east, northing=north)
    settings = ScaleSettings(nav=file, nav_crs="EPSG:27700", crs="EPSG:32630")
    found = estimate_scale(survey.rec, survey.frames, settings).georeference
    true = pyproj.Transformer.from_crs(27700, 32630, always_xy=True).transform(east, north)
    np.testing.assert_allclose(found.to_crs(survey.rec.cameras.centers.numpy())[:, :2], np.stack(true, -1), atol=0.02)


def test_without_pyproj_the_message_names_the_extra_and_local_metres_need_none(survey, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyproj", None)
    file = write_csv(tmp_path / "nav.csv", survey)
    with pytest.raises(UsageError, match="pyproj") as told:
        estimate_scale(survey.rec, survey.frames, ScaleSettings(nav=file))
    assert "swimm3r[geo]" in told.value.hint
    found = estimate_scale(survey.rec, survey.frames, ScaleSettings(nav=file, crs="local"))
    assert (found.georeference.epsg, found.georeference.grid_scale) == (None, 1.0)
    assert geodesy.utm_zone(0, 0) == 32631


def refused(survey: Survey, file, **options) -> str:
    with pytest.raises(InputError) as told:
        fit_navigation(survey.rec, survey.frames, ScaleSettings(nav=file, **options))
    return str(told.value)


def test_exchanged_columns_of_east_and_north_are_named(survey, tmp_path):
    east, north, up = survey.position.T
    file = write_csv(
        tmp_path / "n.csv", survey, latitude=None, longitude=None, depth=None, heading=None, pitch=None, roll=None,
        easting=500_000 + north, northing=4_000_000 + east, height=up,
    )  # fmt: skip
    assert "swapped" in refused(survey, file)


def test_heights_that_grow_downwards_are_named(tmp_path):
    position = lines()
    position[:, 2] = 2 + 0.8 * np.sin(position[:, 0]) + 0.3 * position[:, 1]
    survey = survey_along(position)
    height = survey.geodetic()[:, 2]
    file = write_csv(tmp_path / "n.csv", survey, depth=None, height=-height, heading=None, pitch=None, roll=None)
    said = refused(survey, file)
    assert "other sign" in said or "confused" in said


@pytest.mark.parametrize("hours", [-10, 1, 5.5])
def test_a_wrong_time_zone_is_named_with_the_offset_to_give(survey, tmp_path, hours):
    file = write_csv(tmp_path / "n.csv", survey, time=survey.seconds + 3600 * hours)
    said = refused(survey, file)
    assert "time zone" in said
    assert f"--nav-offset {3600 * hours:g}" in said


def test_a_wrong_time_zone_within_a_long_recording_is_named(survey, tmp_path):
    rng = np.random.default_rng(0)
    hour = 3600.0
    elsewhere = np.cumsum(rng.normal(size=(49, 3)) * [0.3, 0.3, 0.02], axis=0)
    seconds = np.array([*survey.seconds, *(survey.seconds + hour), survey.seconds[-1] + 2 * hour])
    there = survey.geodetic(np.array([*elsewhere[:48], *survey.position, elsewhere[48]]))
    file = tmp_path / "n.csv"
    rows = [f"{t!r},{a!r},{b!r},{-h!r}" for t, (a, b, h) in zip(seconds.tolist(), there.tolist(), strict=True)]
    file.write_text("time,latitude,longitude,depth\n" + "\n".join(rows))
    said = refused(survey, file)
    assert "time zone" in said
    assert "3600" in said


def test_navigation_of_another_dive_is_refused(survey, tmp_path):
    other = survey.geodetic(np.random.default_rng(0).normal(size=survey.position.shape) * 20)
    file = write_csv(tmp_path / "n.csv", survey, latitude=other[:, 0], longitude=other[:, 1], depth=-other[:, 2])
    assert "does not fit the path" in refused(survey, file)


def test_radians_of_roll_and_pitch_that_no_header_states_are_named(tmp_path):
    survey = survey_along(lines(count=1, each=24))
    radians = np.radians(survey.angles)
    file = write_csv(tmp_path / "n.csv", survey, heading=radians[:, 0], pitch=radians[:, 1], roll=radians[:, 2])
    assert "radians" in refused(survey, file)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda h, p, r: (h, r, p), "exchanged"),
        (lambda h, p, r: (-h, p, r), "counter-clockwise"),
        (lambda h, p, r: (h, -p, r), "sign of the pitch"),
    ],
)
def test_angles_of_another_convention_are_named(tmp_path, change, words):
    steep = tilting_survey()
    heading, pitch, roll = change(*steep.angles.T)
    file = write_csv(tmp_path / "n.csv", steep, heading=heading, pitch=pitch, roll=roll)
    assert words in refused(steep, file)


def tilting_survey() -> Survey:
    """A survey whose vehicle pitches and rolls by tens of degrees."""
    from tests.scale import conftest

    turn = np.linspace(0, 5, 20)
    base = survey_along(np.stack([2 * np.cos(turn), 2 * np.sin(turn), 2 + 0.1 * np.sin(5 * turn)], -1))
    angles = base.angles * [1, 8, 6]
    attitude = conftest.vehicle_attitude(*angles.T)
    poses = base.rec.cameras.cam2world.clone()
    poses[:, :3, :3] = poses.new_tensor(TURN @ attitude @ conftest.MOUNTS["down"])
    rec = replace(base.rec, cameras=replace(base.rec.cameras, cam2world=poses))
    return replace(base, rec=rec, angles=angles, attitude=attitude)


def test_a_vehicle_that_stands_still_gives_no_scale(survey, tmp_path):
    still = survey.geodetic(np.zeros_like(survey.position))
    file = write_csv(
        tmp_path / "n.csv", survey, latitude=still[:, 0], longitude=still[:, 1], depth=-still[:, 2], heading=None
    )
    assert "the same" in refused(survey, file, nav_offset=0.0)


def test_too_few_frames_with_a_position_are_counted(survey, tmp_path):
    file = write_csv(tmp_path / "n.csv", survey)
    text = file.read_text().splitlines()
    file.write_text("\n".join(text[:3]) + "\n")
    assert "2 of 48 frames" in refused(survey, file, nav_offset=0.0)


def test_frames_without_times_are_not_looked_for_by_their_places_in_the_order(tmp_path):
    survey = survey_along(lines(), spacing=3.0)
    numbered = tuple(replace(frame, time=float(i)) for i, frame in enumerate(survey.frames))
    frames = replace(survey.frames, frames=numbered, timed=False)
    file = write_csv(tmp_path / "nav.csv", survey)
    with pytest.raises(InputError, match="they have no times") as caught:
        fit_navigation(survey.rec, frames, ScaleSettings(nav=file))
    assert caught.value.exit_code == 3
    named = write_csv(tmp_path / "named.csv", survey, time=None, name=list(survey.rec.names))
    assert fit_navigation(survey.rec, frames, ScaleSettings(nav=named)).by == "name"


def test_images_of_one_name_in_several_folders_are_told_apart(survey):
    names = ("100media/dji_0001.png", "100media/dji_0002.png", "101media/dji_0001.png")
    given = ("DCIM\\101MEDIA\\DJI_0001.JPG", "DCIM\\100MEDIA\\DJI_0001.JPG", "DCIM\\100MEDIA\\DJI_0002.JPG")
    navigation = replace(survey.navigation().rows(np.arange(3)), names=given)
    matched = match_names(navigation, names)
    assert matched is not None
    assert matched.navigation.names == (given[1], given[2], given[0])
    without_folders = tuple(name.rpartition("/")[2] for name in names)
    assert match_names(navigation, without_folders) is None  # dji_0001 is one of two
