"""Moving objects before a static scene: detected where one frame alone differs, added as moving primitives."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from swimm3r.cameras import project
from swimm3r.evaluate.images import psnr
from swimm3r.io.images import write_rgb
from swimm3r.medium import Medium
from swimm3r.scene.frames import Frames
from swimm3r.splat import train
from swimm3r.splat.dynamic.linear_motion import traveling
from swimm3r.splat.dynamic.motion_masks import MotionView, against_others, motion_view, moving_parts, moving_pixels
from swimm3r.splat.dynamic.spawn import born
from swimm3r.splat.medium.field import MediumField, initial_field
from swimm3r.splat.primitives.beta import BetaPrimitives, select, trained, with_time
from swimm3r.splat.projection.conditioning import condition
from swimm3r.splat.recipes.uwbs import Uwbs
from swimm3r.splat.settings import DensifySettings, InitialSettings, MediumFieldSettings, MoverSettings, UwbsSettings
from swimm3r.splat.training.scene import TrainingScene
from swimm3r.splat.training.state import first_state
from swimm3r.splat.views import TrainingViews

WATER = Medium(torch.tensor([0.1, 0.4, 0.5]), torch.tensor([0.4, 0.15, 0.1]), torch.tensor([0.3, 0.2, 0.2]))
DYNAMIC = UwbsSettings(dynamic=True, densify=DensifySettings(cap_max=4000))
SIDE, LEFT, TOP = 16, 6, 16  # of the patch that crosses the image, and where it is in the first frame, pixels
STEP = 3  # pixels it goes on in each frame


def rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize("speed", [0.0, 0.1, 2.0])
def test_a_traveling_primitive_is_where_its_velocity_takes_it(speed):
    n, generator = 64, rng()
    xyz, way = torch.randn(2, n, 3, generator=generator, dtype=torch.float64)
    direction = torch.nn.functional.normalize(way.flip(-1), dim=-1)
    radius = torch.full((n,), 0.02, dtype=torch.float64)
    p = traveling(
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

    def looks(self, still: BetaPrimitives | None = None) -> list[MotionView]:
        still = self.still if still is None else still
        return [motion_view(still, self.field, self.views[k], DYNAMIC) for k in range(len(self.views))]


@pytest.fixture(scope="module")
def crossing(tiny_dive, tmp_path_factory) -> Crossing:
    folder = tmp_path_factory.mktemp("crossing")
    noise = gaussian_filter(np.random.default_rng(0).uniform(size=(SIDE, SIDE)), 1.5)
    tone = (noise - noise.min()) / np.ptp(noise)
    patch = np.stack([200 + 55 * tone, 255 * tone, 255 * tone], -1).astype(np.uint8)
    listed = []
    for i, frame in enumerate(tiny_dive.frames):
        image = (tiny_dive.frames.image(i) * 255).round().byte().numpy()
        image[TOP : TOP + SIDE, LEFT + STEP * i : LEFT + STEP * i + SIDE] = patch
        write_rgb(folder / frame.name, image)
        listed.append(replace(frame, path=folder / frame.name))
    frames = replace(tiny_dive.frames, frames=tuple(listed))
    everlasting = InitialSettings(time_exponent=-9.0)
    still = with_time(tiny_dive.truth.primitives, everlasting, rng())
    field = initial_field(WATER, MediumFieldSettings(), rng(), dynamic=True)
    return Crossing(TrainingViews(tiny_dive.rec, frames, DYNAMIC, 1.0), frames, still, field)


def others_than(k: int, looks: list[MotionView]) -> list[MotionView]:
    return [other for j, other in enumerate(looks) if j != k]


def patch_in(k: int, like: torch.Tensor) -> torch.Tensor:
    """Position of the patch in view k; the first frame of the dive is held back."""
    column = LEFT + STEP * (k + 1)
    patch = torch.zeros_like(like, dtype=torch.bool)
    patch[TOP : TOP + SIDE, column : column + SIDE] = True
    return patch


def test_the_patch_is_found_in_every_frame_and_nothing_else(crossing):
    _, masks = moving_parts(crossing.still, crossing.field, crossing.views, DYNAMIC)
    for k, parts in enumerate(masks):
        assert len(parts) == 1, crossing.views.names[k]
        patch = patch_in(k, parts[0])
        assert parts[0][patch].float().mean() > 0.8, crossing.views.names[k]
        near = torch.nn.functional.max_pool2d(patch[None].float(), 7, 1, 3)[0] > 0
        assert not parts[0][~near].any(), crossing.views.names[k]


def test_a_ghost_in_the_map_does_not_move(crossing):
    """The map shows a bright ball where no frame has one: the frames agree with each other there."""
    still = crossing.still
    middle = torch.tensor([[0.9, -0.3, 2.4]])
    ball = select(still, torch.zeros(1, dtype=torch.int64))
    ball = ball._replace(
        xyz=middle,
        query_mean=torch.cat([torch.nn.functional.normalize(middle, dim=-1), torch.full((1, 1), 0.5)], -1),
        rgb=torch.ones(1, 3),
        opacity=torch.tensor([9.0]),
    )
    looks = crossing.looks(BetaPrimitives(*(torch.cat(pair) for pair in zip(still, ball, strict=True))))
    deceived = 0
    for k, mine in enumerate(looks):
        pixel = project(mine.camera, ball.xyz[None].double())[0][0, 0].long()
        if not (0 <= pixel[0] < mine.camera.width and 0 <= pixel[1] < mine.camera.height):
            continue
        row, column = int(pixel[1]), int(pixel[0])
        agreed = against_others(mine, others_than(k, looks))
        deceived += float(mine.off[row, column]) > DYNAMIC.movers.least
        assert agreed.off[row, column] < DYNAMIC.movers.least or patch_in(k, mine.seen)[row, column]
        patch = patch_in(k, mine.seen)
        torch.testing.assert_close(agreed.off[patch].median(), mine.off[patch].median(), rtol=0.3, atol=0.02)
    assert deceived >= 3


def test_what_every_frame_shows_alike_does_not_move(crossing):
    """The map is wrong there, but wrong in all frames: densification's business."""
    found = crossing.looks()
    alike = [replace(r, off=found[3].off) for r in found]
    mine = replace(alike[3], camera=alike[2].camera)
    others = [replace(r, camera=mine.camera, z_depth=mine.z_depth) for r in alike[:3]]
    assert not moving_pixels(mine, others, contrast=3.0, least=0.04).any()


def test_one_other_frame_is_not_enough_to_tell(crossing):
    found = crossing.looks()
    assert not moving_pixels(found[3], found[:1], contrast=3.0, least=0.04).any()
    assert torch.equal(against_others(found[3], found[:1]).off, found[3].off)


def test_what_is_born_travels_with_the_patch(crossing):
    views = crossing.views
    p = born(crossing.still, crossing.field, views, DYNAMIC, rng())
    assert 0 < len(p.xyz) <= DYNAMIC.movers.share * DYNAMIC.densify.cap_max
    for k in range(1, len(views) - 1):
        here = select(p, (p.query_mean[:, 3] - views.times[k]).abs() < 1e-3)
        assert len(here.xyz) > 5
        shown = []
        for j in (k - 1, k + 1):
            query = torch.cat([here.query_mean[:, :3], torch.full((len(here.xyz), 1), views.times[j])], -1)
            shown.append(project(views[j].camera, condition(here, query).mean[None])[0][0])
        off = shown[1] - shown[0] - torch.tensor([2.0 * STEP, 0.0])  # the camera's own way is no straight line
        assert off.norm(dim=-1).median() < 1.0, k


def test_training_leaves_what_travels_on_its_way(tiny_dive, crossing):
    """Color, opacity and place are learned; the still primitives learn everything."""
    scene = TrainingScene(tiny_dive.rec, 1.0, 1.0, crossing.views)
    recipe = Uwbs(DYNAMIC, scene)
    fresh = born(crossing.still, crossing.field, crossing.views, DYNAMIC, rng())
    p = BetaPrimitives(*(torch.cat(pair) for pair in zip(crossing.still, fresh, strict=True)))
    before = BetaPrimitives(*(values.clone() for values in p))
    after, _ = recipe.step(first_state(p, crossing.field, None), crossing.views[3], 1)
    n = len(crossing.still.xyz)
    for name in trained(before):
        changed = getattr(after.primitives, name) != getattr(before, name)
        assert changed[:n].any(), name
        assert bool(changed[n:].any()) == (name in ("xyz", "rgb", "opacity")), name


def test_nothing_is_born_where_nothing_moves(tiny_dive, crossing):
    views = TrainingViews(tiny_dive.rec, tiny_dive.frames, DYNAMIC, 1.0)
    assert len(born(crossing.still, crossing.field, views, DYNAMIC, rng()).xyz) == 0


def test_a_map_shows_the_patch_between_the_frames_it_learned(tiny_dive, crossing, tmp_path):
    """The fifth frame, held back, has the patch where neither of its neighbors has it."""
    frames = tuple(replace(f, split="test" if i == 4 else "train") for i, f in enumerate(crossing.frames))
    frames = replace(crossing.frames, frames=frames)
    rec = replace(tiny_dive.rec, names=frames.names, cameras=tiny_dive.cameras)
    settings = replace(
        DYNAMIC, iterations=120, initial=InitialSettings(primitives=1500), densify=DensifySettings(cap_max=4000)
    )
    target = frames.image(4)[TOP : TOP + SIDE, LEFT + 4 * STEP : LEFT + 4 * STEP + SIDE]
    scores = {}
    for name, at in (("with", settings.movers.at), ("without", 0.0)):
        s = replace(settings, movers=MoverSettings(at=at))
        scene = train(rec, frames, s, tmp_path / name)
        shown = scene.render(tiny_dive.cameras[4], 4.0).rgb.clamp(0, 1)
        scores[name] = psnr(shown[TOP : TOP + SIDE, LEFT + 4 * STEP : LEFT + 4 * STEP + SIDE], target)
    assert scores["with"] > scores["without"] + 2, scores
