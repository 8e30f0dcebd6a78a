"""Both maps seen by one camera: in the axes of each run, in the light of the first visit, at the largest places."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tests.visits.conftest import Visits

from swimm3r.cameras import Cameras
from swimm3r.geometry import so3_exp
from swimm3r.products.survey import Survey, open_survey
from swimm3r.progress import silent
from swimm3r.scene.run_folder import MARKERS
from swimm3r.sim3 import Sim3
from swimm3r.splat.training_poses import RefinedPoses
from swimm3r.visits import renders
from swimm3r.visits.alignment.joint import moved
from swimm3r.visits.places import Place
from swimm3r.visits.renders import Mapped, rendered_views

TURN = so3_exp(torch.tensor([[0.3, -0.5, 0.2]], dtype=torch.float64))[0].numpy()
FIRST_FROM_LATER = Sim3(2.5, TURN, np.array([0.3, -0.2, 0.4]))
GAINS = np.array([0.5, 1.0, 0.25])


class Scene:
    """A map whose pixels are the camera's center and direction in the axes of the first visit, brought into 0..1."""

    span = (0.0, 0.0)

    def __init__(self, first_from_map: Sim3, poses: RefinedPoses | None = None) -> None:
        self.first_from_map, self.poses = first_from_map, poses

    def render(self, camera: Cameras, time: float, *, backscatter: bool, observed: bool) -> SimpleNamespace:
        pose = camera.cam2world[0].double().numpy()
        center, ahead = self.first_from_map(pose[:3, 3]), self.first_from_map.R @ pose[:3, 2]
        seen = np.tile(np.stack([center, ahead]) / 8 + 0.5, (camera.height // 2, 1))
        image = np.repeat(seen[:, None], camera.width, 1)
        return SimpleNamespace(clear=torch.from_numpy(image))


@pytest.fixture
def survey(visits: Visits) -> Survey:
    return open_survey(visits.first)


def place_at(survey: Survey, frame: int, number: int = 1) -> Place:
    """A changed place in the middle of a frame's view."""
    x, y = np.median(survey.overview[frame][:, :2], axis=0) + np.array(survey.place.origin[:2])
    rest = dict.fromkeys(("height", "height_std", "volume", "volume_std", "color"))
    tint = dict.fromkeys(("lightness", "red_green", "yellow_blue"))
    return Place(number, "gained", float(x), float(y), 0.1, significance=5.0, **rest, **tint)


def mapped(survey: Survey, folder: Path, monkeypatch: pytest.MonkeyPatch, poses: bool = False) -> tuple[Mapped, Mapped]:
    """Two runs of one site with maps, the later one in axes of its own."""
    own = moved(survey.rec, FIRST_FROM_LATER.inverse())
    later = FIRST_FROM_LATER
    refined = None
    if poses:  # training has turned the later map as a whole
        turned = Sim3(1.0, TURN, np.zeros(3))
        refined = RefinedPoses(own.names, moved(own, turned).cameras.cam2world)
        later = FIRST_FROM_LATER.after(turned.inverse())
    scenes = {"a": Scene(Sim3(1.0, np.eye(3), np.zeros(3))), "b": Scene(later, refined)}
    for name in scenes:
        (folder / name / MARKERS["splat"]).parent.mkdir(parents=True)
        (folder / name / MARKERS["splat"]).touch()
    monkeypatch.setattr(renders, "load_map", lambda path: scenes[Path(path).relative_to(folder).parts[0]])
    still = Sim3(1.0, np.eye(3), np.zeros(3))
    return Mapped(folder / "a", survey.rec, still, np.ones(3)), Mapped(folder / "b", own, FIRST_FROM_LATER, GAINS)


@pytest.mark.parametrize("poses", [False, True])
def test_both_maps_are_seen_by_one_camera_in_one_light(
    survey: Survey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, poses: bool
):
    runs = mapped(survey, tmp_path, monkeypatch, poses)
    ((caption, first, later),) = rendered_views(survey, runs, [place_at(survey, 2)], silent)
    assert survey.rec.names[2] in caption
    linear = [np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4) for v in (first / 255, later / 255)]
    assert linear[1] == pytest.approx(linear[0] * GAINS, abs=0.01)
    center = survey.rec.cameras.cam2world[2, :3, 3].numpy() / 8 + 0.5
    assert first[0, 0] / 255 == pytest.approx(np.clip(center, 0, 1), abs=0.005)


def test_views_are_of_the_largest_places_and_each_frame_once(
    survey: Survey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    runs = mapped(survey, tmp_path, monkeypatch)
    places = [place_at(survey, frame, k) for k, frame in enumerate((5, 5, 1, 3, 0))]
    captions = [caption for caption, _, _ in rendered_views(survey, runs, places, silent)]
    assert [caption.split()[-1] for caption in captions] == [survey.rec.names[i] for i in (5, 1, 3)]


def test_runs_without_a_map_and_ground_without_a_change_have_no_views(
    survey: Survey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    runs = mapped(survey, tmp_path, monkeypatch)
    assert rendered_views(survey, runs, [], silent) == []
    without = replace(runs[1], run=tmp_path / "elsewhere")
    assert rendered_views(survey, (runs[0], without), [place_at(survey, 1)], silent) == []
