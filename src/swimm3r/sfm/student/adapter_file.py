"""Adapters and physics head in one safetensors file, without any base weight.

Tensors bear PEFT's names (`peft_format.py`) and `head.NAME`; the header says which base they were trained on (SHA-256
over its tensors, whatever file they came from), that base's license, which binds the adapter's use, and the settings.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from swimm3r.errors import Swimm3rError, WeightsError
from swimm3r.io.files.damage import Remedy, damaged, guard
from swimm3r.io.files.json_file import structure
from swimm3r.io.files.tensor_file import TensorFile, read_tensors, tensors_digest, write_tensors
from swimm3r.medium import Medium
from swimm3r.sfm.mast3r.network import Mast3r
from swimm3r.sfm.mast3r.settings import ObjectiveSettings
from swimm3r.sfm.student.peft_format import attach_stored, config
from swimm3r.sfm.student.physics_head import HeadFacts, PhysicsHead
from swimm3r.sfm.student.student import Student

_SCHEMA, _HEAD = 1, "head."
_REMEDY = Remedy(
    "the adapter.safetensors that swimm3r train-sfm wrote, with the weights it was trained on",
    cause="the file is damaged, of another program, or trained on another base",
    error=WeightsError,
    fault="cannot be used as an adapter",
)


@dataclass(frozen=True)
class Base:
    """The frozen network that adapters belong to."""

    name: str  # file name
    sha256: str  # of its tensors
    license: str


@dataclass(frozen=True)
class _WaterError:
    """Relative standard errors of the head's water on held-out pairs (`distillation.validation.water_error`)."""

    Binf: tuple[float, float, float]
    beta_D: tuple[float, float, float]
    beta_B: tuple[float, float, float]

    def __post_init__(self) -> None:
        if min(*self.Binf, *self.beta_D, *self.beta_B) < 0:
            raise ValueError("the errors of its water are negative")


@dataclass(frozen=True)
class _Validation:
    water_error: _WaterError | None = None


@dataclass(frozen=True)
class _Trained:
    validation: _Validation = field(default_factory=_Validation)


@dataclass(frozen=True)
class _Header:
    schema: Literal[1]
    base: Base
    peft: dict[str, Any]
    objective: ObjectiveSettings
    trained: _Trained


def fingerprint(state: Mapping[str, Tensor]) -> str:
    """`tensors_digest` of a state dict's tensors, each once: the same for .pth and .safetensors of one network."""
    aliased = ".layer_rn."  # another name of layer1_rn .. layer4_rn
    return tensors_digest({name: values for name, values in state.items() if aliased not in name})


def trained_parameters(student: Student) -> dict[str, torch.nn.Parameter]:
    """The trained parameters by the names the file gives them."""
    found = {}
    for name, update in zip(student.adapters.names, student.adapters, strict=True):
        found[f"base_model.model.{name}.lora_A.weight"] = update.lora_A.weight
        found[f"base_model.model.{name}.lora_B.weight"] = update.lora_B.weight
    if student.head is not None:
        found |= {_HEAD + name: parameter for name, parameter in student.head.named_parameters()}
    return found


def save(student: Student, base: Base, path: Path, about: Mapping[str, Any]) -> None:
    """Writes adapters and head, whole or not at all; `about` says how they were trained, in plain values."""
    header = {
        "schema": _SCHEMA,
        "kind": "swimm3r sfm adapter",
        "base": asdict(base),
        "peft": config(student.adapters, base.name),
        "objective": asdict(student.objective),
        "trained": dict(about),
    }
    write_tensors(path, trained_parameters(student), header)


def load(path: Path, network: Mast3r, sha256: str | None = None) -> Student:
    """The student of a file, its adapters attached to the network, gradients off.

    `sha256` is the network's `fingerprint`, None to trust the caller. Raises WeightsError for a file that is missing or
    damaged, and for adapters of another base.
    """
    found = _read(path)
    header, stored = _checked(found.about, path), found.tensors
    base = header.base
    if sha256 is not None and sha256 != base.sha256:
        raise _unfit(path, f"it was trained on {base.name} ({base.sha256[:12]}), this network is {sha256[:12]}")
    head_state = {k.removeprefix(_HEAD): v for k, v in stored.items() if k.startswith(_HEAD)}
    rest = {k: v for k, v in stored.items() if not k.startswith(_HEAD)}
    head = None
    if head_state:
        try:
            hidden, token_dim = head_state["shared.weight"].shape
            head = PhysicsHead(token_dim, network.architecture.patch, hidden)
            head.load_state_dict(head_state)
        except (KeyError, RuntimeError, ValueError) as error:
            raise _unfit(path, f"its physics head does not fit: {str(error).splitlines()[0]}") from error
        head.to(network.decoder_embed.weight.device)
    adapters = attach_stored(rest, header.peft, network, path)
    return Student(network, adapters, head, header.objective).eval().requires_grad_(False)


def describe(path: Path) -> dict[str, Any]:
    """The header of a file: base, license, settings. Raises WeightsError as `load` does."""
    document = _read(path).about
    _checked(document, path)
    return document


def head_facts(path: Path) -> HeadFacts:
    """Settings of the water of a file's physics head. Raises WeightsError as `load` does."""
    header = _checked(_read(path).about, path)
    error = header.trained.validation.water_error
    measured = None if error is None else Medium(*(torch.tensor(getattr(error, name)) for name in vars(error)))
    return HeadFacts(header.objective.min_transmittance, measured)


def _read(path: Path) -> TensorFile[dict[str, Any]]:
    return read_tensors(path, dict[str, Any], _REMEDY, _SCHEMA)


def _checked(document: dict[str, Any], path: Path) -> _Header:
    with guard(path, _REMEDY):
        return structure(document, _Header)


def _unfit(path: Path, why: str) -> Swimm3rError:
    return damaged(path, why, _REMEDY)
