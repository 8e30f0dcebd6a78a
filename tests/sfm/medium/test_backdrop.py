"""Ground without confirmed depth: points where the cloud shows nothing, and nowhere else."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from swimm3r.cameras import project
from swimm3r.scene.reconstruction import DenseCloud, DepthMap, DepthMaps, Reconstruction
from swimm3r.sfm.medium.backdrop import Backdrop
from swimm3r.sfm.medium.restore import restored_images
from swimm3r.sfm.medium.settings import RestoreSettings

from .test_restore import exact


@pytest.fixture
def patchy(dive, tmp_path):
    """The dive with all depth of its left third unknown, in every frame and in the cloud."""
    return without_depth(dive, tmp_path / "z_depth", slice(0, 32))


def without_depth(dive, folder: Path, columns: slice) -> Reconstruction:
    """The dive with the depth of some columns unknown in every frame, and the first frame's surface as its cloud."""
    depth = DepthMaps(folder)
    for name in dive.rec.names:
        z = dive.rec.depth[name].z_depth.clone()
        z[:, columns] = 0
        depth.write(name, DepthMap(z, (z > 0).float()))
    column = torch.arange(96).expand(72, 96).flatten()
    rec = replace(dive.rec, depth=depth, medium=exact(dive.medium))
    first, z = rec.cameras[0], depth[rec.names[0]].z_depth.flatten()
    known = z > 0
    uv = torch.stack([column + 0.5, torch.arange(72).repeat_interleave(96) + 0.5], -1).double()[known]
    xyz = torch.cat([uv, torch.ones(len(uv), 1)], -1) @ torch.linalg.inv(first.K[0]).mT * z[known, None]
    xyz = (xyz @ first.cam2world[0, :3, :3].mT + first.cam2world[0, :3, 3]).float()
    colors = dive.frames.image(0).reshape(-1, 3)[known]
    return replace(rec, cloud=DenseCloud(xyz, colors, colors))


def gathered(rec, dive, count: int) -> DenseCloud:
    backdrop = Backdrop(rec, dive.frames)
    for i, image in restored_images(rec, dive.frames, RestoreSettings(white_balance=False)):
        if i < count:
            backdrop.add(i, image)
    return backdrop.points()


def test_no_pixel_gives_two_points(patchy, dive):
    found = gathered(patchy, dive, 1)
    assert len(found.xyz.unique(dim=0)) == len(found.xyz)


def test_ground_without_depth_gets_points_with_its_clear_colors(patchy, dive):
    found = gathered(patchy, dive, 1)
    pixels, z = project(patchy.cameras[0], found.xyz[None].double())
    assert len(found.xyz) > 200
    assert (pixels[0, :, 0] < 33).all()
    assert (z > 0).all()
    row, column = pixels[0, :, 1].long(), pixels[0, :, 0].long()
    true_z = dive.rec.depth[dive.rec.names[0]].z_depth[row, column]
    assert ((z[0] - true_z).abs() / true_z).median() < 0.1
    assert (found.restored - dive.clear[0][row, column]).abs().mean() < 0.05


def test_ground_that_an_earlier_frame_gave_is_not_taken_again(patchy, dive):
    images = dict(restored_images(patchy, dive.frames, RestoreSettings(white_balance=False)))
    alone, after = Backdrop(patchy, dive.frames), Backdrop(patchy, dive.frames)
    alone.add(1, images[1])
    for i in (0, 0, 1):
        after.add(i, images[i])
    first = len(gathered(patchy, dive, 1).xyz)
    assert first < len(after.points().xyz) < first + 0.7 * len(alone.points().xyz)


def test_a_gap_of_the_cloud_narrower_than_a_cell_is_filled(dive, tmp_path):
    """Cells are 2 px wide and begin at even columns here, so that each of the two that share this gap holds points."""
    found = gathered(without_depth(dive, tmp_path / "gap", slice(63, 65)), dive, 1)
    pixels, _ = project(dive.rec.cameras[0], found.xyz[None].double())
    assert len(found.xyz) > 72
    assert ((pixels[0, :, 0] > 62.9) & (pixels[0, :, 0] < 65.1)).all()


def test_known_depth_and_open_water_leave_nothing_to_guess(dive, patchy):
    full = replace(patchy, depth=dive.rec.depth)
    assert len(gathered(full, dive, 1).xyz) == 0
    backdrop = Backdrop(patchy, dive.frames)
    _, image = next(restored_images(patchy, dive.frames, RestoreSettings()))
    backdrop.add(0, replace(image, sea=torch.ones_like(image.sea)))
    assert len(backdrop.points().xyz) == 0


def test_a_frame_that_measured_little_guesses_where_the_cloud_shows_enough(patchy, dive, tmp_path):
    little, spot = DepthMaps(tmp_path / "little"), torch.zeros(72, 96)
    spot[30:42, 60:72] = 1
    for name in dive.rec.names:
        little.write(name, DepthMap(dive.rec.depth[name].z_depth * spot, spot))
    rec = replace(patchy, depth=little)
    found = gathered(rec, dive, 1)
    assert len(found.xyz) > 200
    true_z = float(dive.rec.depth[dive.rec.names[0]].z_depth[0, 0])
    _, guessed_z = project(rec.cameras[0], found.xyz[None].double())
    assert ((guessed_z[0] - true_z).abs() / true_z).median() < 0.1
    assert rec.cloud is not None
    few = DenseCloud(*(values[:100] for values in (rec.cloud.xyz, rec.cloud.raw, rec.cloud.restored)))
    assert len(gathered(replace(rec, cloud=few), dive, 1).xyz) == 0


def test_ground_too_white_for_its_guessed_distance_is_pulled_toward_the_camera_by_a_third_at_most(patchy, dive):
    """Its color is restored over a shorter path; a point there would hang before the lens where the water is wrong."""
    _, image = next(restored_images(patchy, dive.frames, RestoreSettings()))
    glaring = replace(dive.medium, beta_D=3 * dive.medium.beta_D)
    _, white = next(restored_images(replace(patchy, medium=exact(glaring)), dive.frames, RestoreSettings()))
    torch.testing.assert_close(white.ray_depth[:, 32:], image.ray_depth[:, 32:])
    assert (white.ray_depth >= 0.7 * image.ray_depth).all()
    assert (white.ray_depth < 0.9 * image.ray_depth).any()
