"""The family of a clip's lens, from exact observations of known lenses with noise, and from halves of the frames."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from swimm3r.progress import silent
from swimm3r.sfm.colmap.calibration import refinement
from swimm3r.sfm.colmap.calibration.hypotheses import (
    Kept,
    LensFamily,
    family_of,
    fitted,
    held_out_errors,
    likeliest,
    squeezed_like,
)
from swimm3r.sfm.colmap.calibration.refinement import adjust_lens, refine, refine_again
from swimm3r.sfm.features.database import FeatureDatabase
from swimm3r.sfm.settings import ColmapSettings

SIZE = 640, 480
K1 = 3  # of SIMPLE_RADIAL's parameters
K2 = 5  # of OPENCV's
SQUARE, FREE = LensFamily("SIMPLE_RADIAL"), LensFamily("OPENCV")
LENSES = {
    SQUARE: ("SIMPLE_RADIAL", [500.0, 320.0, 240.0, 0.06]),
    LensFamily("SIMPLE_RADIAL", 3 / 4): ("OPENCV", [600.0, 450.0, 320.0, 240.0, 0.06, 0.0, 0.0, 0.0]),
    LensFamily("SIMPLE_RADIAL", 4 / 3): ("OPENCV", [450.0, 600.0, 320.0, 240.0, 0.06, 0.0, 0.0, 0.0]),
    FREE: ("OPENCV", [500.0, 505.0, 320.0, 240.0, 0.06, 0.02, 0.01, -0.02]),
}


def seen_through(family: LensFamily, folder: Path) -> tuple[FeatureDatabase, pycolmap.Reconstruction]:
    """Twelve frames of 300 points, placed under a square lens that is 15 % too long; keypoints are off by 0.3 px."""
    name, params = LENSES[family]
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 12, 300
    options.camera_width, options.camera_height = SIZE
    options.camera_model_id, options.camera_params = getattr(pycolmap.CameraModelId, name), params
    pycolmap.set_random_seed(3)
    database = pycolmap.Database.open(str(folder / "database.db"))
    model = pycolmap.synthesize_dataset(options, database)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.3
    pycolmap.synthesize_noise(noise, model, database)
    database.close()
    camera = model.cameras[1]
    camera.model, camera.params = pycolmap.CameraModelId.SIMPLE_RADIAL, [1.15 * params[0], 320.0, 240.0, 0.0]
    return FeatureDatabase(folder / "database.db", 12), model


@pytest.mark.parametrize("family", LENSES, ids=str)
def test_a_lens_is_refined_in_the_family_that_it_is_of(tmp_path: Path, family: LensFamily):
    store, model = seen_through(family, tmp_path)
    found = refine(store, model, ColmapSettings(), silent)
    camera, (name, params) = found.model.cameras[1], LENSES[family]
    assert found.refined
    assert family_of(camera) == family
    assert camera.model.name == name
    known = [i for i in range(len(params)) if i != K2]  # the points hardly tell it from k1
    np.testing.assert_allclose(camera.params[known], np.array(params)[known], rtol=0.003, atol=0.015)
    assert (camera.width, camera.height) == SIZE
    assert found.model.compute_mean_reprojection_error() < 0.45
    with store.open() as database:
        assert database.read_camera(1).params.tolist() == camera.params.tolist()


def test_a_squeezed_lens_stays_squeezed_in_every_further_adjustment(tmp_path: Path):
    family = LensFamily("SIMPLE_RADIAL", 3 / 4)
    store, model = seen_through(family, tmp_path)
    once = refine(store, model, ColmapSettings(), silent).model
    for again in (
        refine(store, once, ColmapSettings(), silent).model,
        adjust_lens(store, once, ColmapSettings(), silent),
    ):
        assert family_of(again.cameras[1]) == family
        np.testing.assert_allclose(again.cameras[1].params, once.cameras[1].params, rtol=3e-3, atol=3e-3)


def test_a_distortion_that_gives_no_lens_is_held_in_every_further_adjustment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    store, model = seen_through(SQUARE, tmp_path)
    assumed = 0.03
    model.cameras[1].params = [*model.cameras[1].params[:K1], assumed]
    with monkeypatch.context() as no_distortion:
        no_distortion.setattr(refinement, "is_lens", lambda camera: bool(camera.params[K1] == assumed))
        once = refine(store, model, ColmapSettings(), silent)
    assert (once.refined, once.distortion) == (True, False)
    again = refine_again(store, once, silent)
    assert again.model.cameras[1].params[K1] == assumed
    assert (again.refined, again.distortion) == (True, False)
    free = refine_again(store, replace(once, distortion=True), silent)
    assert free.model.cameras[1].params[K1] > 0.04  # toward 0.06, its own


def test_an_adjustment_in_stretched_pixels_leaves_the_observations_and_the_database_as_they_were(tmp_path: Path):
    store, model = seen_through(SQUARE, tmp_path)
    with store.open() as database:
        before = database.read_keypoints(1)
    found = fitted(store, model, LensFamily("SIMPLE_RADIAL", 4 / 3), lambda _, stretched: stretched)
    with store.open() as database:
        np.testing.assert_array_equal(database.read_keypoints(1), before)
    own, same = model.images[1].points2D, found.images[1].points2D
    np.testing.assert_array_equal([point.xy for point in own], [point.xy for point in same])


def test_lenses_that_lose_observations_are_judged_by_the_limit_of_4_pixels():
    keeps_all = [Kept(100, 1.0), Kept(50, 0.4)]
    keeps_few = [Kept(10, 0.1), Kept(50, 0.4)]
    nothing = [Kept(0, 0.0), Kept(0, 0.0)]
    errors = held_out_errors([keeps_all, keeps_few, nothing])
    assert errors == pytest.approx([(100 + 20) / 150, (1 + 360 + 20) / 150, 4.0])
    assert held_out_errors([nothing, nothing]) == [0.0, 0.0]


def test_a_later_family_must_be_clearly_better_where_frames_were_not_seen(tmp_path: Path):
    store, model = seen_through(SQUARE, tmp_path)
    assert likeliest(store, model, [SQUARE, FREE], 0.03, silent) == SQUARE
    assert likeliest(store, model, [FREE, SQUARE], 0.03, silent) == FREE


@pytest.mark.parametrize(("ratio", "shapes"), [(0.71, [3 / 4]), (0.9, []), (1.0, []), (1.1, []), (1.4, [4 / 3])])
def test_squeezes_are_asked_for_where_a_free_lens_is_nearer_to_them_than_to_squares(ratio: float, shapes: list[float]):
    camera = pycolmap.Camera(model="OPENCV", width=640, height=480, params=[500, 500 * ratio, 320, 240, 0, 0, 0, 0])
    assert squeezed_like(camera, "SIMPLE_RADIAL") == [LensFamily("SIMPLE_RADIAL", shape) for shape in shapes]
    assert str(LensFamily("SIMPLE_RADIAL", 4 / 3)) == "SIMPLE_RADIAL in pixels of 1.33:1"
