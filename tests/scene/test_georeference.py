"""The georeference of a run: its frames, its file, and up from the scene."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from swimm3r.cameras import Cameras
from swimm3r.errors import InputError
from swimm3r.geometry import DegenerateAlignmentError, pose_from, so3_exp
from swimm3r.scene.georeference import (
    Georeference,
    Vector,
    load_georeference,
    local_georeference,
    save_georeference,
    up_from_scene,
)
from swimm3r.scene.reconstruction import DepthMaps, Matches, Points, Reconstruction, Tracks

DOWN = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]], dtype=torch.float64)  # camera axes of a view from above


def rotation_rows(R: torch.Tensor) -> tuple[Vector, Vector, Vector]:
    first, second, third = ((float(x), float(y), float(z)) for x, y, z in R)
    return first, second, third


def tilted(seed: int = 0):
    return so3_exp(torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))


def scene(points, poses) -> Reconstruction:
    n, c = len(points), len(poses)
    K = torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]], dtype=torch.float64).expand(c, 3, 3)
    none = torch.zeros(0, dtype=torch.int64)
    return Reconstruction(
        names=tuple(f"{i}.png" for i in range(c)),
        cameras=Cameras(K.clone(), torch.zeros(c, 0, dtype=torch.float64), poses, 320, 240),
        points=Points(points, torch.zeros(n, 3), torch.zeros(n)),
        tracks=Tracks(none, none, torch.zeros(0, 2)),
        matches=Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)),
        depth=DepthMaps(Path("none")),
        backend="colmap",
    )


def survey(turn, noise: float = 0.05) -> Reconstruction:
    """Cameras three units above a rough sea floor, looking down, in axes turned by `turn`."""
    random = torch.Generator().manual_seed(1)
    points = torch.rand(500, 3, generator=random, dtype=torch.float64) * torch.tensor([10.0, 6, 0])
    points[:, 2] = noise * torch.randn(500, generator=random, dtype=torch.float64)
    points[:60, 2] += 1.5 * torch.rand(60, generator=random, dtype=torch.float64)  # chimneys and fish
    centers = torch.stack([torch.linspace(0, 10, 8), torch.full((8,), 3.0), torch.full((8,), 3.0)], -1).double()
    return scene(points @ turn.mT, pose_from(turn @ DOWN.expand(8, 3, 3), centers @ turn.mT))


@pytest.fixture
def georeference() -> Georeference:
    return Georeference(
        epsg=32701,
        origin=(544_761.312_345, 7_568_301.987_654, -1854.25),
        rotation=rotation_rows(tilted()),
        scale=0.8137,
        scale_std=0.004,
        sources=("navigation",),
        origin_std=(0.03, 0.03, 0.02),
        grid_scale=0.9999,
        geodetic=(-21.989, -176.567),
    )


def test_coordinates_far_from_the_equator_come_back_to_a_tenth_of_a_micrometre(georeference):
    run = np.random.default_rng(0).normal(size=(50, 3)) * 20
    np.testing.assert_allclose(georeference.from_crs(georeference.to_crs(run)), run, atol=1e-7)
    np.testing.assert_allclose(georeference.from_local(georeference.to_local(run)), run, atol=1e-12)


def test_local_lengths_are_metres_and_grid_lengths_those_of_the_projection(georeference):
    ends = np.array([[0.0, 0, 0], [1.0, 2.0, -0.5]])
    run = np.linalg.norm(ends[1] - ends[0])
    local = georeference.to_local(ends)
    assert np.linalg.norm(local[1] - local[0]) == pytest.approx(0.8137 * run)
    crs = georeference.to_crs(ends)
    along = np.linalg.norm(crs[1, :2] - crs[0, :2]) / np.linalg.norm(local[1, :2] - local[0, :2])
    assert along == pytest.approx(0.9999, abs=1e-7)
    assert crs[1, 2] - crs[0, 2] == pytest.approx(local[1, 2] - local[0, 2], abs=1e-9)


def test_up_of_the_run_is_local_z(georeference):
    np.testing.assert_allclose(georeference.to_local(georeference.up) / 0.8137, [0, 0, 1], atol=1e-12)


def test_a_file_gives_back_every_bit(georeference, tmp_path):
    save_georeference(tmp_path, georeference)
    assert load_georeference(tmp_path) == georeference


def test_a_run_without_one_has_none(tmp_path):
    assert load_georeference(tmp_path) is None


@pytest.mark.parametrize(
    ("key", "value", "fault"),
    [
        ("rotation", [[1, 0, 0], [0, 1, 0], [0, 0, -1]], "no rotation"),
        ("scale", -1.0, "scale is above 0"),
        ("schema", 99, "schema 99"),
        ("origin", [1.0, 2.0], "origin"),
        ("origin", [1.0, float("nan"), 2.0], "origin"),
    ],
)
def test_a_damaged_file_is_refused_by_name(georeference, tmp_path, key, value, fault):
    save_georeference(tmp_path, georeference)
    path = tmp_path / "georeference.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    with pytest.raises(InputError, match=fault) as told:
        load_georeference(tmp_path)
    assert "georeference.json" in told.value.what


def test_up_is_the_normal_of_the_ground_on_the_side_of_the_cameras():
    turn = tilted()
    up = up_from_scene(survey(turn))[2]
    assert np.degrees(np.arccos(up @ turn[:, 2].numpy())) < 1.0


def test_up_turns_with_the_run():
    first, second = (up_from_scene(survey(tilted(seed)))[2] @ tilted(seed).numpy() for seed in (0, 3))
    np.testing.assert_allclose(first, second, atol=1e-9)


def test_from_above_the_ground_lies_as_in_the_frames():
    turn = tilted()
    local = up_from_scene(survey(turn)) @ turn.numpy()
    assert local[0] @ [1, 0, 0] > 0.999
    assert np.linalg.det(local) == pytest.approx(1)


def test_around_a_wreck_up_is_that_of_the_mean_camera():
    turn = tilted(2)
    points = torch.randn(400, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    angles = torch.linspace(0, 5.5, 12, dtype=torch.float64)
    forward = torch.stack([-angles.cos(), -angles.sin(), torch.zeros(12)], -1).double()
    down = torch.tensor([0, 0, -1.0], dtype=torch.float64).expand(12, 3)
    axes = torch.stack([torch.linalg.cross(down, forward), down, forward], -1)
    poses = pose_from(turn @ axes, (-5 * forward) @ turn.mT)
    np.testing.assert_allclose(up_from_scene(scene(points @ turn.mT, poses))[2], turn[:, 2].numpy(), atol=1e-9)


def test_a_scene_that_shows_no_direction_is_refused():
    points = torch.randn(400, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    turned = torch.stack([torch.eye(3, dtype=torch.float64), torch.diag(torch.tensor([1.0, -1, -1])).double()])
    with pytest.raises(DegenerateAlignmentError, match="which way is up"):
        up_from_scene(scene(points, pose_from(turned, torch.zeros(2, 3, dtype=torch.float64))))


def test_the_frame_of_a_run_without_georeference_has_no_metres():
    rec = survey(tilted())
    assert (local_georeference(rec).scale, local_georeference(rec).unit) == (None, "units")
    assert (
        local_georeference(replace(rec, metric=True)).scale,
        local_georeference(replace(rec, metric=True)).unit,
    ) == (1.0, "m")
