"""Printed markers in rendered frames: found, placed, and the scale that their sizes and distances give."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tests.scale.conftest import SCALE, Survey, lines, survey_along

from swimm3r.cameras import Cameras
from swimm3r.errors import InputError
from swimm3r.io.images import write_rgb
from swimm3r.medium import srgb_from_linear
from swimm3r.scale.estimate import estimate_scale
from swimm3r.scale.markers import MarkerSizes, detect, find_markers, marker_sizes
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scene.frames import Frames

SIDE = 0.25  # metres
PLACES = {3: (1.0, 0.2, 0.3), 7: (1.9, 0.7, -0.8), 12: (1.2, 0.9, 1.9)}  # x, y and turn of the markers' centers
PER_METRE = 400  # pixels of the printed ground


def ground() -> tuple[np.ndarray, tuple[float, float]]:
    """A gray ground of paper with markers on it, and the place of its corner; the first row is the farthest north."""
    rng = np.random.default_rng(0)
    west, south, east, north = -1.5, -2.0, 4.5, 3.0
    shape = (round((north - south) * PER_METRE), round((east - west) * PER_METRE))
    paper = cv2.GaussianBlur(rng.uniform(60, 190, shape).astype(np.float32), (0, 0), 6)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for marker, (x, y, turn) in PLACES.items():
        printed = np.pad(cv2.aruco.generateImageMarker(dictionary, marker, 240), 40, constant_values=255)
        unit = SIDE * PER_METRE / 240
        cos, sin = unit * np.cos(turn), unit * np.sin(turn)
        to = np.array([[cos, -sin, (x - west) * PER_METRE], [sin, cos, (north - y) * PER_METRE]])
        to[:, 2] -= to[:, :2] @ [159.5, 159.5] + 0.5
        soft = cv2.GaussianBlur(printed, (0, 0), 1.2).astype(np.float32)
        cv2.warpAffine(
            soft, to, shape[::-1], dst=paper, flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_TRANSPARENT,
        )  # fmt: skip
    return paper, (west, north)


def filmed(folder: Path, survey: Survey) -> Frames:
    """Frames of the ground by the survey's cameras, a plane at height 0."""
    paper, (west, north) = ground()
    listed = []
    for i, frame in enumerate(survey.frames):
        corners = np.array([[west, north - 5, 0], [west + 6, north - 5, 0], [west + 6, north, 0], [west, north, 0]])
        camera = survey.rec.cameras[i]
        pose = camera.world2cam[0].numpy()
        at = survey.in_run(corners) @ pose[:3, :3].T + pose[:3, 3]
        K = camera.K[0].numpy()
        ends = (at / at[:, 2:]) @ K.T
        source = np.array([[0, 5], [6, 5], [6, 0], [0, 0]], np.float32) * PER_METRE
        H = cv2.getPerspectiveTransform((source - 0.5).astype(np.float32), (ends[:, :2] - 0.5).astype(np.float32))
        image = cv2.warpPerspective(paper, H, (survey.frames.width, survey.frames.height), flags=cv2.INTER_AREA)
        light = cv2.GaussianBlur(image, (0, 0), 0.7)[..., None].repeat(3, -1) / 255  # blur is the lens's: linear
        write_rgb(folder / frame.name, srgb_from_linear(torch.from_numpy(light)).numpy())
        listed.append(replace(frame, path=folder / frame.name))
    return replace(survey.frames, frames=tuple(listed))


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Survey, Frames]:
    survey = survey_along(lines(count=2, each=6, step=0.45))
    return survey, filmed(tmp_path_factory.mktemp("markers"), survey)


def solved(dive: tuple[Survey, Frames], **options):
    return estimate_scale(dive[0].rec, dive[1], ScaleSettings(**options))


def test_markers_give_the_scale_within_three_in_a_thousand(dive):
    found = solved(dive, markers="aruco-4x4-50", marker_size=SIDE)
    assert found.solution.scale == pytest.approx(SCALE, rel=0.003)
    assert abs(np.log(found.solution.scale / SCALE)) < 4 * found.solution.std
    assert [each.estimate.source for each in found.solution.sources] == ["marker 3", "marker 7", "marker 12"]


def test_distances_between_markers_are_worth_more(dive, tmp_path):
    length = float(np.hypot(*(np.array(PLACES[3][:2]) - PLACES[7][:2])))
    (tmp_path / "m.yaml").write_text(f"family: aruco-4x4-50\ndistances: [[3, 7, {length}]]\n")
    found = solved(dive, marker_file=tmp_path / "m.yaml").solution
    assert found.scale == pytest.approx(SCALE, rel=0.002)
    by_size = solved(dive, markers="aruco-4x4-50", marker_size=SIDE).solution
    assert found.sources[0].estimate.std < by_size.sources[0].estimate.std


def test_a_marker_of_another_size_is_named_an_outlier(dive, tmp_path):
    (tmp_path / "m.yaml").write_text("family: aruco-4x4-50\nsize: 0.25\nsizes: {7: 0.30}\n")
    found = solved(dive, marker_file=tmp_path / "m.yaml").solution
    assert [each.estimate.source for each in found.outliers] == ["marker 7"]
    assert found.scale == pytest.approx(SCALE, rel=0.003)


def test_an_id_that_no_frame_shows_is_named_with_those_that_are(dive, tmp_path):
    (tmp_path / "m.yaml").write_text("family: aruco-4x4-50\nsize: 0.25\ndistances: [[3, 8, 1.0]]\n")
    with pytest.raises(InputError, match="marker 8 of") as told:
        solved(dive, marker_file=tmp_path / "m.yaml")
    assert "3, 7, 12" in told.value.what


def test_another_family_finds_nothing_and_says_so(dive):
    with pytest.raises(InputError, match="no marker of apriltag-25h9"):
        solved(dive, markers="apriltag-25h9", marker_size=SIDE)


def test_a_marker_that_moved_is_left_out_with_a_note(dive):
    survey, frames = dive
    sizes = MarkerSizes("aruco-4x4-50", SIDE)
    found = find_markers(survey.rec, frames, sizes.family, sizes.board)
    found[7] = [[replace(s, xy=(s.xy[0] + 40 * (s.frame % 2), s.xy[1])) for s in corner] for corner in found[7]]
    from swimm3r.scale.markers import marker_estimates

    estimates, notes = marker_estimates(survey.rec, found, sizes, ScaleSettings(), 0.3)
    assert [each.source for each in estimates] == ["marker 3", "marker 12"]
    assert any("Marker 7" in note and "contradict" in note for note in notes)


@pytest.mark.parametrize(("side", "blur"), [(20.0, 0.5), (40.0, 0.5), (40.0, 1.2), (80.0, 0.5), (80.0, 1.2)])
def test_corners_are_found_at_their_place_however_blurred(side, blur):
    rng = np.random.default_rng(0)
    finer, size = 8, 160
    K = torch.tensor([[200.0, 0, size / 2], [0, 200, size / 2], [0, 0, 1]]).double()
    camera = Cameras(K[None], torch.zeros(1, 0), torch.eye(4).double()[None], size, size)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    printed = np.pad(cv2.aruco.generateImageMarker(dictionary, 7, 600), 100, constant_values=255).astype(np.float32)
    off = []
    for turn in np.linspace(0, 6, 12):
        center = 80 + rng.uniform(-2, 2, 2)
        A = side * finer / 600 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        t = center * finer - A @ [400, 400] + A @ [0.5, 0.5] - 0.5
        image = cv2.warpAffine(printed, np.c_[A, t], (size * finer, size * finer), borderValue=150.0)
        image = cv2.GaussianBlur(image.reshape(size, finer, size, finer).mean((1, 3)), (0, 0), blur)
        image = (0.6 * image + 40 + rng.normal(0, 1.5, image.shape)).clip(0, 255).astype(np.uint8)
        square = np.array([[-300.0, -300], [300, -300], [300, 300], [-300, 300]]) @ A.T / finer + center
        off.append(detect(image / 255, camera, "aruco-4x4-50")[7] - square)
    off = np.stack(off)
    assert np.abs(off.mean((0, 1))).max() < 0.02  # and 0.5 where the corner of the image was mistaken
    assert off.std() < 0.05


def test_a_board_gives_the_scale(dive, tmp_path):
    survey, _ = dive
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((6, 5), 0.1, 0.075, dictionary)
    printed = board.generateImage((600, 500), marginSize=0)
    listed = []
    for i, frame in enumerate(survey.frames):
        pose, K = survey.rec.cameras[i].world2cam[0].numpy(), survey.rec.cameras[i].K[0].numpy()
        corners = np.array([[1.0, 0.9, 0], [1.6, 0.9, 0], [1.6, 0.4, 0], [1.0, 0.4, 0]])
        at = survey.in_run(corners) @ pose[:3, :3].T + pose[:3, 3]
        ends = ((at / at[:, 2:]) @ K.T)[:, :2].astype(np.float32) - 0.5
        source = np.array([[0, 0], [600, 0], [600, 500], [0, 500]], np.float32) - 0.5
        H = cv2.getPerspectiveTransform(source, ends.astype(np.float32))
        image = cv2.warpPerspective(printed, H, (640, 480), flags=cv2.INTER_AREA, borderValue=128)
        write_rgb(tmp_path / frame.name, np.repeat(cv2.GaussianBlur(image, (0, 0), 0.7)[..., None] / 255.0, 3, -1))
        listed.append(replace(frame, path=tmp_path / frame.name))
    frames = replace(survey.frames, frames=tuple(listed))
    (tmp_path / "m.yaml").write_text("family: aruco-4x4-50\nboard: {columns: 6, rows: 5, square: 0.1, marker: 0.075}\n")
    found = solved((survey, frames), marker_file=tmp_path / "m.yaml").solution
    assert found.scale == pytest.approx(SCALE, rel=0.003)
    assert found.sources[0].estimate.source == "board"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("family: aruco-4x4-50\n", "no size, no distance"),
        ("family: aruco\nsize: 0.1\n", "family"),
        ("family: aruco-4x4-50\nsize: -1\n", "positive"),
        ("- 1\n", "family and sizes are expected"),
        ("family: [\n", "no YAML"),
        ("family: aruco-4x4-50\nboard: {columns: 6, rows: 5, square: 0.1, marker: 0.2}\n", "smaller than its squares"),
    ],
)
def test_a_marker_file_that_cannot_be_used_is_refused(tmp_path, text, said):
    (tmp_path / "m.yaml").write_text(text)
    with pytest.raises(InputError, match=said):
        marker_sizes(ScaleSettings(marker_file=tmp_path / "m.yaml"))


def test_without_markers_there_is_nothing_to_look_for():
    assert marker_sizes(ScaleSettings()) is None
