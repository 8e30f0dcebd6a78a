"""Paths of a virtual camera: along the dive, around the scene, and from files."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from swimm3r.cameras import Cameras, project
from swimm3r.errors import InputError
from swimm3r.geometry import Similarity, so3_exp
from swimm3r.pipeline.camera_paths import CameraPath, Dive, camera_path, looking_at, rows_of_one_camera, smooth_path
from swimm3r.pipeline.view_settings import ViewSettings
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.rig import Rig, RigCamera

COUNT = 8


@pytest.fixture
def dive(tmp_path: Path) -> Dive:
    """Eight cameras that look down from a height of 2 on sloping ground around (3, 1)."""
    rng = torch.Generator().manual_seed(0)
    x, y = (4 * torch.rand(2, 400, generator=rng) - 2).double()
    ground = torch.stack([3 + x, 1 + y, 0.1 * torch.sin(3 * x)], -1)
    at = torch.linspace(-1.5, 1.5, COUNT).double()
    centers = torch.stack([3 + at, 1 + 0.2 * at, torch.full_like(at, -2)], -1)  # z points down
    ahead, up = torch.tensor([[0.3, 0, 1.0], [0, -1.0, 0]]).double()
    poses = torch.stack([looking_at(center, center + ahead, up) for center in centers])
    K = torch.tensor([[70.0, 0, 40], [0, 70, 30], [0, 0, 1]], dtype=torch.float64).repeat(COUNT, 1, 1)
    cameras = Cameras(K, torch.zeros(COUNT, 0).double(), poses, 80, 60)
    frames = CameraPath(tuple(f"{i}.png" for i in range(COUNT)), cameras, tuple(float(i) for i in range(COUNT)))
    clip = Frames(tuple(Frame(name, Path(name), 0.0, 1.0, "train") for name in frames.names), 80, 60, True)
    return Dive(frames, clip, ground, (0.0, 7.0), tmp_path / "sfm" / "cameras.json", None)


def test_without_a_wish_the_frames_are_rendered(dive: Dive):
    assert camera_path(dive, ViewSettings()) is dive.frames


@pytest.mark.parametrize("name", ["frames", "dive"])
def test_a_flight_passes_the_frames_in_their_times(name, dive: Dive):
    found = camera_path(dive, ViewSettings(name, count=29))
    assert len(found.cameras) == len(found.names) == 29
    assert found.times is not None
    assert found.times[0] == 0
    assert found.times[14] == pytest.approx(3.5)
    assert found.times[-1] == 7
    apart = torch.cdist(found.cameras.centers, dive.frames.cameras.centers).min(0).values
    assert apart[1:-1].max() < 0.1
    assert len(camera_path(dive, ViewSettings("dive")).cameras) == 90


@pytest.fixture
def rig_dive(dive: Dive) -> Dive:
    """Left and right in turn, the right one 3 above and with another lens; the first left frame is not registered."""
    cameras, names = dive.frames.cameras, dive.frames.names
    K, poses, right = cameras.K.clone(), cameras.cam2world.clone(), slice(0, None, 2)
    K[right, 0, 0], poses[right, 2, 3] = 140.0, -5.0
    sides = {name: ("right", "left")[i % 2] for i, name in enumerate(names)}
    clip = replace(
        dive.clip,
        frames=tuple(replace(frame, camera=sides[frame.name]) for frame in dive.clip),
        rig=Rig((RigCamera("left"), RigCamera("right"))),
    )
    return replace(dive, clip=clip, frames=replace(dive.frames, cameras=replace(cameras, K=K, cam2world=poses)))


@pytest.mark.parametrize("settings", [ViewSettings("dive"), ViewSettings("frames", count=20), ViewSettings("orbit")])
def test_a_flight_of_a_rig_is_that_of_its_first_camera(settings: ViewSettings, rig_dive: Dive):
    found = camera_path(rig_dive, settings)
    assert (found.cameras.K[:, 0, 0] == 70).all()
    if settings.path != "orbit":
        torch.testing.assert_close(found.cameras.centers[:, 2], torch.full((len(found.names),), -2.0).double())
        assert found.times is not None
        assert found.times[0] == 1.0


def test_the_frames_of_a_rig_are_all_rendered_each_with_its_lens(rig_dive: Dive):
    assert camera_path(rig_dive, ViewSettings()) is rig_dive.frames


def test_a_rig_whose_first_camera_is_nowhere_flies_along_the_next(rig_dive: Dive):
    right = rig_dive.frames.names[0::2]
    assert rows_of_one_camera(right, rig_dive.clip) == [0, 1, 2, 3]
    assert rows_of_one_camera(["of another program"], rig_dive.clip) == [0]


@pytest.mark.parametrize("name", ["orbit", "spiral"])
def test_a_path_around_the_scene_sees_its_middle_upright_from_the_side_of_the_dive(name, dive: Dive):
    found = camera_path(dive, ViewSettings(name, count=40))
    middle = dive.ground.median(0).values
    pixels, z = project(found.cameras, middle.expand(40, 1, 3))
    torch.testing.assert_close(pixels[:, 0], torch.tensor([40.0, 30.0]).double().expand(40, 2), atol=1e-6, rtol=0)
    assert (z > 0).all()
    centers = found.cameras.centers
    assert (centers[:, 2] < -0.8).all()  # above the ground, which lies at z = 0
    R = found.cameras.cam2world[:, :3, :3]
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(40).double())
    down = dive.frames.cameras.cam2world[:, :3, 1].mean(0)
    assert (R[:, :, 1] @ down > 0.8).all()
    apart = torch.cdist(centers, dive.frames.cameras.centers).min(-1).values
    assert apart.max() < 1.5  # of ground that is 2 away
    assert found.times is not None
    assert (found.times[0], found.times[-1]) == (0.0, 7.0)


def test_an_orbit_closes_and_a_spiral_narrows_and_comes_nearer(dive: Dive):
    middle = dive.ground.median(0).values
    orbit, spiral = (camera_path(dive, ViewSettings(name, count=60)).cameras.centers for name in ("orbit", "spiral"))
    step = (orbit.roll(-1, 0) - orbit).norm(dim=-1)
    torch.testing.assert_close(step, step[:1].expand(60), rtol=1e-6, atol=0)
    axis = torch.nn.functional.normalize(orbit.mean(0) - middle, dim=0)

    def reach(centers: torch.Tensor) -> torch.Tensor:
        offset = centers - middle
        return (offset - (offset @ axis)[:, None] * axis).norm(dim=-1)

    assert (reach(spiral).diff() < 0).all()
    assert reach(spiral)[-1] < 0.2 * reach(spiral)[0]
    assert (spiral[-1] - middle) @ axis < 0.7 * ((spiral[0] - middle) @ axis)
    distance = float((orbit.mean(0) - middle).norm())
    assert 0.2 * distance - 1e-9 <= float(reach(orbit).mean()) <= 0.5 * distance + 1e-9


def test_a_scene_moved_and_turned_has_its_paths_moved_and_turned(dive: Dive):
    move = Similarity(
        torch.tensor(2.0).double(), so3_exp(torch.tensor([0.4, -0.8, 0.3]).double()), torch.ones(3).double()
    )
    cameras = replace(dive.frames.cameras, cam2world=move.poses(dive.frames.cameras.cam2world))
    moved = replace(dive, frames=replace(dive.frames, cameras=cameras), ground=move.points(dive.ground))
    one, other = (camera_path(each, ViewSettings("orbit", count=12)).cameras.centers for each in (dive, moved))
    # the middle is a median per axis, which turns with the axes: about the same
    torch.testing.assert_close(other, move.points(one), atol=0.5, rtol=0)


def test_a_file_is_taken_with_its_lenses_and_moved_to_the_axes_of_the_map(dive: Dive, tmp_path: Path):
    bent = replace(dive.frames.cameras, K=dive.frames.cameras.K * torch.tensor([[[2.0], [2.0], [1.0]]]).double())
    bent.save(tmp_path / "path.json", dive.frames.names, dive.frames.times)
    move = Similarity(torch.tensor(2.0).double(), torch.eye(3).double(), torch.tensor([0, 0, 5.0]).double())
    found = camera_path(replace(dive, to_map=move), ViewSettings(tmp_path / "path.json"))
    torch.testing.assert_close(found.cameras.K, bent.K)
    torch.testing.assert_close(found.cameras.centers, 2 * bent.centers + torch.tensor([0, 0, 5.0]).double())
    assert found.times == dive.frames.times
    assert len(camera_path(dive, ViewSettings(tmp_path / "path.json", count=20)).cameras) == 20


def test_the_maps_own_cameras_are_in_its_axes_already(dive: Dive):
    dive.own_file.parent.mkdir()
    dive.frames.cameras.save(dive.own_file)
    move = Similarity(torch.tensor(2.0).double(), torch.eye(3).double(), torch.zeros(3).double())
    assert camera_path(replace(dive, to_map=move), ViewSettings(dive.own_file)) is dive.frames


@pytest.mark.parametrize("head", ["", "time,x,y,z,qw,qx,qy,qz\n", "# my path\n\nTime, x, y, z, qw, qx, qy, qz\n"])
def test_a_csv_has_times_positions_and_quaternions(head: str, dive: Dive, tmp_path: Path):
    (tmp_path / "p.CSV").write_text(head + "0.5,1,2,3,1,0,0,0\n1.5, 4,5,6, 1.4142135623730951,0,0,1.4142135623730951\n")
    found = camera_path(dive, ViewSettings(tmp_path / "p.CSV"))
    assert found.times == (0.5, 1.5)
    assert found.cameras.centers.tolist() == [[1, 2, 3], [4, 5, 6]]
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double()
    torch.testing.assert_close(found.cameras.cam2world[:, :3, :3], torch.stack([torch.eye(3).double(), quarter]))
    torch.testing.assert_close(found.cameras.K, dive.frames.cameras.K[:2])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "it has no poses"),
        ("time,x,y,z,qw,qx,qy,qz\n", "it has no poses"),
        ("0,1,2,3,1,0,0\n", "line 1 has 7 values, and 8 are expected"),
        ("0,1,2,3,1,0,0,0\n0,1,2,x,1,0,0,0\n", "line 2 has a value that is no number"),
        ("0,1,2,3,0,0,0,0\n", "a quaternion of zeros"),
        ("0,1,2,nan,1,0,0,0\n", "not finite"),
        ("0,1,2,1e300,1,0,0,0\n", "camera centers"),
    ],
)
def test_a_csv_that_is_none_is_refused_with_its_line(text: str, says: str, dive: Dive, tmp_path: Path):
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(InputError, match=r"p\.csv is no path of a camera \(") as refused:
        camera_path(dive, ViewSettings(tmp_path / "p.csv"))
    assert says in refused.value.what


def test_a_slip_in_the_name_of_a_path_is_named_with_the_names_there_are(dive: Dive):
    with pytest.raises(InputError, match="there is no file orbti") as refused:
        camera_path(dive, ViewSettings(Path("orbti")))
    assert "orbit" in refused.value.hint


def test_a_smooth_path_begins_and_ends_near_the_dive_and_holds_rotations():
    rng = torch.Generator().manual_seed(0)
    poses = torch.eye(4, dtype=torch.float64).repeat(12, 1, 1)
    poses[:, 0, 3] = torch.arange(12)
    poses[:, 1, 3] = 0.3 * torch.rand(12, generator=rng)
    path = smooth_path(poses, 50)
    assert path.shape == (50, 4, 4)
    torch.testing.assert_close(path[:, :3, :3] @ path[:, :3, :3].mT, torch.eye(3).double().expand(50, 3, 3))
    assert path[:, 0, 3].diff().min() > 0
    assert path[:, 1, 3].diff().abs().max() < 0.1 * poses[:, 1, 3].diff().abs().max()
    assert path[0, 0, 3] < 1.5
    assert path[-1, 0, 3] > 9.5
