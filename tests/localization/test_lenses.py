"""Images that were taken through one of several lenses, as the cameras of a rig have, are placed through their own."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tests.localization.textured_plane import FEATURES, camera, filmed, photo, texture

from swimm3r.cameras import Cameras, resized
from swimm3r.errors import InputError, RegistrationError, UsageError
from swimm3r.geometry import rotation_angle
from swimm3r.io.images import write_rgb
from swimm3r.localization.batch import Query, answer
from swimm3r.localization.lenses import lens_at_size, lens_of_camera
from swimm3r.localization.localizer import Localizer
from swimm3r.localization.online.landmark_map import landmark_map
from swimm3r.localization.online.stream import localize_stream
from swimm3r.localization.online.tracker import Tracker
from swimm3r.localization.settings import LocalizationSettings
from swimm3r.scene.rig import Rig, RigCamera
from swimm3r.sfm.features.settings import FeatureSettings

SETTINGS = LocalizationSettings(matcher="sift", candidates=3, features=FeatureSettings(count=800))
SIDES = ("left", "right")
FOCAL = {"left": 260.0, "right": 340.0}
FOCAL_OF_PLANE = {"left": 440.0, "right": 560.0}


def through(cameras: Cameras, focals: list[float]) -> Cameras:
    K = cameras.K.clone()
    K[:, 0, 0] = K[:, 1, 1] = torch.tensor(focals, dtype=K.dtype)
    return replace(cameras, K=K)


@pytest.fixture(scope="module")
def rig(place, tmp_path_factory: pytest.TempPathFactory):
    """The place filmed by two cameras in turn; the frames of its map are one of the left and three of the right."""
    folder = tmp_path_factory.mktemp("rig")
    cameras = through(place.cameras, [FOCAL[SIDES[i % 2]] for i in range(6)])
    listed = []
    for i, frame in enumerate(place.frames):
        path = folder / frame.name
        write_rgb(path, place.scene.render(cameras[i]).rgb.numpy())
        listed.append(replace(frame, path=path, camera=SIDES[i % 2], instant=i // 2))
    frames = replace(place.frames, frames=tuple(listed), rig=Rig((RigCamera("left"), RigCamera("right"))))
    return Localizer(place.scene, replace(place.rec, cameras=cameras[[0, 1, 3, 5]]), frames, SETTINGS), cameras


def check_pose(found: torch.Tensor, truth: torch.Tensor) -> None:
    assert float(torch.rad2deg(rotation_angle(found[:3, :3].double().mT @ truth[:3, :3]))) < 0.1
    assert float((found[:3, 3] - truth[:3, 3]).norm()) < 0.005


def test_an_image_of_a_rig_of_several_lenses_is_placed_through_the_one_that_is_named(rig):
    localizer, cameras = rig
    image = localizer.frames.image(4)
    found = localizer.locate(image, lens=lens_of_camera(localizer.rec, localizer.frames, "left"))
    assert localizer.frames.frames[localizer.frames.index(found.candidates[0])].camera == "right"
    check_pose(found.cam2world, cameras.cam2world[4])
    with pytest.raises(InputError, match="which of them took the image"):
        localizer.locate(image)


def test_a_frame_of_the_clip_is_placed_through_the_lens_of_its_own_camera(rig):
    localizer, cameras = rig
    frames, name = localizer.frames, localizer.frames.names[4]
    found = answer(localizer, Query(name, 0.8, frames.image(4), frame=name)).found
    assert found is not None
    check_pose(found.cam2world, cameras.cam2world[4])
    lost = replace(frames, frames=tuple(replace(f, camera="third" if f.name == name else f.camera) for f in frames))
    other = Localizer(localizer.scene, localizer.rec, lost, SETTINGS)
    with pytest.raises(RegistrationError, match="lens is not known"):
        other.locate(frames.image(4), frame=name)


def test_a_given_lens_is_taken_at_the_images_size_and_another_shape_is_refused(place, rig):
    localizer, cameras = rig
    larger = resized(cameras[4], 480, 360)
    check_pose(localizer.locate(localizer.frames.image(4), lens=larger).cam2world, cameras.cam2world[4])
    with pytest.raises(InputError, match="240 x 180"):
        localizer.locate(localizer.frames.image(4), lens=resized(cameras[4], 240, 240))


def test_a_camera_of_the_rig_lends_its_lens_by_its_name(rig):
    localizer, cameras = rig
    for k, name in enumerate(SIDES):
        lens = lens_of_camera(localizer.rec, localizer.frames, name)
        torch.testing.assert_close(lens.K, cameras[k].K)
    with pytest.raises(UsageError, match="left, right"):
        lens_of_camera(localizer.rec, localizer.frames, "middle")
    with pytest.raises(UsageError, match="no rig"):
        lens_of_camera(localizer.rec, replace(localizer.frames, rig=None), "left")


def test_a_lens_of_another_shape_than_the_image_is_refused(place, tmp_path: Path):
    assert lens_at_size(place.cameras[0], 120, 90).K[0, 0, 0] == place.cameras.K[0, 0, 0] / 2
    with pytest.raises(InputError, match="its lens is of images of 240 x 180"):
        lens_at_size(place.cameras[0], 180, 240)


def seen_through(side: str, x: float) -> tuple[Cameras, torch.Tensor]:
    one = through(camera(x), [FOCAL_OF_PLANE[side]])
    return one, photo(one, texture())


def test_a_stream_of_a_camera_of_a_rig_is_tracked_through_the_lens_that_is_named(tmp_path: Path):
    places = [-0.6, -0.3, 0.0, 0.3, 0.6]
    rec, frames = filmed(tmp_path, [seen_through(SIDES[i % 2], x)[0] for i, x in enumerate(places)])
    listed = (replace(f, camera=SIDES[i % 2], instant=i) for i, f in enumerate(frames))
    frames = replace(frames, frames=tuple(listed), rig=Rig((RigCamera("left"), RigCamera("right"))))
    tracker = Tracker(landmark_map(rec, frames, FEATURES))
    truth, image = seen_through("right", -0.45)
    found = tracker.locate(tracker.describe(image, lens=lens_of_camera(rec, frames, "right")), 0.0)
    assert found.cam2world is not None
    assert float((found.cam2world[:3, 3] - truth.cam2world[0, :3, 3]).norm()) < 0.01  # of a plane 2 away
    with pytest.raises(InputError, match="which of them took the image"):
        tracker.describe(image)
    with pytest.raises(InputError, match="which of them took the image"):
        localize_stream(tracker, iter([]), tmp_path)
    assert not (tmp_path / "stream.jsonl").exists()
