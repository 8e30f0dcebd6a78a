"""What moves before a still scene: found where one frame alone differs, and born as primitives that travel."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from swimm3r.cameras import project
from swimm3r.evaluate.images import psnr
from swimm3r.frames import Frames
from swimm3r.io.images import write_rgb
from swimm3r.medium import Medium
from swimm3r.splat import train
from swimm3r.splat.conditioning import condition
from swimm3r.splat.medium_field import MediumField, initial_field
from swimm3r.splat.movers import Residual, born, moving_pixels, residual
from swimm3r.splat.primitives import BetaPrimitives, select, with_time
from swimm3r.splat.settings import DensifySettings, InitialSettings, MediumFieldSettings, MoverSettings, UwbsSettings
from swimm3r.splat.travel import travelling
from swimm3r.splat.views import TrainingViews

WATER = Medium(torch.tensor([0.1, 0.4, 0.5]), torch.tensor([0.4, 0.15, 0.1]), torch.tensor([0.3, 0.2, 0.2]))
DYNAMIC = UwbsSettings(dynamic=True, densify=DensifySettings(max_primitives=4000))
SIDE, LEFT, TOP = 16, 6, 16  # of the patch that crosses the picture, and where it is in the first frame, pixels
STEP = 3  # pixels it goes on in each frame


def rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize("speed", [0.0, 0.1, 2.0])
def test_a_travelling_primitive_is_where_its_velocity_takes_it(speed):
    n, generator = 64, rng()
    xyz, way = torch.randn(2, n, 3, generator=generator, dtype=torch.float64)
    direction = torch.nn.functional.normalize(way.flip(-1), dim=-1)
    radius = torch.full((n,), 0.02, dtype=torch.float64)
    p = travelling(
        xyz, speed * way, direction, 0.4, radius=radius, duration=0.1, rgb=torch.rand(n, 3), opacity=0.5
    )  # fmt: skip
    for time, share in ((0.4, 1.0), (0.45, 0.325), (0.3, 0.0032)):  # (1 - tanh y^2)^4, y = 0, 1/2, 1
        seen = condition(p, torch.cat([direction, torch.full((n, 1), time)], -1).float())
        torch.testing.assert_close(seen.mean.double(), xyz + speed * way * (time - 0.4), atol=1e-5, rtol=0)
        torch.testing.assert_close(seen.opacity, torch.full((n,), 0.5 * share), atol=1e-3, rtol=0)
        spread = torch.linalg.eigvalsh((seen.covariance + seen.covariance.mT) / 2).sqrt()
        assert spread.min() > 0.7 * 0.02
        assert spread.max() < 1.4 * 0.02


@dataclass(frozen=True)
class Crossing:
    """The tiny dive with a patch that goes from left to right, and a still map of it without the patch."""

    views: TrainingViews
    frames: Frames
    still: BetaPrimitives  # D = 7
    field: MediumField

    @property
    def residuals(self) -> list[Residual]:
        return [residual(self.still, self.field, self.views[k], DYNAMIC) for k in range(len(self.views))]


@pytest.fixture(scope="module")
def crossing(tiny_dive, tmp_path_factory) -> Crossing:
    folder = tmp_path_factory.mktemp("crossing")
    noise = gaussian_filter(np.random.default_rng(0).uniform(size=(SIDE, SIDE)), 1.5)
    tone = (noise - noise.min()) / np.ptp(noise)
    patch = np.stack([200 + 55 * tone, 255 * tone, 255 * tone], -1).astype(np.uint8)
    listed = []
    for i, frame in enumerate(tiny_dive.frames):
        picture = (tiny_dive.frames.image(i) * 255).round().byte().numpy()
        picture[TOP : TOP + SIDE, LEFT + STEP * i : LEFT + STEP * i + SIDE] = patch
        write_rgb(folder / frame.name, picture)
        listed.append(replace(frame, path=folder / frame.name))
    frames = replace(tiny_dive.frames, frames=tuple(listed))
    everlasting = InitialSettings(time_exponent=-9.0)
    still = with_time(tiny_dive.truth.primitives, everlasting, rng())
    field = initial_field(WATER, MediumFieldSettings(), rng(), dynamic=True)
    return Crossing(TrainingViews(tiny_dive.rec, frames, DYNAMIC, 1.0), frames, still, field)


def test_the_patch_is_found_in_every_frame_and_nothing_else(crossing):
    found = crossing.residuals
    for k, mine in enumerate(found):
        mask = moving_pixels(mine, [other for j, other in enumerate(found) if j != k], contrast=3.0, least=0.04)
        column = LEFT + STEP * (k + 1)  # the first frame of the dive is held back
        patch = torch.zeros_like(mask)
        patch[TOP : TOP + SIDE, column : column + SIDE] = True
        assert mask[patch].float().mean() > 0.8, crossing.views.names[k]
        near = torch.nn.functional.max_pool2d(patch[None].float(), 7, 1, 3)[0] > 0
        assert not mask[~near].any(), crossing.views.names[k]


def test_what_every_frame_shows_alike_does_not_move(crossing):
    """The map is wrong there, but wrong in all frames: densification's business."""
    found = crossing.residuals
    alike = [replace(r, off=found[3].off) for r in found]
    mine = replace(alike[3], camera=alike[2].camera)
    others = [replace(r, camera=mine.camera, z_depth=mine.z_depth) for r in alike[:3]]
    assert not moving_pixels(mine, others, contrast=3.0, least=0.04).any()


def test_one_other_frame_is_not_enough_to_tell(crossing):
    found = crossing.residuals
    assert not moving_pixels(found[3], found[:1], contrast=3.0, least=0.04).any()


def test_what_is_born_travels_with_the_patch(crossing):
    views = crossing.views
    p = born(crossing.still, crossing.field, views, DYNAMIC, rng())
    assert 0 < len(p.xyz) <= DYNAMIC.movers.share * DYNAMIC.densify.max_primitives
    for k in range(1, len(views) - 1):
        here = select(p, (p.query_mean[:, 3] - views.times[k]).abs() < 1e-3)
        assert len(here.xyz) > 5
        shown = []
        for j in (k - 1, k + 1):
            query = torch.cat([here.query_mean[:, :3], torch.full((len(here.xyz), 1), views.times[j])], -1)
            shown.append(project(views[j].camera, condition(here, query).mean[None])[0][0])
        off = shown[1] - shown[0] - torch.tensor([2.0 * STEP, 0.0])  # the camera's own way is no straight line
        assert off.norm(dim=-1).median() < 1.0, k


def test_nothing_is_born_where_nothing_moves(tiny_dive, crossing):
    views = TrainingViews(tiny_dive.rec, tiny_dive.frames, DYNAMIC, 1.0)
    assert len(born(crossing.still, crossing.field, views, DYNAMIC, rng()).xyz) == 0


def test_a_map_shows_the_patch_between_the_frames_it_learned(tiny_dive, crossing, tmp_path):
    """The fifth frame, held back, has the patch where neither of its neighbours has it."""
    frames = tuple(replace(f, split="test" if i == 4 else "train") for i, f in enumerate(crossing.frames))
    frames = replace(crossing.frames, frames=frames)
    rec = replace(tiny_dive.rec, names=frames.names, cameras=tiny_dive.cameras)
    settings = replace(
        DYNAMIC, iterations=120, initial=InitialSettings(primitives=1500), densify=DensifySettings(max_primitives=4000)
    )
    target = frames.image(4)[TOP : TOP + SIDE, LEFT + 4 * STEP : LEFT + 4 * STEP + SIDE]
    scores = {}
    for name, at in (("with", settings.movers.at), ("without", 0.0)):
        s = replace(settings, movers=MoverSettings(at=at))
        scene = train(rec, frames, s, tmp_path / name)
        shown = scene.render(tiny_dive.cameras[4], 4.0).rgb.clamp(0, 1)
        scores[name] = psnr(shown[TOP : TOP + SIDE, LEFT + 4 * STEP : LEFT + 4 * STEP + SIDE], target)
    assert scores["with"] > scores["without"] + 2, scores
