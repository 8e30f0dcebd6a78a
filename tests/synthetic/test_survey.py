"""Surveys of the synthetic plain: paths of any length, and patches of ground that agree where they overlap."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from swimm3r.cameras import pixel_grid, project, unproject
from swimm3r.errors import UsageError
from swimm3r.geometry import rotation_angle
from swimm3r.synthetic import DiveSettings, make_dive, plain
from swimm3r.synthetic.plain import BORDER, REACH, STEP, Plain
from swimm3r.synthetic.seafloor import CELL, height_at

SURVEY = DiveSettings(path="lawnmower", length=60.0, width=120, height=80, noise=0.0, fps=2.0)


@pytest.fixture(scope="module", autouse=True)
def no_patch_is_left() -> Iterator[None]:
    yield
    plain._patch.cache_clear()  # half a gigabyte


@pytest.mark.parametrize("path", ["transect", "lawnmower"])
def test_a_survey_has_its_length_speed_and_height(path):
    dive = make_dive(replace(SURVEY, path=path))
    assert len(dive) == dive.settings.frame_count == 401
    steps = dive.cameras.centers.diff(dim=0).norm(dim=1)
    assert float(steps.sum()) == pytest.approx(60, rel=0.05)  # the sway makes it longer, turns are cut shorter
    assert float(steps.median()) == pytest.approx(0.3 / 2, rel=0.05)
    height = dive.cameras.centers[:, 2]
    assert float(height.mean()) == pytest.approx(1.5, abs=0.03)
    assert 0.05 < float(height.max() - height.min()) < 0.17
    turns = rotation_angle(dive.cameras.cam2world[1:, :3, :3].mT @ dive.cameras.cam2world[:-1, :3, :3])
    assert float(torch.rad2deg(turns).max()) < 45
    assert float(torch.rad2deg(turns).median()) > 0.5  # it sways


def test_lines_lie_side_by_side_and_the_last_one_crosses_them_on_its_way_back():
    dive = make_dive(SURVEY)
    x, y = dive.cameras.centers[:, 0], dive.cameras.centers[:, 1]
    assert float(x.max() - x.min()) > 4
    assert float(torch.hypot(x - x[-1], y - y[-1])[:100].min()) < 0.5  # back on the first line
    apart = torch.cdist(dive.cameras.centers, dive.cameras.centers)
    frames = torch.arange(len(dive))
    later = (frames[None] - frames[:, None]) > 20  # 3 m of path
    met_again = ((apart < 1.0) & later).any(0)
    assert float(met_again.double().mean()) > 0.7


@pytest.mark.long
def test_neighboring_patches_are_one_ground_where_a_camera_may_look():
    left, right = Plain(3).around(0, 0), Plain(3).around(STEP * CELL, 0)
    assert left is not right
    assert left is Plain(3).around(0.4 * STEP * CELL, 0)
    rng = np.random.default_rng(0)
    low, high = STEP * CELL - 7 + BORDER, 7 - BORDER  # in both, BORDER from the edges
    x, y = rng.uniform(low, high, 4000), rng.uniform(low, high, 4000)
    np.testing.assert_allclose(height_at(left, x, y), height_at(right, x, y), atol=1e-9)
    shades = []
    for floor in (left, right):
        s = floor.surface
        at = ((y - s.y0) / CELL).round().astype(int), ((x - s.x0) / CELL).round().astype(int)
        shades.append(floor.shade[at])
    assert np.abs(shades[0] - shades[1]).max() < 0.02
    seen = (left.owner >= 0).any() and (right.owner >= 0).any()
    assert seen
    assert REACH > 2.5


def test_frames_over_different_patches_see_the_same_points():
    """The depth of one frame, carried into a frame over another patch, is what that frame sees, or behind it."""
    dive = make_dive(replace(SURVEY, path="transect", length=12.0))
    middles = (dive.cameras.centers[:, 1] / (STEP * CELL)).round()
    first = int(middles.diff().nonzero()[0, 0])
    a, b = dive.cameras[first - 1], dive.cameras[first + 2]
    frames = [dive.frame(i) for i in (first - 1, first + 2)]
    assert all((frame.z_depth > 0).all() for frame in frames)  # a plain has no end
    xy = pixel_grid(80, 120).double().reshape(1, -1, 2)
    points = unproject(a, xy, frames[0].z_depth.double().reshape(1, -1))
    uv, z = project(b, points)
    inside = ((uv[0] > 1) & (uv[0] < torch.tensor([119.0, 79.0]))).all(-1)
    there = uv[0][inside].floor().long()
    seen = frames[1].z_depth[there[:, 1], there[:, 0]].double()
    difference = z[0][inside] - seen
    assert float(difference.abs().median()) < 0.01
    assert float((difference > -0.05).double().mean()) > 0.97
    assert int(inside.sum()) > 4000


@pytest.mark.parametrize(
    ("wrong", "said"),
    [({"fov": 100.0}, "field of view"), ({"altitude": 2.5}, "altitude"), ({"moving_object": True}, "loops")],
)
def test_a_survey_that_cannot_be_made_is_refused(wrong, said):
    with pytest.raises(UsageError) as error:
        make_dive(replace(SURVEY, **wrong))
    assert said in str(error.value) + error.value.cause
