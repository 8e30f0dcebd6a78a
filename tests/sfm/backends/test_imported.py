"""Other programs' models as a Reconstruction: nothing lost on the way, and what is missing is said."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from swimm3r.cameras import cameras_of, project
from swimm3r.errors import InputError
from swimm3r.io import images
from swimm3r.io.cameras_json import CameraTable
from swimm3r.io.colmap.model import ColmapModel
from swimm3r.io.imports.read import read_foreign
from swimm3r.io.imports.record import ForeignDepth, ForeignModel
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import Tracks
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.sfm.backends import imported as imported_backend
from swimm3r.sfm.colmap.triangulation import triangulate
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.settings import ColmapModelSettings
from swimm3r.synthetic import Coefficients, DiveSettings, make_dive


@pytest.fixture
def model(dive) -> ColmapModel:
    """The flat dive as another program would store it: at twice the size, with points that every frame sees."""
    cameras = dive.rec.cameras
    x, y = torch.meshgrid(torch.linspace(-0.3, 0.3, 6), torch.linspace(-0.2, 0.2, 5), indexing="ij")
    xyz = torch.stack([x.flatten(), y.flatten(), torch.zeros(30)], -1).double()
    uv, _ = project(cameras, xyz.expand(len(cameras), -1, -1))
    inside = ((uv > 0) & (uv < torch.tensor([96.0, 72.0]))).all(-1)
    frame, point = (a.numpy() for a in torch.nonzero(inside, as_tuple=True))
    K = cameras.K.clone()
    K[:, :2] *= 2
    return ColmapModel(
        names=tuple(str(Path(name).with_suffix(".jpg")) for name in dive.rec.names),
        model="PINHOLE",
        width=192,
        height=144,
        K=K.numpy(),
        distortion=np.zeros((len(cameras), 0)),
        cam2world=cameras.cam2world.numpy(),
        xyz=xyz.numpy(),
        rgb=np.zeros((30, 3), np.uint8),
        error=np.zeros(30),
        track_point=point,
        track_frame=frame,
        track_xy=uv.numpy()[frame, point] * 2,
    )


def test_cameras_points_scale_and_observations_are_those_of_the_file(dive, model: ColmapModel, tmp_path: Path):
    rec = imported_backend.from_foreign(
        dive.frames, ForeignModel("OpenMVG", model, metric=True, colored=False), tmp_path
    )
    assert rec.backend == "OpenMVG"
    assert rec.metric
    assert rec.names == dive.rec.names  # .jpg in the file, .png as prepared
    torch.testing.assert_close(rec.cameras.K, dive.rec.cameras.K)
    torch.testing.assert_close(rec.cameras.cam2world, dive.rec.cameras.cam2world)
    assert len(rec.points.xyz) == 30
    uv, _ = project(rec.cameras, rec.points.xyz.expand(len(rec.names), -1, -1))
    torch.testing.assert_close(uv[rec.tracks.frame, rec.tracks.point], rec.tracks.xy, atol=1e-9, rtol=0)
    rec.save(tmp_path, dive.frames)
    again = load_reconstruction(tmp_path)
    torch.testing.assert_close(again.points.xyz, rec.points.xyz)
    assert torch.equal(again.matches.xy_i, rec.matches.xy_i)


def test_points_without_colors_get_those_of_the_images(dive, model: ColmapModel, tmp_path: Path):
    rec = imported_backend.from_foreign(dive.frames, ForeignModel("OpenMVG", model, colored=False), tmp_path)
    mine = rec.tracks.point == 7
    places = zip(rec.tracks.frame[mine].tolist(), rec.tracks.xy[mine].long().tolist(), strict=True)
    seen = [dive.frames.image(f)[y, x] for f, (x, y) in places]
    torch.testing.assert_close(rec.points.rgb[7], torch.stack(seen).mean(0))
    assert rec.points.error.max() < 1e-6


def test_matches_pair_the_observations_of_one_point_with_the_next_frames():
    tracks = Tracks(
        torch.tensor([0, 0, 0, 0, 0, 1, 1]),
        torch.tensor([4, 0, 1, 2, 3, 6, 2]),
        torch.arange(14.0).reshape(7, 2).double(),
    )
    found = imported_backend.matches_of(tracks, reach=2)
    pairs = set(zip(found.i.tolist(), found.j.tolist(), strict=True))
    assert pairs == {(0, 1), (1, 2), (2, 3), (3, 4), (0, 2), (1, 3), (2, 4), (2, 6)}
    row = (found.i == 2) & (found.j == 6)
    assert found.xy_i[row].tolist() == [[12.0, 13.0]]
    assert found.xy_j[row].tolist() == [[10.0, 11.0]]


def test_depth_that_comes_with_the_file_is_put_on_the_frames_grid(dive, model: ColmapModel, tmp_path: Path):
    n = len(model.names)
    heights = -model.cam2world[:, 2, 3]
    K = np.tile([[40.0, 0, 24], [0, 40, 18], [0, 0, 1]], (n, 1, 1))
    z = np.ones((n, 36, 48), np.float32) * heights[:, None, None].astype(np.float32)
    z[0, :, :10] = 0
    dense = ForeignDepth(K, z, np.full((n, 36, 48), 0.7, np.float32), np.full((n, 36, 48), 0.5, np.float32))
    foreign = ForeignModel("VGGT", replace(model, track_point=model.track_point[:0], track_frame=model.track_frame[:0],
                                           track_xy=model.track_xy[:0]), depth=dense)  # fmt: skip
    rec = imported_backend.from_foreign(dive.frames, foreign, tmp_path)
    imported_backend.write_depth(rec, dive.frames, foreign)
    for k, name in enumerate(rec.names):
        found = rec.depth[name]
        known = found.z_depth > 0
        assert known[:, 24:].float().mean() > 0.9
        torch.testing.assert_close(found.z_depth[known], torch.full_like(found.z_depth[known], heights[k]))
        torch.testing.assert_close(found.confidence[known].mean(), torch.tensor(0.7), atol=0.02, rtol=0)
    assert not (rec.depth[rec.names[0]].z_depth[:, :16] > 0).any()


@pytest.fixture
def posed_dive(tmp_path: Path) -> tuple[Frames, Path]:
    """Five frames along a textured seafloor, and a cameras.json of them."""
    whole = make_dive(DiveSettings(frames=24, width=240, height=160, coefficients=Coefficients(beta_B=(0.1, 0.1, 0.1))))
    chosen = range(8, 13)
    frames = []
    for i in chosen:
        path = tmp_path / "images" / whole.names[i]
        images.write_rgb(path, whole.frame(i).raw.clamp(0, 1).numpy())
        frames.append(Frame(path.name, path, float(i), 1.0, "train"))
    cameras = whole.cameras[list(chosen)]
    table = CameraTable(
        tuple(f.name for f in frames), 240, 160, "PINHOLE", cameras.K.numpy(), cameras.distortion.numpy(),
        cameras.cam2world.numpy(), "metres",
    )  # fmt: skip
    cameras_of(table).save(tmp_path / "cameras.json", table.names, table.times, table.units)
    return Frames(tuple(frames), 240, 160, True), tmp_path / "cameras.json"


def test_poses_alone_get_points_of_our_own_where_the_file_puts_the_cameras(posed_dive, tmp_path: Path):
    frames, path = posed_dive
    rec = imported_backend.from_foreign(frames, read_foreign(path), tmp_path / "sfm")
    assert rec.metric
    assert len(rec.points.xyz) == 0
    found = triangulate(rec, frames, FeatureSettings(), tmp_path / "sfm")
    torch.testing.assert_close(found.cameras.cam2world, rec.cameras.cam2world)
    assert len(found.points.xyz) > 100
    assert len(found.matches.i) > 100
    uv, z = project(found.cameras, found.points.xyz.expand(len(found.names), -1, -1))
    off = (uv[found.tracks.frame, found.tracks.point] - found.tracks.xy).norm(dim=-1)
    assert off.median() < 0.5
    assert (z[found.tracks.frame, found.tracks.point] > 0).all()


def test_a_cloud_without_observations_stays_beside_the_triangulated_points(posed_dive, tmp_path: Path):
    frames, path = posed_dive
    foreign = read_foreign(path)
    cloud = replace(foreign.model, xyz=np.ones((3, 3)), rgb=np.full((3, 3), 9, np.uint8), error=np.zeros(3))
    rec = imported_backend.from_foreign(frames, replace(foreign, model=cloud), tmp_path / "sfm")
    found = triangulate(rec, frames, FeatureSettings(), tmp_path / "sfm")
    assert found.points.xyz[:3].tolist() == np.ones((3, 3)).tolist()
    assert found.tracks.point.min() == 3
    found.save(tmp_path / "sfm", frames)
    assert len(load_reconstruction(tmp_path / "sfm").points.xyz) == len(found.points.xyz)


def test_images_that_match_nowhere_come_with_a_warning(posed_dive, tmp_path: Path):
    frames, path = posed_dive
    for frame in frames:
        images.write_rgb(frame.path, np.full((160, 240, 3), 0.4))
    rec = imported_backend.reconstruct(frames, ColmapModelSettings(path), tmp_path / "sfm")
    assert "the images' own matches do not agree with its poses" in rec.warnings[0].what
    assert len(rec.tracks.point) == len(rec.matches.i) == 0


def test_a_model_of_other_images_is_an_input_error(dive, model: ColmapModel, tmp_path: Path):
    other = replace(model, names=tuple(f"reef_{i}.jpg" for i in range(len(model.names))))
    with pytest.raises(InputError, match="0 of 7 training frames are in the"):
        imported_backend.from_foreign(dive.frames, ForeignModel("Metashape", other), tmp_path)
