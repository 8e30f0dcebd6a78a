"""Adapters as the PEFT library keeps them: a folder of adapter_config.json and adapter_model.safetensors.

    base_model.model.LAYER.lora_A.weight, base_model.model.LAYER.lora_B.weight

Adapters trained with PEFT on this network can be used here, and ours in PEFT. Variants that are more than W + s B A
(DoRA, trained biases, whole modules) are refused by name.
"""

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from swimm3r.errors import Swimm3rError, WeightsError
from swimm3r.io.files.atomic import atomic_path, write_text
from swimm3r.io.files.damage import Remedy, damaged, guard
from swimm3r.io.files.json_file import read_json
from swimm3r.sfm.student.lora import Adapters

_PREFIX = "base_model.model."
_KEY = re.compile(re.escape(_PREFIX) + r"(.+)\.lora_([AB])\.weight")
_CONFIG, _TENSORS = "adapter_config.json", "adapter_model.safetensors"
_REMEDY = Remedy(
    "an adapter trained by swimm3r train-sfm, or by PEFT on this network",
    cause="it is damaged, or belongs to another network",
    error=WeightsError,
    fault="cannot be used as an adapter",
)


def write_peft(adapters: Adapters, folder: Path, base: str | None = None) -> None:
    """Writes the folder that PEFT's `from_pretrained` reads; `base` names the checkpoint they belong to."""
    with atomic_path(folder / _TENSORS) as draft:
        save_file(tensors(adapters), draft, metadata={"format": "pt"})
    write_text(folder / _CONFIG, json.dumps(config(adapters, base), indent=2) + "\n")


def read_peft(folder: Path, network: nn.Module) -> Adapters:
    """The adapters of a folder, attached to the network. Raises WeightsError where they do not fit it."""
    for name in (_CONFIG, _TENSORS):
        if not (folder / name).is_file():
            raise _unfit(folder, f"it has no {name}")
    settings = read_json(folder / _CONFIG, dict[str, Any], _REMEDY)
    with guard(folder / _TENSORS, _REMEDY):
        stored = load_file(folder / _TENSORS)
    return attach_stored(stored, settings, network, folder)


def tensors(adapters: Adapters) -> dict[str, Tensor]:
    """The trained numbers under PEFT's names, on the CPU."""
    found = {}
    for name, update in zip(adapters.names, adapters, strict=True):
        for letter, layer in (("A", update.lora_A), ("B", update.lora_B)):
            found[f"{_PREFIX}{name}.lora_{letter}.weight"] = layer.weight.detach().cpu().contiguous()
    return found


def config(adapters: Adapters, base: str | None = None) -> dict[str, Any]:
    """PEFT's description of the adapters; every layer is named, so that no pattern can match another."""
    rank = max((u.rank for u in adapters), default=1)
    alpha = max((u.alpha for u in adapters if u.rank == rank), default=1.0)
    updates = dict(zip(adapters.names, adapters, strict=True))
    return {
        "peft_type": "LORA",
        "task_type": None,
        "base_model_name_or_path": base,
        "inference_mode": True,
        "r": rank,
        "lora_alpha": alpha,
        "lora_dropout": 0.0,
        "bias": "none",
        "fan_in_fan_out": False,
        "use_rslora": False,
        "use_dora": False,
        "target_modules": list(updates),
        "rank_pattern": {re.escape(n): u.rank for n, u in updates.items() if u.rank != rank},
        "alpha_pattern": {re.escape(n): u.alpha for n, u in updates.items() if u.alpha != alpha},
    }


def attach_stored(
    stored: Mapping[str, Tensor], settings: Mapping[str, Any], network: nn.Module, source: Path
) -> Adapters:
    """Adapters of PEFT's tensors and description, attached to the network. Raises WeightsError for those of another."""
    _require_plain(settings, source)
    pairs: dict[str, dict[str, Tensor]] = {}
    for key, value in stored.items():
        found = _KEY.fullmatch(key)
        if found is None:
            raise _unfit(source, f"it holds {key}, which is no low-rank update")
        pairs.setdefault(found[1], {})[found[2]] = value
    if half := [name for name, pair in pairs.items() if len(pair) != 2]:
        raise _unfit(source, f"of {half[0]} only one of A and B is there")
    ranks = {name: len(pair["A"]) for name, pair in pairs.items()}
    try:
        alphas = {name: _alpha(settings, name, rank) for name, rank in ranks.items()}
        adapters = Adapters(network, ranks, alphas, torch.Generator())
    except (ValueError, TypeError, re.error) as error:
        raise _unfit(source, str(error)) from error
    for name, update in zip(adapters.names, adapters, strict=True):
        for letter, layer in (("A", update.lora_A), ("B", update.lora_B)):
            value = pairs[name][letter]
            if value.shape != layer.weight.shape:
                adapters.detach()
                raise _unfit(source, f"{name}: {letter} is {tuple(value.shape)}, expected {tuple(layer.weight.shape)}")
            layer.weight.data.copy_(value)
    return adapters


def _alpha(settings: Mapping[str, Any], name: str, rank: int) -> float:
    patterns = settings.get("alpha_pattern") or {}
    # as PEFT matches: a pattern is the end of the layer's name
    alpha = next((v for p, v in patterns.items() if re.fullmatch(rf"(.*\.)?({p})", name)), settings.get("lora_alpha"))
    if not isinstance(alpha, int | float):
        raise ValueError(f"lora_alpha is {alpha!r}, not a number")
    return alpha * math.sqrt(rank) if settings.get("use_rslora") else float(alpha)


def _require_plain(settings: Mapping[str, Any], source: Path) -> None:
    if settings.get("peft_type") != "LORA":
        raise _unfit(source, f"it is of type {settings.get('peft_type')!r}, not LORA")
    if settings.get("bias", "none") != "none":
        raise _unfit(source, "it also trains biases")
    for name in ("use_dora", "use_qalora", "fan_in_fan_out", "lora_bias", "modules_to_save", "layer_replication"):
        if settings.get(name):
            raise _unfit(source, f"it uses {name}, which is not supported")


def _unfit(source: Path, why: str) -> Swimm3rError:
    return damaged(source, why, _REMEDY)
