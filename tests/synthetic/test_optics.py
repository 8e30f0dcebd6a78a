from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
import torch

from swimm3r.cameras import image_directions, pixel_grid
from swimm3r.errors import UsageError
from swimm3r.medium import add_water
from swimm3r.refraction.settings import PortSettings
from swimm3r.synthetic import DiveSettings, make_dive, write_dive
from swimm3r.synthetic.dive import poses_of
from swimm3r.synthetic.optics import rolled
from swimm3r.synthetic.seafloor import height_at

SMALL = DiveSettings(frames=8, width=90, height=60, noise=0.0)
FLAT = replace(SMALL, housing="flat", port=PortSettings(distance=0.05, thickness=0.01))


def world_points(dive, i):
    """The points that frame i shows, along the rays it was rendered with."""
    frame, rays = dive.frame(i), dive.rays_of(i)[0]
    z = frame.z_depth.double()[..., None]
    seen = torch.nn.functional.pad(rays.start, (0, 1)) + z * rays.direction
    pose = dive.cameras.cam2world[i]
    return (seen @ pose[:3, :3].T + pose[:3, 3])[frame.z_depth > 0]


@pytest.mark.parametrize(
    "settings",
    [
        FLAT,
        replace(SMALL, fisheye=True, fov=150),
        replace(FLAT, fisheye=True, fov=150),
        replace(SMALL, readout=0.05),
        replace(FLAT, readout=0.05),
        replace(SMALL, squeeze=4 / 3),
    ],
)
def test_every_pixel_shows_a_point_of_the_floor(settings):
    dive = make_dive(settings)
    x, y, z = world_points(dive, 3).numpy().T
    assert len(x) > 1000
    np.testing.assert_allclose(height_at(dive.floor.around(0, 0), x, y), z, atol=2e-5)


def test_a_centered_dome_and_glass_and_air_of_one_index_give_the_image_without_a_port():
    plain = make_dive(SMALL).frame(2)
    ports = {
        "dome": PortSettings(thickness=0.0),
        "flat": PortSettings(distance=0.0, thickness=0.0, glass=1.0, water=1.0),
    }
    for housing, port in ports.items():
        seen = make_dive(replace(SMALL, housing=housing, port=port)).frame(2)
        torch.testing.assert_close(seen.z_depth, plain.z_depth, atol=1e-5, rtol=0)
        torch.testing.assert_close(seen.clear, plain.clear, atol=1e-4, rtol=0)


def test_a_flat_port_narrows_the_view_by_the_law_of_sines():
    dive = make_dive(FLAT)
    rays = dive.rays[0].direction
    air = image_directions(make_dive(SMALL).cameras[0]).double()
    sine = torch.linalg.vector_norm(rays[..., :2], dim=-1) / torch.linalg.vector_norm(rays, dim=-1)
    sine_in_air = torch.linalg.vector_norm(air[..., :2], dim=-1) / torch.linalg.vector_norm(air, dim=-1)
    torch.testing.assert_close(1.333 * sine, sine_in_air, atol=1e-6, rtol=0)


def test_light_is_lost_from_the_port_on():
    dive = make_dive(FLAT)
    frame = dive.frame(1)
    hit = frame.z_depth > 0
    length = torch.linalg.vector_norm(dive.rays[0].direction, dim=-1)
    torch.testing.assert_close(
        (frame.z_depth * length - frame.ray_depth)[hit], (dive.rays[0].wet * length)[hit], atol=1e-5, rtol=0
    )
    assert float(dive.rays[0].wet.min()) == pytest.approx(dive.housed.outside)
    torch.testing.assert_close(frame.raw[hit], add_water(frame.clear, frame.ray_depth, dive.medium)[hit])


def test_the_fisheye_s_corners_are_half_the_field_of_view_off_the_axis():
    camera = make_dive(replace(SMALL, fisheye=True, fov=150)).cameras[0]
    wide = image_directions(camera)[0, 0]
    corner = torch.rad2deg(torch.atan(torch.linalg.vector_norm(wide[:2])))
    middle = pixel_grid(60, 90)[0, 0] - torch.tensor([45.0, 30.0])
    assert float(corner) == pytest.approx(75 * float(middle.norm()) / float(np.hypot(45, 30)), abs=1e-3)


def test_the_lens_in_air_lies_beside_the_truth(tmp_path):
    write_dive(replace(FLAT, frames=3), tmp_path)
    assert (tmp_path / "truth" / "lens.json").is_file()


@pytest.mark.parametrize(
    "changes",
    [
        {"fisheye": True, "path": "transect"},
        {"housing": "flat", "moving_object": True},
        {"housing": "flat", "printed_markers": 2},
    ],
)
def test_combinations_without_truth_are_refused(changes):
    with pytest.raises(UsageError):
        replace(SMALL, **changes)


def test_a_dome_that_the_lens_looks_past_is_refused():
    with pytest.raises(UsageError, match="miss the port"):
        make_dive(replace(SMALL, housing="dome", fov=110, port=PortSettings(distance=0.2, radius=0.05)))


@pytest.mark.parametrize("path", ["loop", "transect"])
def test_a_row_is_that_of_a_camera_at_the_time_of_its_exposure(path: Literal["loop", "transect"]):
    settings = replace(SMALL, frames=200, path=path, length=3.0, readout=0.05, width=96, height=64)
    dive, i, row = make_dive(settings), 4, 50
    rolling = dive.frame(i)
    moment = ((row + 0.5) / 64 - 0.5) * settings.readout
    then = poses_of(settings, dive.floor, moment)[i]
    cameras = replace(dive.cameras, cam2world=torch.from_numpy(then)[None].expand(len(dive), 4, 4))
    at_once = replace(dive, cameras=cameras, motion=None).frame(i)
    standing = make_dive(replace(settings, readout=0.0)).frame(i)
    difference = (rolling.clear[row] - at_once.clear[row]).abs()
    assert difference.median() < 2e-3
    assert difference.mean() < 0.1 * (standing.clear[row] - at_once.clear[row]).abs().mean()
    assert not torch.equal(rolling.clear[row], standing.clear[row])


def test_a_camera_that_stands_still_while_its_rows_are_exposed_sees_them_all_at_once():
    rays = make_dive(FLAT).rays[0]
    same = rolled(rays, np.zeros(6))
    for name in ("start", "direction", "wet"):
        torch.testing.assert_close(getattr(same, name), getattr(rays, name), atol=1e-12, rtol=0)


def test_a_squeezed_film_shows_what_the_lens_saw_in_fewer_columns():
    wide = make_dive(replace(SMALL, width=96, height=54)).rays[0].direction
    squeezed = make_dive(replace(SMALL, width=72, height=54, squeeze=4 / 3)).rays[0].direction
    np.testing.assert_allclose(squeezed[:, 0, 1], wide[:, 0, 1], atol=1e-12)  # rows are the same
    columns = (np.arange(72) + 0.5) / 72 * 96 - 0.5
    np.testing.assert_allclose(squeezed[0, :, 0], np.interp(columns, np.arange(96), wide[0, :, 0]), atol=1e-12)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"squeeze": 4 / 3, "fisheye": True}, "squeezed films"),
        ({"squeeze": 4 / 3, "housing": "flat"}, "squeezed films"),
        ({"readout": 0.02, "printed_markers": 2}, "printed markers"),
    ],
)
def test_films_that_cannot_be_made_are_refused(asked: dict[str, Any], words: str):
    with pytest.raises(UsageError, match=words):
        DiveSettings(**asked)
