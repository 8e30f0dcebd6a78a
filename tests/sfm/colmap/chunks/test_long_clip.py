"""A clip mapped in chunks: every frame where it was; chunks repeated alone; frames between keyframes placed."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.poses import absolute_pose_errors
from swimm3r.io.colmap.model import ColmapModel, to_pycolmap
from swimm3r.prepare import read_frames
from swimm3r.progress import silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.ground_truth import GroundTruth, read_ground_truth
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.between import place_between, read_between
from swimm3r.sfm.colmap import poses
from swimm3r.sfm.colmap.chunks import place
from swimm3r.sfm.colmap.chunks.parts import Part, coherent_models, coherent_parts
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.synthetic import write_dive
from swimm3r.synthetic.settings import DiveSettings

SETTINGS = replace(
    ColmapSettings(threads=2), mapping=replace(ColmapSettings().mapping, chunk_frames=10, chunk_overlap=4)
)
COUNT = 24
BETWEEN = (5, 11, 18)


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("long") / "dive"
    write_dive(DiveSettings(frames=COUNT, width=240, height=160), folder)
    return folder


@pytest.fixture(scope="module")
def truth(dive: Path) -> GroundTruth:
    return read_ground_truth(dive / "truth")


@pytest.fixture(scope="module")
def frames(dive: Path, tmp_path_factory: pytest.TempPathFactory) -> Frames:
    """All of them for training but a few, which lie between keyframes."""
    found = read_frames(dive, folder=tmp_path_factory.mktemp("prepare") / "frames")
    parts = ["between" if i in BETWEEN else "train" for i in range(COUNT)]
    return replace(found, frames=tuple(replace(frame, split=part) for frame, part in zip(found, parts, strict=True)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sfm")


@pytest.fixture(scope="module")
def rec(frames: Frames, folder: Path) -> Reconstruction:
    return poses.reconstruct(frames.train, SETTINGS, folder)


@dataclass(frozen=True)
class Errors:
    ate: float  # m
    rotation_deg: float


def errors(names: tuple[str, ...], cam2world: torch.Tensor, truth: GroundTruth) -> Errors:
    place_of = {name: i for i, name in enumerate(truth.names)}
    found = absolute_pose_errors(cam2world, truth.cameras.cam2world.double()[[place_of[name] for name in names]])
    assert not isinstance(found.ate, NotComputed)
    return Errors(found.ate, found.rotation_deg)


def test_every_frame_of_a_clip_in_chunks_is_placed_where_it_was(rec: Reconstruction, frames: Frames, truth, folder):
    assert rec.names == frames.train.names
    found = errors(rec.names, rec.cameras.cam2world, truth)
    assert found.rotation_deg < 0.3
    assert found.ate < 0.01  # m; the loop is some 8 m long
    assert len([path for path in (folder / "chunks").iterdir() if path.name != "pilot"]) == 3
    assert not (folder / poses.PARTS).exists()


def test_a_chunk_that_is_missing_is_placed_again_alone_and_ends_in_the_same_poses(
    rec: Reconstruction, frames: Frames, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    shutil.copytree(folder, tmp_path / "sfm")
    lost = next(path for path in sorted((tmp_path / "sfm" / "chunks").iterdir()) if path.name != "pilot")
    shutil.rmtree(lost)
    asked: list[int] = []
    real = place.map_frames
    monkeypatch.setattr(place, "map_frames", lambda store, *rest: asked.append(store.frames) or real(store, *rest))
    again = poses.reconstruct(frames.train, SETTINGS, tmp_path / "sfm")
    assert len(asked) == 1
    assert lost.is_dir()
    assert (again.cameras.cam2world == rec.cameras.cam2world).all()


def test_frames_between_keyframes_get_the_poses_they_were_taken_from(rec, frames: Frames, truth, tmp_path: Path):
    place_between(rec, frames, tmp_path, silent)
    table = read_between(tmp_path)
    assert table is not None
    assert table.names == frames.between.names
    everything = np.concatenate([rec.cameras.cam2world.numpy(), table.cam2world])
    found = errors((*rec.names, *table.names), torch.from_numpy(everything), truth)
    alone = errors(rec.names, rec.cameras.cam2world, truth)
    assert found.ate < max(0.01, 2 * alone.ate)
    assert found.rotation_deg < max(0.3, 2 * alone.rotation_deg)


def test_without_frames_between_no_file_is_written(rec: Reconstruction, frames: Frames, tmp_path: Path):
    place_between(rec, frames.train, tmp_path, silent)
    assert read_between(tmp_path) is None


def chain(scales: list[float], shared: int = 40) -> Part:
    """Cameras that look down on points at distance 1, each sharing points with the next; scaled from some point on."""
    rng = np.random.default_rng(0)
    cameras, seen, xyz = {}, {k + 1: [] for k in range(len(scales))}, []
    for k, scale in enumerate(scales):
        cameras[k + 1] = np.hstack([np.eye(3), [[-float(k)], [0.0], [scale - 1.0]]])
    for k in range(len(scales) - 1):
        for _ in range(shared):
            for image in (k + 1, k + 2):
                seen[image].append(len(xyz))
            xyz.append([k + rng.uniform(0, 1), rng.uniform(0, 1), 1.0])
    return Part(cameras, {image: np.array(points, np.int64) for image, points in seen.items()}, np.array(xyz))


def test_a_part_is_cut_where_the_scale_jumps_and_where_few_points_hold():
    assert [piece.images for piece in coherent_parts(chain([1.0] * 6))] == [(1, 2, 3, 4, 5, 6)]
    jumped = chain([1.0, 1.0, 1.0, 50.0, 50.0, 50.0])
    assert [piece.images for piece in coherent_parts(jumped)] == [(1, 2, 3), (4, 5, 6)]
    assert coherent_parts(chain([1.0] * 6, shared=8)) == []


def test_a_model_is_cut_into_models_of_all_its_pieces_the_largest_first():
    part = chain([1.0, 1.0, 1.0, 50.0, 50.0, 50.0, 50.0])
    rows = [(point, image - 1) for image, points in part.point_of.items() for point in points]
    track_point, track_frame = (np.array(row) for row in zip(*rows, strict=True))
    bottom = np.array([[0.0, 0.0, 0.0, 1.0]])
    n, p = len(part.images), len(part.xyz)
    model = ColmapModel(
        names=tuple(f"{i:06d}" for i in range(n)),
        model="PINHOLE",
        width=100,
        height=100,
        K=np.tile(np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]), (n, 1, 1)),
        distortion=np.zeros((n, 0)),
        cam2world=np.stack([np.linalg.inv(np.vstack([part.cam_from_world[i], bottom])) for i in part.images]),
        xyz=part.xyz,
        rgb=np.zeros((p, 3), np.uint8),
        error=np.zeros(p),
        track_point=track_point,
        track_frame=track_frame,
        track_xy=np.zeros((len(rows), 2)),
    )
    pieces = coherent_models(to_pycolmap(model))
    assert [sorted(piece.reg_image_ids()) for piece in pieces] == [[4, 5, 6, 7], [1, 2, 3]]
    whole = to_pycolmap(replace(model, cam2world=np.tile(np.eye(4), (n, 1, 1))))
    assert coherent_models(whole) == [whole]


def test_frames_that_share_few_points_must_stand_at_depths_that_differ_little():
    doubled = [1.0, 1.0, 1.0, 2.1, 2.1, 2.1]
    weak, strong = (coherent_parts(chain(doubled, shared)) for shared in (30, 60))
    assert [piece.images for piece in weak] == [(1, 2, 3), (4, 5, 6)]
    assert [piece.images for piece in strong] == [(1, 2, 3, 4, 5, 6)]


def test_a_part_is_cut_where_only_the_points_that_two_frames_share_are_in_one_scale():
    """A frame placed on few points, at which the scale was lost: all else that it sees is ten times as far."""
    part = chain([1.0] * 6, shared=20)
    rng = np.random.default_rng(1)
    far = np.column_stack([rng.uniform(3, 5, 90), rng.uniform(0, 1, 90), np.full(90, 10.0)])
    rows = np.arange(len(part.xyz), len(part.xyz) + len(far))
    point_of = {i: np.concatenate([points, rows]) if i > 3 else points for i, points in part.point_of.items()}
    part = Part(part.cam_from_world, point_of, np.concatenate([part.xyz, far]))
    assert [piece.images for piece in coherent_parts(part)] == [(1, 2, 3), (4, 5, 6)]
