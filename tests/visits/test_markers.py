"""Corners of coded markers as points that visits share."""

import numpy as np
import pytest
import torch
from tests.visits.conftest import HEIGHT, WIDTH, Visits

from swimm3r.cameras import project
from swimm3r.products.survey import Survey
from swimm3r.progress import silent
from swimm3r.scale.triangulation import Sighting
from swimm3r.visits.alignment import markers
from swimm3r.visits.alignment.markers import Corners, match_markers, with_markers

FAMILY = "aruco-4x4-50"


def sightings(survey: Survey, ids: tuple[int, ...]) -> dict[int, list[list[Sighting]]]:
    """Pixels of the corners of markers in every frame: 10 cm squares on the ground at places that the id tells."""
    found = {}
    for marker in ids:
        corner = np.array([0.1 + 0.15 * marker, 0.4])
        square = corner + np.array([[0.0, 0], [0.1, 0], [0.1, 0.1], [0, 0.1]])
        local = np.column_stack([square, np.zeros(4)])
        xyz = torch.from_numpy(survey.place.from_local(local))
        pixels, z = project(survey.rec.cameras, xyz.expand(len(survey.rec.names), -1, -1))
        inside = (z > 0) & (pixels > 0).all(-1) & (pixels < torch.tensor([WIDTH, HEIGHT])).all(-1)
        found[marker] = [
            [Sighting(i, tuple(pixels[i, k].tolist())) for i in torch.nonzero(inside[:, k])[:, 0].tolist()]
            for k in range(4)
        ]
    return found


def test_corners_become_points_where_the_frames_see_them(visits: Visits, monkeypatch: pytest.MonkeyPatch):
    survey, _ = visits.surveys()
    seen = sightings(survey, (1, 3))
    monkeypatch.setattr(markers, "find_markers", lambda *_, **__: seen)
    marked, corners, notes = with_markers(survey, FAMILY, silent)
    assert notes == []
    assert set(corners.point) == {(marker, k) for marker in (1, 3) for k in range(4)}
    local = survey.place.to_local(marked.rec.points.xyz[corners.point[3, 1]].numpy())
    assert local == pytest.approx([0.65, 0.4, 0.0], abs=1e-4)
    observed = int((marked.rec.tracks.point == corners.point[3, 1]).sum())
    assert observed == len(seen[3][1])
    assert torch.equal(marked.rec.points.xyz[: len(survey.rec.points.xyz)], survey.rec.points.xyz)


def test_markers_of_both_visits_are_matched_by_their_codes():
    one = Corners({(1, 0): 5, (2, 0): 6}, {(1, 0): 0, (2, 0): 1}, {(1, 0): (1.0, 2.0), (2, 0): (3.0, 4.0)})
    other = Corners({(2, 0): 9, (7, 0): 8}, {(2, 0): 3, (7, 0): 3}, {(2, 0): (5.0, 6.0), (7, 0): (7.0, 8.0)})
    found = match_markers(one, other)
    assert (found.point_a.tolist(), found.point_b.tolist()) == ([6], [9])
    assert (found.frame_a.tolist(), found.frame_b.tolist()) == ([1], [3])
    assert (found.xy_a.tolist(), found.xy_b.tolist()) == ([[3.0, 4.0]], [[5.0, 6.0]])
    assert found.coded.all()
    assert len(match_markers(one, Corners())) == 0
