"""Navigation in mapping: a path that bends is straightened, and two parts that share no ground become one model."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.scale.conftest import SCALE, Survey, survey_along

from swimm3r.cameras import project
from swimm3r.geometry import align_similarity
from swimm3r.io.colmap.model import ColmapModel, from_pycolmap, to_pycolmap
from swimm3r.progress import silent
from swimm3r.scale.navigation.navigator import NavigationFile
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap import poses
from swimm3r.sfm.colmap.adjustment import bundle_adjust, typical_error
from swimm3r.sfm.colmap.navigated import Prior, adjust_to_positions
from swimm3r.sfm.settings import ColmapSettings

WIDTH, HEIGHT, FOCAL = 320, 240, 260.0
RANGE, EACH, STEP, APART = 4.0, 9, 0.4, 10.0  # metres; frames of a part


def path_error(centers: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square distance after the best similarity, in the unit of `truth`."""
    fit = align_similarity(torch.from_numpy(centers), torch.from_numpy(truth))
    moved = fit.scale.item() * centers @ fit.R.numpy().T + fit.t.numpy()
    return float(np.sqrt(((moved - truth) ** 2).sum(1).mean()))


X = np.arange(60) * 0.4
STRIP = np.stack([X, 0.5 * np.sin(X / 3), 2 + 0.2 * np.cos(X / 2)], -1)


def seen_with_errors(survey: Survey, pixels: float, rng: np.random.Generator) -> Reconstruction:
    """A tenth of a survey's points, the others without tracks, with errors of this standard deviation."""
    tracks = survey.rec.tracks
    seen = torch.bincount(tracks.point, minlength=len(survey.rec.points.xyz)) > 1
    few = (seen & torch.from_numpy(rng.random(len(seen)) < 0.1))[tracks.point]
    xy = tracks.xy[few] + pixels * torch.from_numpy(rng.normal(size=(int(few.sum()), 2))).float()
    return replace(survey.rec, tracks=replace(tracks, point=tracks.point[few], frame=tracks.frame[few], xy=xy))


def adjusted_to(rec: Reconstruction, places: np.ndarray, std: float, **lens: bool) -> ColmapModel:
    """A run after an adjustment with places of its cameras, in its axes and unit, of this standard deviation."""
    priors = {name: Prior(place, np.eye(3) * std**2) for name, place in zip(rec.names, places, strict=True)}
    model = to_pycolmap(rec.colmap_model())
    return from_pycolmap(adjust_to_positions(model, priors, silent, **{"focal": False, "distortion": False} | lens))


def held_to(rec: Reconstruction, survey: Survey, stated: np.ndarray, std: float) -> float:
    """The error of the path after an adjustment with positions of this standard deviation, metres."""
    held = adjusted_to(rec, survey.in_run(stated), std / SCALE)
    return path_error(held.cam2world[:, :3, 3], survey.position)


def test_priors_of_positions_straighten_a_strip_that_bends():
    survey, rng, std = survey_along(STRIP), np.random.default_rng(0), 0.05
    bent = bundle_adjust(seen_with_errors(survey, 1.0, rng))
    stated = survey.position + std * rng.normal(size=STRIP.shape)
    free = path_error(bent.cameras.centers.double().numpy(), survey.position)
    assert held_to(bent, survey, stated, std) < 0.5 * min(free, std * np.sqrt(3))


@pytest.mark.parametrize("pixels", [0.03, 1.0])
def test_typical_errors_are_those_of_points_with_tracks(pixels: float):
    rec = seen_with_errors(survey_along(STRIP), pixels, np.random.default_rng(0))
    model = to_pycolmap(rec.colmap_model())
    model.update_point_3d_errors()
    assert typical_error(model) == pytest.approx(min(1.0, 1.25 * pixels), rel=0.15)


def test_images_count_by_their_own_errors_against_positions():
    """Positions that jump to and fro by 5 cm: images that are exact to 0.03 px know better, those of 1 px do not."""
    survey, std = survey_along(STRIP), 0.05
    jumping = survey.position + std * np.where(np.arange(len(STRIP)) % 2, 1, -1)[:, None] * np.array([0, 0, 1])
    errors = []
    for pixels in (0.03, 1.0):
        rec = seen_with_errors(survey, pixels, np.random.default_rng(0))
        errors.append(held_to(rec, survey, jumping, std))
    assert errors[0] < 0.2 * std
    assert errors[1] > 0.3 * std


def seen_through(params: list[float]) -> Reconstruction:
    """A strip as seen through a lens of OPENCV, with errors of 0.3 px."""
    survey = survey_along(STRIP)
    fx, fy, cx, cy, *distortion = params
    cameras, count = survey.rec.cameras, len(STRIP)
    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64).repeat(count, 1, 1)
    k = torch.tensor(distortion, dtype=torch.float64).repeat(count, 1)
    cameras = replace(cameras, K=K, distortion=k, model="OPENCV")
    tracks, xy = survey.rec.tracks, survey.rec.tracks.xy.clone()
    for i in range(count):
        own = tracks.frame == i
        xy[own] = project(cameras[i], survey.rec.points.xyz[tracks.point[own]][None].double())[0][0].float()
    seen = replace(survey, rec=replace(survey.rec, cameras=cameras, tracks=replace(tracks, xy=xy)))
    return seen_with_errors(seen, 0.3, np.random.default_rng(0))


def test_a_squeezed_lens_stays_squeezed_where_navigation_adjusts_it():
    rec = seen_through([500.0, 500.0 * 4 / 3, 320.0, 240.0, 0.03, 0.0, 0.0, 0.0])
    wrong = replace(rec, cameras=replace(rec.cameras, K=rec.cameras.K * torch.tensor([1.03, 1.03, 1])[:, None]))
    found = adjusted_to(wrong, rec.cameras.centers.numpy(), 0.01, focal=True, distortion=True)
    np.testing.assert_allclose(found.K[0, 0, 0], 500.0, rtol=0.01)
    np.testing.assert_allclose(found.K[:, 1, 1] / found.K[:, 0, 0], 4 / 3, rtol=1e-12)
    assert (found.distortion[:, 1:] == 0).all()
    assert found.distortion[0, 0] != 0.03


def test_a_distortion_that_is_assumed_is_held_where_navigation_adjusts_the_focal_length():
    rec = seen_through([500.0, 500.0, 320.0, 240.0, 0.03, 0.0, 0.0, 0.0])
    found = adjusted_to(rec, rec.cameras.centers.numpy(), 0.01, focal=True, distortion=False)
    assert found.K[0, 0, 0] != 500.0
    assert (found.distortion == [0.03, 0, 0, 0]).all()


def test_a_lens_is_held_where_navigation_makes_none_of_it():
    """Heights that are stated ten times as large fit a lens ten times as long."""
    survey = survey_along(STRIP)
    rec = seen_with_errors(survey, 0.3, np.random.default_rng(0))
    stated = survey.in_run(survey.position * [1, 1, 10])
    found = adjusted_to(rec, stated, 0.001, focal=True, distortion=True)
    np.testing.assert_array_equal(found.K, rec.cameras.K.numpy())
    assert path_error(found.cam2world[:, :3, 3], survey.position) > 0.1


@pytest.fixture(scope="module")
def two_parts(tmp_path_factory) -> tuple[Frames, np.ndarray]:
    """Frames over two stretches of ground with a gap, and the places of the cameras."""
    folder = tmp_path_factory.mktemp("frames")
    rng = np.random.default_rng(0)
    ground = texture(rng, 2400, 800)
    boxes = [(texture(rng, 256, 256), x, rng.uniform(-1.2, 0.4)) for x in np.arange(-2, 17, 0.9)]
    along = np.concatenate([np.arange(EACH) * STEP, APART + np.arange(EACH) * STEP])
    places = np.stack([along, 0.3 * np.sin(along), 0.2 * np.cos(2 * along)], -1)
    frames = []
    for i, place in enumerate(places):
        R = Rotation.from_rotvec([0.05 * np.sin(i), 0.06 * np.cos(1.7 * i), 0.1 * np.sin(0.5 * i)]).as_matrix().T
        P = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]) @ np.c_[R, -R @ place]
        image = np.zeros((HEIGHT, WIDTH), np.uint8)
        for picture, corner, u, v in [
            (ground, (-5.0, -4.0, RANGE), (24 / 2400, 0, 0), (0, 8 / 800, 0)),
            *((box, (x, y, RANGE - 0.9), (0.8 / 256, 0, 0.5 / 256), (0, 0.8 / 256, 0.2 / 256)) for box, x, y in boxes),
        ]:
            H = P @ np.stack([[*u, 0], [*v, 0], [*corner, 1]], 1)
            cover = cv2.warpPerspective(np.full_like(picture, 255), H, (WIDTH, HEIGHT)) > 127
            image = np.where(cover, cv2.warpPerspective(picture, H, (WIDTH, HEIGHT)), image)
        file = folder / f"{i:02d}.png"
        cv2.imwrite(str(file), np.repeat(image[..., None], 3, 2))
        frames.append(Frame(file.name, file, float(i), 1.0, "train"))
    return Frames(tuple(frames), WIDTH, HEIGHT, True), places


def texture(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    total = np.zeros((height, width), np.float32)
    for cells in (8, 16, 32, 64, 128):
        small = rng.random((max(2, cells * height // width), cells), np.float32)
        total += cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    return (255 * (total - total.min()) / np.ptp(total)).astype(np.uint8)


def write_navigation(file: Path, frames: Frames, places: np.ndarray, noise: float, rows: slice = slice(None)) -> Path:
    """Easting, northing and height of the cameras, which look down."""
    metres = places * [1, -1, -1] + noise * np.random.default_rng(1).normal(size=places.shape) + [1000, 2000, -10]
    lines = [f"{n},{e},{m},{h}" for n, (e, m, h) in list(zip(frames.names, metres, strict=True))[rows]]
    file.write_text("\n".join(["image,easting,northing,height", *lines]) + "\n")
    return file


SETTINGS = ColmapSettings(threads=2, focal=FOCAL, k1=0.0, intrinsics="fixed")


def test_navigation_joins_two_parts_that_share_no_ground(two_parts, tmp_path):
    frames, places = two_parts
    alone = poses.reconstruct(frames, SETTINGS, tmp_path / "alone")
    assert len(alone.names) == EACH
    nav = write_navigation(tmp_path / "nav.csv", frames, places, 0.02)
    navigator = NavigationFile(ScaleSettings(nav=nav, crs="local"))
    rec = poses.reconstruct(frames, SETTINGS, tmp_path / "joined", navigator=navigator)
    assert set(rec.names) == set(frames.names)
    order = [frames.names.index(name) for name in rec.names]
    assert path_error(rec.cameras.centers.double().numpy(), places[order]) < 0.03
    told = [warning.what for warning in rec.warnings]
    assert any("Navigation alone holds 9 frames" in what for what in told)
    assert not any("fall into parts" in what for what in told)
    assert not (tmp_path / "joined" / "parts").exists()


@pytest.mark.long
def test_a_part_without_positions_stays_a_model_of_its_own(two_parts, tmp_path):
    frames, places = two_parts
    alone = poses.reconstruct(frames, SETTINGS, tmp_path / "alone")
    first = alone.names[0] == frames.names[0]
    rows = slice(0, EACH + 2) if first else slice(EACH - 2, None)
    nav = write_navigation(tmp_path / "nav.csv", frames, places, 0.02, rows)
    navigator = NavigationFile(ScaleSettings(nav=nav, crs="local"))
    rec = poses.reconstruct(frames, SETTINGS, tmp_path / "out", navigator=navigator)
    assert set(rec.names) == set(alone.names)
    assert any("fall into parts" in warning.what for warning in rec.warnings)
