"""Primitives for what moves, which the still scene that a dynamic map starts from does not have.

Moving parts are found in every frame (`motion_masks`), tracked from frame to frame (`part_tracks`) and located by
trajectory triangulation (`trajectory`). In each frame primitives are added on them, for a short time around its own,
which travel to where the frames before and after show them (`linear_motion`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from swimm3r.cameras import Cameras, directions, project, ray_depth_from_z, unproject
from swimm3r.medium import Medium, remove_water
from swimm3r.splat.dynamic.linear_motion import LONGEST, traveling
from swimm3r.splat.dynamic.motion_masks import MotionView, moving_parts
from swimm3r.splat.dynamic.part_flow import Passage, carried, full_size, passages
from swimm3r.splat.dynamic.part_tracks import Part, Track, tracks
from swimm3r.splat.dynamic.trajectory import course
from swimm3r.splat.medium.field import MediumField
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.settings import UwbsSettings
from swimm3r.splat.views import TrainingView, TrainingViews

_SPACING = 3.0  # pixels between primitives that are born, at least
_RADIUS = 1.6  # of a primitive, in their spacing, and
_OPACITY = 0.9  # so that they cover what is behind from the first
_BEFORE = 0.95  # of the ground's distance: what moves is nearer
_ALONE = 0.5  # intervals between frames that primitives last which nothing shows how to follow


@dataclass(frozen=True)
class Observation:
    """A part in one frame, how far away it is, and its way to the frames before and after where it is followed."""

    part: Part
    z_depth: float
    ways: tuple["Way", ...]


@dataclass(frozen=True)
class Way:
    """To the same part in another frame."""

    passage: Passage
    camera: Cameras
    z_depth: float
    after: float  # time between the two, lengths of the clip; negative for an earlier frame

    def velocity(self, pixels: Float[Tensor, "n 2"], xyz: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Of what is at `pixels` and `xyz`, lengths per clip."""
        z_depth = torch.full((1, len(pixels)), self.z_depth)
        return (unproject(self.camera, self.passage.there(pixels)[None], z_depth)[0] - xyz) / self.after


def born(
    p: BetaPrimitives, field: MediumField, views: TrainingViews, settings: UwbsSettings, rng: torch.Generator
) -> BetaPrimitives:
    """The primitives that come to a dynamic map for what moves in the frames; none where nothing does.

    At most `MoverSettings.share` of the largest number of primitives.
    """
    none = BetaPrimitives(*(values[:0] for values in p))
    times = np.array(views.times)
    order = np.argsort(times, kind="stable").tolist()
    gaps = np.diff(times[order])
    if not gaps.any():
        return none
    interval = float(np.median(gaps[gaps > 0]))
    looks, masks = moving_parts(p, field, views, settings)
    parts = [[Part(k, float(times[k]), mask, looks[k].rgb) for mask in masks[k]] for k in order]
    found = [s for track in tracks(parts) for s in _observations(track, views, looks, interval, settings)]
    area = sum(float(s.part.mask.sum()) / s.part.mask.numel() * views[s.part.frame].seen.numel() for s in found)
    most = round(settings.movers.share * settings.densify.cap_max)
    spacing = max(_SPACING, (area / max(1, most)) ** 0.5)
    made = [_primitives(s, field, views[s.part.frame], spacing, interval, settings, rng) for s in found]
    return BetaPrimitives(*(torch.cat(values) for values in zip(none, *made, strict=True)))


def _observations(
    track: Track, views: TrainingViews, looks: Sequence[MotionView], interval: float, settings: UwbsSettings
) -> list[Observation]:
    """A track's parts with their distances, by the course of the middle of its largest."""
    parts = track.parts
    frames = [part.frame for part in parts]
    steps = [
        passages(fit, a, b, views[a.frame], views[b.frame])
        for fit, (a, b) in zip(track.fits, pairwise(parts), strict=True)
    ]
    largest = max(range(len(parts)), key=lambda i: int(parts[i].mask.sum()))
    middle = full_size(parts[largest].mask, views[frames[largest]]).nonzero().double().mean(0).flip(0) + 0.5
    pixels = {largest: middle[None]}
    for i in range(largest + 1, len(parts)):
        pixels[i] = carried(steps[i - 1][0].whole, pixels[i - 1])
    for i in range(largest - 1, -1, -1):
        pixels[i] = carried(steps[i][1].whole, pixels[i + 1])
    ground = torch.tensor([_ground(part, looks[part.frame]) for part in parts])
    cameras = views.cameras[frames]
    times = torch.tensor([part.time for part in parts])
    on_course = torch.cat([pixels[i] for i in range(len(parts))])
    xyz = course(cameras, on_course, times / interval, settings.movers.nearness * ground)
    on_rays = project(cameras, xyz[:, None])[1][:, 0]
    nearer = float((_BEFORE * ground / on_rays).median().clamp(max=1))  # the whole course, or it would lose its shape
    z = (nearer * on_rays).tolist()

    def way(i: int, j: int) -> Way:
        passage = steps[i][0] if j > i else steps[j][1]
        return Way(passage, cameras[j], z[j], float(times[j] - times[i]))

    near = [[j for j in (i - 1, i + 1) if 0 <= j < len(parts)] for i in range(len(parts))]
    return [Observation(part, z[i], tuple(way(i, j) for j in near[i])) for i, part in enumerate(parts)]


def _ground(part: Part, motion_view: MotionView) -> float:
    """Z depth of the nearest ground that a part hides, but for a tenth."""
    return float(motion_view.z_depth.clamp(max=motion_view.reach)[part.mask].quantile(0.1))


def _primitives(
    observation: Observation,
    field: MediumField,
    view: TrainingView,
    spacing: float,
    interval: float,
    settings: UwbsSettings,
    rng: torch.Generator,
) -> BetaPrimitives:
    """Primitives at random pixels of a part, `spacing` apart on average, freed from the water."""
    width, z_depth = view.camera.width, observation.z_depth
    rows = ((full_size(observation.part.mask, view) > 0) & view.seen).reshape(-1).nonzero()[:, 0]
    count = max(1, round(len(rows) / spacing**2))
    rows = rows[torch.randperm(len(rows), generator=rng)[:count]]
    pixels = torch.stack([rows % width, rows // width], -1) + torch.rand(len(rows), 2, generator=rng)
    z = torch.full((len(rows),), z_depth)
    xyz = unproject(view.camera, pixels[None], z[None])[0]
    toward = normalize(xyz - view.camera.centers[0].to(xyz), dim=-1)
    colors = view.rgb.reshape(3, -1).mT[rows]
    if settings.medium.model == "network":
        with torch.no_grad():
            Binf, beta_B, beta_D = field(toward[None].float(), view.time)[:, 0].mT.split(3, -1)
        ray_depth = ray_depth_from_z(z, directions(view.camera, pixels[None])[0])
        colors = remove_water(colors, ray_depth, Medium(Binf, beta_D, beta_B)).clamp(0, 1)
    velocities = [way.velocity(pixels, xyz) for way in observation.ways]
    assert view.time is not None
    return traveling(
        xyz,
        torch.stack(velocities).mean(0) if velocities else torch.zeros_like(xyz),
        toward,
        float(view.time),
        radius=_RADIUS * spacing * z / float(view.camera.K[0, 0, 0]),
        duration=min(LONGEST, interval * (settings.movers.duration if velocities else _ALONE)),
        rgb=colors,
        opacity=_OPACITY,
    )
