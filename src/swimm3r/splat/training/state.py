"""The state of a training run, whatever the recipe: all that a step changes."""

import copy
import dataclasses
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from swimm3r.splat.medium.field import MediumField, in_unit
from swimm3r.splat.medium.kinds import Water
from swimm3r.splat.medium.seasplat import SceneWater
from swimm3r.splat.optimizer import Moments, fresh
from swimm3r.splat.pose_mlp import PoseMlp
from swimm3r.splat.primitives import beta, gaussian
from swimm3r.splat.primitives.beta import BetaPrimitives, trained
from swimm3r.splat.primitives.gaussian import GaussianPrimitives
from swimm3r.splat.primitives.kinds import Primitives, primitives_from

FIELD, POSES = "field.", "poses."
P = TypeVar("P", BetaPrimitives, GaussianPrimitives)
W = TypeVar("W", MediumField, SceneWater)


@dataclass(frozen=True)
class State(Generic[P, W]):
    """Primitives, water and poses, the optimizer's memory of them, and what else a recipe remembers."""

    primitives: P
    field: W
    poses: PoseMlp | None  # None where poses are held
    moments: dict[str, Moments]  # of "xyz" ..., of the field's parameters by "field.*", of the poses' by "poses.*"
    memory: dict[str, Tensor] = dataclasses.field(default_factory=dict)

    def to(self, device: torch.device) -> "State[P, W]":
        """The state on a device; the poses stay on the processor, where the matches are."""
        moments = {
            name: m if name.startswith(POSES) else Moments(*(t.to(device) for t in vars(m).values()))
            for name, m in self.moments.items()
        }
        memory = {name: t.to(device) for name, t in self.memory.items()}
        return State(self.primitives.to(device), copy.deepcopy(self.field).to(device), self.poses, moments, memory)


def parameters_of(p: Primitives, field: Water, poses: PoseMlp | None = None) -> dict[str, Tensor]:
    """Everything that is trained, by the names of `State.moments`."""
    of_field: dict[str, Tensor] = {f"{FIELD}{name}": t for name, t in field.named_parameters()}
    of_poses = {} if poses is None else {f"{POSES}{name}": t for name, t in poses.named_parameters()}
    return {**trained(p), **of_field, **of_poses}


def first_state(p: P, field: W, poses: PoseMlp | None, memory: dict[str, Tensor] | None = None) -> State[P, W]:
    """The state before step 1."""
    p = type(p)(*(values.contiguous() for values in p))
    moments = {name: fresh(values) for name, values in parameters_of(p, field, poses).items()}
    return State(p, field, poses, moments, memory or {})


def stored(state: State) -> dict[str, Tensor]:
    """Parameters by name; their moments after .first, .second and .steps; what else is remembered after .memory."""
    parameters = parameters_of(state.primitives, state.field, state.poses)
    tensors = {f"parameter.{name}": t for name, t in (state.primitives._asdict() | parameters).items()}
    tensors |= {f"buffer.{name}": t for name, t in _measured(state.field).items()}
    for name, m in state.moments.items():
        tensors |= {f"first.{name}": m.first, f"second.{name}": m.second, f"steps.{name}": m.steps}
    return tensors | {f"memory.{name}": t for name, t in state.memory.items()}


def _measured(field: Water) -> dict[str, Tensor]:
    """Numbers of the field that are neither trained nor set by settings or reconstruction: the box of the first step's
    Gaussians."""
    return {name: t for name, t in field.named_buffers() if name.startswith("affine_colors.")}


def restored(
    tensors: dict[str, Tensor], kind: type[Primitives], field: Water, poses: PoseMlp | None
) -> State[Any, Any]:
    """The inverse of `stored`; it fills an untrained `field`, and `poses` where they are refined.

    Raises KeyError or ValueError for tensors that are not of such a state.
    """
    p: Any = primitives_from(tensors, kind, "parameter.")
    parameters = parameters_of(p, field, poses)
    with torch.no_grad():
        for name, parameter in parameters.items():
            values = tensors[f"parameter.{name}"]
            shapes = {tensors[f"{kind}.{name}"].shape for kind in ("parameter", "first", "second")}
            if shapes != {parameter.shape} or tensors[f"steps.{name}"].dim():
                raise ValueError(f"{name} or its moments are not of the shape {tuple(parameter.shape)}")
            parameter.copy_(values)
        for name, buffer in _measured(field).items():
            if tensors[f"buffer.{name}"].shape != buffer.shape:
                raise ValueError(f"{name} is not of the shape {tuple(buffer.shape)}")
            buffer.copy_(tensors[f"buffer.{name}"])
    moments = {k: Moments(tensors[f"first.{k}"], tensors[f"second.{k}"], tensors[f"steps.{k}"]) for k in parameters}
    memory = {k.removeprefix("memory."): t for k, t in tensors.items() if k.startswith("memory.")}
    filled: Any = field
    return State(p, filled, poses, moments, memory)


def map_in_scene_units(state: State, length: float) -> tuple[Primitives, Water]:
    """Primitives and water of a finished state, `length` scene units to a working unit; no gradient.

    SceneWater has no length.
    """
    p, field = state.primitives, state.field.requires_grad_(False)
    moved = beta.rescaled(p, length) if isinstance(p, BetaPrimitives) else gaussian.rescaled(p, length)
    return moved, in_unit(field, length) if isinstance(field, MediumField) else field


def clip_field(gradients: dict[str, Tensor]) -> None:
    """Hold the gradient of the water's network to a norm of 1e-3, in place (WaterSplatting)."""
    of_field = [gradient for name, gradient in gradients.items() if name.startswith(FIELD)]
    if of_field:
        norm = torch.stack([g.norm() for g in of_field]).norm()
        for g in of_field:
            g.mul_((1e-3 / norm).clamp(max=1))
