"""A training as it is watched from outside: the step that was just done, and the map as it stands.

An observer is called after every step, between two steps, in the thread that trains. It draws no random numbers of the
training and gets copies of whatever a later step could change, so that the trained map has the same bits with it and
without.
"""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from swimm3r.cameras import Cameras
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.training.scene import TrainingScene
from swimm3r.splat.training.state import State, map_in_scene_units
from swimm3r.splat.views import TrainingView


@dataclass(frozen=True)
class TrainingStep:
    """One step of a training, right after it was done."""

    step: int  # from 1
    iterations: int
    numbers: Mapping[str, float | Tensor]  # the scalars that the step logs
    view: TrainingView  # the image it trained on
    scene: TrainingScene
    state: State[Any, Any]

    def map(self) -> SplatMap:
        """The map as it stands, in scene units; it stays as it is when training goes on."""
        with torch.no_grad():
            primitives = self.state.primitives._make(values.detach().clone() for values in self.state.primitives)
            copied = State(primitives, copy.deepcopy(self.state.field), None, {})
            length = 1 / self.scene.scale
            p, field = map_in_scene_units(copied, length)
        rec, views = self.scene.rec, self.scene.views
        return SplatMap(p, field, views.settings, rec.metric, length, views.frames.span)

    def camera(self) -> Cameras:
        """The camera of the image, where training has moved it to, scene units."""
        with torch.no_grad():
            camera = self.scene.camera(self.view, self.state.poses)
            cam2world = camera.cam2world.detach().clone()
        cam2world[:, :3, 3] /= self.scene.scale
        return replace(camera, cam2world=cam2world)


Observer = Callable[[TrainingStep], None]
