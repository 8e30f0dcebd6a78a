"""Printed markers of a synthetic dive: where they are, they are seen, and their depth is theirs."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from swimm3r.cameras import project
from swimm3r.scale.markers import detect
from swimm3r.synthetic import DiveSettings, make_dive
from swimm3r.synthetic.printed_markers import Plate, plates_from_above, with_plates
from swimm3r.synthetic.seafloor import height_at

DIVE = DiveSettings(frames=6, width=320, height=240, noise=0.0, printed_markers=3, printed_marker_size=0.3)


@pytest.fixture(scope="module")
def dive():
    return make_dive(DIVE)


def below(dive) -> tuple:
    """A camera straight above the second plate, and that plate."""
    plate = dive.plates[1]
    pose = torch.diag(torch.tensor([1.0, -1, -1, 1])).double()
    pose[:3, 3] = torch.tensor(plate.center) + torch.tensor([0.1, -0.05, 1.2])
    return replace(dive.cameras[0], cam2world=pose[None]), plate


def test_a_plate_covers_the_ground_below_it_and_nothing_else(dive):
    camera, plate = below(dive)
    radiance, z = with_plates(np.full((240, 320, 3), 0.2), np.full((240, 320), 9.0), camera, [plate])
    torch.testing.assert_close(z.min(), np.float64(camera.cam2world[0, 2, 3] - plate.center[2]))
    pixels = float(camera.K[0, 0, 0]) * 1.5 * plate.size / z.min()
    assert (z < 9).sum() == pytest.approx(pixels**2, rel=0.02)
    assert np.all(radiance[z == 9.0][:10] == 0.2)
    hidden, same = with_plates(np.full((240, 320, 3), 0.2), np.full((240, 320), 0.5), camera, [plate])
    assert np.all(same == 0.5)
    assert np.abs(hidden - 0.2).mean() < 0.01  # but for the edge, half a pixel wide


def test_the_marker_is_found_with_its_corners_at_their_places(dive):
    camera, plate = below(dive)
    radiance, _ = with_plates(np.full((240, 320, 3), 0.2), np.full((240, 320), 9.0), camera, [plate])
    found = detect(radiance.mean(-1).clip(0, 1), camera, "aruco-4x4-50")
    assert list(found) == [plate.marker]
    pixels, _ = project(camera, torch.from_numpy(plate.corners)[None])
    np.testing.assert_allclose(found[plate.marker], pixels[0].numpy(), atol=0.05)


def test_plates_lie_on_flat_ground_along_the_path(dive):
    for plate in dive.plates:
        x, y, z = plate.center
        assert 0 < z - float(height_at(dive.floor, np.array([x]), np.array([y]))[0]) < 0.15
        away = np.linalg.norm(dive.cameras.centers.numpy()[:, :2] - [x, y], axis=1)
        assert away.min() < 0.4
    assert [plate.marker for plate in dive.plates] == [0, 1, 2]


def test_a_square_has_its_size_and_turn():
    plate = Plate(4, (1.0, 2.0, 0.1), 0.4, 0.3)
    sides = np.linalg.norm(plate.corners - np.roll(plate.corners, 1, 0), axis=1)
    np.testing.assert_allclose(sides, 0.3)
    np.testing.assert_allclose(plate.corners.mean(0), [1, 2, 0.1])


def test_the_view_from_above_shows_the_plate_that_a_camera_above_it_sees(dive):
    camera, plate = below(dive)
    radiance, z = with_plates(np.full((240, 320, 3), 0.2), np.full((240, 320), 9.0), camera, [plate])
    height, place = float(camera.cam2world[0, 2, 3]), camera.cam2world[0, :2, 3].numpy()
    cell = (height - plate.center[2]) / float(camera.K[0, 0, 0])  # of a pixel on the plate
    x = place[0] + (np.arange(320) + 0.5 - float(camera.K[0, 0, 2])) * cell
    y = place[1] - (np.arange(240) + 0.5 - float(camera.K[0, 1, 2])) * cell
    above, ground = plates_from_above(np.full((240, 320, 3), 0.2), np.full((240, 320), height - 9.0), x, y, [plate])
    np.testing.assert_allclose(above, radiance, atol=1e-6)
    np.testing.assert_allclose(height - ground, z, atol=1e-6)


def test_ground_above_a_plate_hides_it_from_above(dive):
    plate = dive.plates[1]
    x, y = (plate.center[k] + np.linspace(-0.05, 0.05, 11) for k in range(2))
    height = np.where(np.arange(11) < 5, plate.center[2] + 0.1, plate.center[2] - 0.1) + np.zeros((11, 11))
    above, found = plates_from_above(np.full((11, 11, 3), 0.2), height, x, y, [plate])
    np.testing.assert_allclose(above[:, :5], 0.2)
    np.testing.assert_allclose(found[:, :5], height[:, :5])
    np.testing.assert_allclose(found[:, 5:], plate.center[2])
    assert np.abs(above[:, 5:] - 0.2).mean() > 0.1
