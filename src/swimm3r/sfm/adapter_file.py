"""What training leaves behind: adapters and physics head in one safetensors file, without a single base weight.

Tensors bear PEFT's names (`peft_format.py`) and `head.NAME`; the header says which base they were trained on (SHA-256
over its tensors, whatever file they came from), that base's licence, which binds the adapter's use, and the settings.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from swimm3r.errors import WeightsError
from swimm3r.io.atomic import atomic_path
from swimm3r.sfm.mast3r.network import Mast3r
from swimm3r.sfm.mast3r.peft_format import attach_stored, config
from swimm3r.sfm.mast3r.settings import ObjectiveSettings
from swimm3r.sfm.physics_head import PhysicsHead
from swimm3r.sfm.student import Student

_SCHEMA, _HEAD = 1, "head."


@dataclass(frozen=True)
class Base:
    """The frozen network that adapters belong to."""

    name: str  # file name
    sha256: str  # of its tensors
    licence: str


def fingerprint(state: Mapping[str, Tensor]) -> str:
    """SHA-256 of a state dict's tensors in float32, each once: the same for .pth and .safetensors of one network."""
    digest = hashlib.sha256()
    for key in sorted(state):
        if ".layer_rn." in key:  # another name of layer1_rn .. layer4_rn
            continue
        values = np.ascontiguousarray(state[key].detach().float().cpu().numpy(), dtype="<f4")
        digest.update(f"{key}{values.shape}".encode())
        digest.update(values.data)
    return digest.hexdigest()


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
    stored = {name: p.detach().cpu().contiguous() for name, p in trained_parameters(student).items()}
    header = {
        "schema": _SCHEMA,
        "kind": "swimm3r sfm adapter",
        "base": asdict(base),
        "peft": config(student.adapters, base.name),
        "objective": asdict(student.objective),
        "trained": dict(about),
    }
    with atomic_path(path) as draft:
        save_file(stored, draft, metadata={"format": "pt", "swimm3r": json.dumps(header, sort_keys=True)})


def load(path: Path, network: Mast3r, sha256: str | None = None) -> Student:
    """The student of a file, its adapters attached to the network, gradients off.

    `sha256` is the network's `fingerprint`, None to trust the caller. Raises WeightsError for a file that is missing or
    damaged, and for adapters of another base.
    """
    header, stored = _read(path)
    base = header["base"]
    if sha256 is not None and sha256 != base["sha256"]:
        raise _unfit(path, f"it was trained on {base['name']} ({base['sha256'][:12]}), this network is {sha256[:12]}")
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
    adapters = attach_stored(rest, header["peft"], network, path)
    try:
        objective = ObjectiveSettings(**header["objective"])
    except TypeError as error:
        raise _unfit(path, str(error)) from error
    return Student(network, adapters, head, objective).eval().requires_grad_(False)


def describe(path: Path) -> dict[str, Any]:
    """The header of a file: base, licence, settings. Raises WeightsError as `load` does."""
    return _read(path)[0]


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    try:
        with safe_open(path, "pt") as file:
            header = json.loads((file.metadata() or {}).get("swimm3r", "{}"))
            stored = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError, ValueError) as error:
        raise _unfit(path, str(error).splitlines()[0]) from error
    if header.get("schema") != _SCHEMA or not {"base", "peft", "objective"} <= header.keys():
        raise _unfit(path, "it is no adapter file of this version")
    return header, stored


def _unfit(path: Path, why: str) -> WeightsError:
    return WeightsError(
        f"{path} cannot be used as an adapter: {why}",
        cause="the file is damaged, of another program, or trained on another base",
        hint="the adapter.safetensors that swimm3r train-sfm wrote, with the weights it was trained on",
    )
