"""Rigs whose cameras have different lenses: a synthetic pair, the right images enlarged about their center."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from swimm3r.cameras import Cameras, project
from swimm3r.errors import InputError
from swimm3r.evaluate.poses import absolute_pose_errors
from swimm3r.io import images
from swimm3r.prepare import load_frames, read_frames
from swimm3r.scene.frames import Frames
from swimm3r.scene.ground_truth import read_ground_truth
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.rig import Rig
from swimm3r.scene.settings import FrameSettings
from swimm3r.sfm.colmap import poses
from swimm3r.sfm.colmap.calibration.start import first_camera
from swimm3r.sfm.colmap.rig.adjustment import as_rig
from swimm3r.sfm.colmap.rig.lenses import RigLenses, lenses_of_rig
from swimm3r.sfm.features.sift import Features
from swimm3r.sfm.lens import with_calibration
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.synthetic.dive import write_dive
from swimm3r.synthetic.settings import DiveSettings

WIDTH, HEIGHT, TIMES = 240, 160, 1.25
DIVE = DiveSettings(frames=8, width=WIDTH, height=HEIGHT, stereo=0.1)


def matrix(values: np.ndarray) -> str:
    return "[" + ", ".join(f"[{', '.join(f'{x:.12g}' for x in row)}]" for row in values) + "]"


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> tuple[Frames, torch.Tensor]:
    """Frames of a calibrated pair whose right camera has the longer lens, and the true cam2world of the frames."""
    folder = tmp_path_factory.mktemp("pair")
    write_dive(DIVE, folder / "dive")
    truth = read_ground_truth(folder / "dive" / "truth")
    shutil.copytree(folder / "dive" / "images", folder / "images")
    shift = np.array([(1 - TIMES) * (WIDTH / 2 - 0.5), (1 - TIMES) * (HEIGHT / 2 - 0.5)])
    enlarge = np.column_stack([TIMES * np.eye(2), shift])
    for path in sorted((folder / "images" / "right").iterdir()):
        images.write_rgb(path, cv2.warpAffine(images.read_rgb(path), enlarge, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC))
    K = truth.cameras.K[0].numpy() - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    longer = K * np.array([[TIMES, 1, 1], [1, TIMES, 1], [1, 1, 1]])
    pose = (torch.linalg.inv(truth.cameras.cam2world[1]) @ truth.cameras.cam2world[0]).numpy()
    text = f"M1: {matrix(K)}\nD1: [0, 0, 0, 0, 0]\nM2: {matrix(longer)}\nD2: [0, 0, 0, 0, 0]\n"
    (folder / "stereo.yml").write_text(text + f"R: {matrix(pose[:3, :3])}\nT: {matrix(pose[:3, 3:])}\n")
    settings = FrameSettings(rig_calibration=folder / "stereo.yml")
    found = read_frames(folder / "images", settings, folder=folder / "prepared").train
    cam2world = truth.cameras.cam2world[[truth.names.index(name) for name in found.names]]
    return found, cam2world


@pytest.fixture(scope="module")
def placed(frames: tuple[Frames, torch.Tensor], tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    return poses.reconstruct(frames[0], ColmapSettings(), tmp_path_factory.mktemp("sfm"))


def own_focal(rec: Reconstruction, side: str) -> float:
    rows = [i for i, name in enumerate(rec.names) if name.startswith(side)]
    return float(rec.cameras.K[rows[0], 0, 0])


def test_every_camera_of_a_rig_is_placed_with_its_own_lens(placed: Reconstruction):
    assert len(placed.names) == 2 * (DIVE.frames - 1)  # one instant is held back
    assert own_focal(placed, "right") / own_focal(placed, "left") == pytest.approx(TIMES, rel=1e-6)


def test_tracks_are_in_the_pixels_of_the_images(placed: Reconstruction):
    for row, name in enumerate(placed.names):
        seen = placed.tracks.frame == row
        xy, _ = project(placed.cameras[row], placed.points.xyz[placed.tracks.point[seen]][None].double())
        error = torch.linalg.vector_norm(xy[0] - placed.tracks.xy[seen], dim=1)
        assert float(error.median()) < 0.4, name


def test_the_rig_refines_each_lens_and_finds_the_path(frames: tuple[Frames, torch.Tensor], placed: Reconstruction):
    rec = as_rig(placed, frames[0], ColmapSettings())
    assert rec.rig is not None
    assert rec.rig.rigid
    assert own_focal(rec, "right") / own_focal(rec, "left") == pytest.approx(TIMES, rel=0.01)
    ate = absolute_pose_errors(rec.cameras.cam2world, frames[1]).ate
    assert isinstance(ate, float)
    assert ate < 0.01


def test_cameras_of_one_lens_keep_their_pixels(frames: tuple[Frames, torch.Tensor]):
    both, _ = frames
    assert both.rig is not None
    left, right = both.rig.cameras
    settings = with_calibration(ColmapSettings(), WIDTH, HEIGHT, both.calibration)
    first = first_camera(WIDTH, HEIGHT, settings)
    assert lenses_of_rig(both, ColmapSettings(), first) is not None
    assert (
        lenses_of_rig(replace(both, rig=Rig((left, replace(right, lens=left.lens)))), ColmapSettings(), first) is None
    )


def test_keypoints_whose_rays_the_first_lens_does_not_have_are_left_out():
    origin = torch.eye(4, dtype=torch.float64)[None]
    K = torch.tensor([[[200.0, 0, 120], [0, 200, 80], [0, 0, 1]]], dtype=torch.float64)
    wide = torch.tensor([[[100.0, 0, 120], [0, 100, 80], [0, 0, 1]]], dtype=torch.float64)
    barrel = torch.tensor([[-0.6, 0.0, 0.0, 0.0]], dtype=torch.float64)  # has its image's edge at 0.75 of z = 1
    first = Cameras(K, barrel, origin, WIDTH, HEIGHT, "OPENCV")
    second = Cameras(wide, torch.zeros_like(barrel), origin, WIDTH, HEIGHT, "OPENCV")
    keypoints = np.array([[120, 80, 2, 0], [150, 90, 3, 1], [239, 159, 4, 2]], np.float32)
    found = Features(keypoints, np.arange(3 * 128, dtype=np.uint8).reshape(3, 128))
    moved = RigLenses((first, second), (0, 1)).under_first(1, found)
    np.testing.assert_allclose(moved.keypoints[:, 2:], keypoints[:2, 2:])
    np.testing.assert_allclose(moved.keypoints[0, :2], [120, 80], atol=1e-5)  # both look straight ahead there
    np.testing.assert_array_equal(moved.descriptors, found.descriptors[:2])
    assert RigLenses((first, second), (0, 1)).under_first(0, found) is found


@pytest.mark.parametrize("given", [ColmapSettings(focal=225.0), ColmapSettings(housing="flat")], ids=["focal", "port"])
def test_a_lens_or_a_port_that_the_settings_give_is_that_of_all_cameras(
    frames: tuple[Frames, torch.Tensor], given: ColmapSettings
):
    first = first_camera(WIDTH, HEIGHT, given)
    assert lenses_of_rig(frames[0], given, first) is None


def test_without_the_lens_of_the_first_camera_that_of_another_is_not_used(frames: tuple[Frames, torch.Tensor]):
    first = first_camera(WIDTH, HEIGHT, ColmapSettings())
    assert lenses_of_rig(replace(frames[0], calibration=None), ColmapSettings(), first) is None


def test_the_rig_of_a_run_made_before_lenses_were_kept_is_read(frames: tuple[Frames, torch.Tensor], tmp_path: Path):
    assert frames[0].calibration is not None
    shutil.copytree(frames[0].calibration.parent, tmp_path / "prepare")
    index = tmp_path / "prepare" / "frames.json"
    document = json.loads(index.read_text())
    assert [camera.pop("lens") is not None for camera in document["rig"]["cameras"]] == [True, True]
    index.write_text(json.dumps(document))
    rig = load_frames(tmp_path / "prepare").train.rig
    assert rig is not None
    assert [camera.lens for camera in rig.cameras] == [None, None]


def test_a_fisheye_lens_beside_another_kind_is_refused(frames: tuple[Frames, torch.Tensor]):
    both, _ = frames
    assert both.rig is not None
    left, right = both.rig.cameras
    fisheye = f"1 OPENCV_FISHEYE {WIDTH} {HEIGHT} 150 150 {WIDTH / 2} {HEIGHT / 2} 0 0 0 0"
    first = first_camera(WIDTH, HEIGHT, ColmapSettings(focal=225.0))
    with pytest.raises(InputError, match="fisheye"):
        lenses_of_rig(replace(both, rig=Rig((left, replace(right, lens=fisheye)))), ColmapSettings(), first)
