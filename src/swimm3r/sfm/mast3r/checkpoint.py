"""Checkpoints of the network as data: published `.pth` and `.safetensors` files in, the same out.

Nothing in a file is ever executed: `.pth` is read with `weights_only`, and the constructor call it carries as text is
parsed, not evaluated. Sizes come from the tensors' shapes; only the numbers of attention heads, which no shape shows,
come from that text (or from `config.json` beside a `.safetensors`), else from the rule of 64 channels per head. Loading
is strict: every tensor must be there, and nothing else may be.
"""

import argparse
import ast
import json
import math
import pickle
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from swimm3r.errors import WeightsError
from swimm3r.io.files.atomic import atomic_path
from swimm3r.sfm.mast3r.network import Architecture, Mast3r

_ALIAS = re.compile(r"\.dpt\.scratch\.(?:layer([1-4])_rn|layer_rn\.([0-3]))\.")
_DOWNLOAD = "get the file again: swimm3r weights get mast3r"


def load(path: Path, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> Mast3r:
    """The network of a checkpoint, ready for inference: trunk in `dtype`, heads in float32, gradients off.

    Raises WeightsError for a file that is missing, damaged, unsafe or of another model.
    """
    state, arguments = read(path)
    architecture = infer_architecture(state, arguments)
    with torch.device("meta"):
        model = Mast3r(architecture)
    _check_keys(path, state, model)
    # assign: on the CPU in float32 the weights stay pages of the file
    model.load_state_dict(state, strict=True, assign=True)
    return model.set_precision(dtype).to(device).eval().requires_grad_(False)


def save(model: Mast3r, path: Path) -> None:
    """Writes the weights, float32, as `.safetensors` (each tensor once) or `.pth` (both published names)."""
    state = {key: value.detach().float().cpu().contiguous() for key, value in model.state_dict().items()}
    a = model.architecture
    arguments = {
        "enc_embed_dim": a.encoder_dim, "enc_depth": a.encoder_depth, "enc_num_heads": a.encoder_heads,
        "dec_embed_dim": a.decoder_dim, "dec_depth": a.decoder_depth, "dec_num_heads": a.decoder_heads,
        "pos_embed": f"RoPE{a.rope_base:g}", "patch_size": a.patch,
        "output_mode": f"pts3d+desc{a.descriptor_dim}",
        "head_type": "catmlp+dpt", "two_confs": True,
    }  # fmt: skip
    call = "AsymmetricMASt3R(" + ", ".join(f"{key}={value!r}" for key, value in arguments.items()) + ")"
    if path.suffix not in (".safetensors", ".pth"):
        raise ValueError(f"weights are written as .safetensors or .pth, got {path.suffix!r}")
    with atomic_path(path) as draft:
        if path.suffix == ".pth":
            torch.save({"args": argparse.Namespace(model=call), "model": state}, draft)
        else:
            unique = {key: value for key, value in state.items() if ".layer_rn." not in key}
            save_file(unique, draft, metadata={"model": call})


def read(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The state dict of a file, both alias names filled in, and the constructor's arguments if the file tells them."""
    if not path.is_file():
        raise WeightsError(
            f"there is no checkpoint at {path}",
            cause="the path is mistyped, or the weights were never downloaded",
            hint="swimm3r weights list shows what is here; " + _DOWNLOAD,
        )
    state, arguments = _read_safetensors(path) if path.suffix == ".safetensors" else _read_pth(path)
    return _with_aliases(state), arguments


def duplicate_decoder(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """A state dict of a one-decoder pre-training (CroCo) with its decoder used for both views."""
    out = dict(state)
    for key, value in state.items():
        if key.startswith("dec_blocks."):
            out.setdefault(key.replace("dec_blocks.", "dec_blocks2.", 1), value)
    return out


def parse_arguments(call: str) -> dict[str, Any]:
    """The keyword arguments of a constructor call written as text; numbers, strings, tuples and `inf` only.

    Raises ValueError for anything else.
    """
    try:
        node = ast.parse(call.strip(), mode="eval").body
    except (SyntaxError, RecursionError) as error:
        raise ValueError(f"not a constructor call: {call[:80]!r}") from error
    if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name) or node.args:
        raise ValueError(f"not a constructor call with keywords only: {call[:80]!r}")
    arguments = {}
    for keyword in node.keywords:
        if keyword.arg is None:
            raise ValueError(f"not a constructor call with keywords only: {call[:80]!r}")
        arguments[keyword.arg] = _literal(keyword.value)
    return arguments


def infer_architecture(state: Mapping[str, Tensor], arguments: Mapping[str, Any]) -> Architecture:
    """Sizes of the network from its tensors; numbers of heads and the rotary base from the arguments, if given."""
    _require_mast3r(state)

    def shape(key: str, axes: int = 1) -> torch.Size:
        if key not in state:
            raise _wrong(f"the checkpoint has no tensor {key}")
        found = state[key].shape
        if len(found) < axes or min(found) < 1:
            raise _wrong(f"{key} has shape {tuple(found)}, which no layer of the network has")
        return found

    def depth(blocks: str) -> int:
        return 1 + max((int(key.split(".")[1]) for key in state if key.startswith(blocks + ".")), default=-1)

    encoder_dim, _, patch, *_ = shape("patch_embed.proj.weight", 4)
    decoder_dim = shape("decoder_embed.weight")[0]
    dpt = "downstream_head1.dpt."
    local = shape("downstream_head1.head_local_features.fc2.weight", 2)
    inputs = [shape(f"{dpt}scratch.layer{i}_rn.weight", 2) for i in (1, 2, 3, 4)]
    base = re.fullmatch(r"RoPE(\d+(?:\.\d+)?)", str(arguments.get("pos_embed", "RoPE100")))
    if base is None:
        raise _wrong(f"the checkpoint's position embedding is {arguments['pos_embed']!r}, not rotary")
    return Architecture(
        encoder_dim=encoder_dim,
        encoder_depth=depth("enc_blocks"),
        encoder_heads=_heads(arguments.get("enc_num_heads"), encoder_dim),
        decoder_dim=decoder_dim,
        decoder_depth=depth("dec_blocks"),
        decoder_heads=_heads(arguments.get("dec_num_heads"), decoder_dim),
        mlp_ratio=shape("enc_blocks.0.mlp.fc1.weight")[0] // encoder_dim,
        patch=patch,
        rope_base=float(base[1]),
        dpt_layer_dims=(inputs[0][1], inputs[1][1], inputs[2][1], inputs[3][1]),
        dpt_feature_dim=inputs[0][0],
        dpt_last_dims=(shape(dpt + "head.0.weight")[0], shape(dpt + "head.2.weight")[0]),
        local_hidden_dim=local[1],
        descriptor_dim=local[0] // patch**2 - 1,
    )


def _read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    try:
        state = load_file(path)
    except (SafetensorError, OSError) as error:
        raise _damaged(path, error) from error
    beside = path.with_name("config.json")
    if not beside.is_file():
        return state, _metadata_arguments(path)
    try:
        arguments = json.loads(beside.read_text(encoding="utf-8"))
    except (ValueError, RecursionError, OSError) as error:
        raise _damaged(beside, error) from error
    if not isinstance(arguments, dict):
        raise _wrong(f"{beside} holds no settings of a network")
    return state, arguments


def _metadata_arguments(path: Path) -> dict[str, Any]:
    with safe_open(path, "pt") as file:
        metadata = file.metadata() or {}
    return _arguments(path, metadata["model"]) if "model" in metadata else {}


def _read_pth(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    if not zipfile.is_zipfile(path):
        raise _damaged(path, "it is not a complete torch archive")
    try:
        with torch.serialization.safe_globals([argparse.Namespace]):
            content = torch.load(str(path), map_location="cpu", weights_only=True, mmap=True)
    except pickle.UnpicklingError as error:
        raise WeightsError(
            f"{path} holds more than weights, and was not opened",
            cause=f"a .pth file can carry code, and this one asks for more than plain data ({_first_line(error)})",
            hint="use the published file, or ask its author for .safetensors",
        ) from error
    except (RuntimeError, OSError, EOFError, ValueError, KeyError) as error:
        raise _damaged(path, error) from error
    if isinstance(content, dict) and "dune_backbone_name" in content:
        raise _wrong(f"{path} is the DUNE variant of MASt3R, another network")
    state = content.get("model", content) if isinstance(content, dict) else None
    if not isinstance(state, dict) or not state or not all(isinstance(value, Tensor) for value in state.values()):
        raise _wrong(f"{path} holds no state dict")
    call = getattr(content.get("args"), "model", None)
    return dict(state), _arguments(path, call) if isinstance(call, str) else {}


def _arguments(path: Path, call: str) -> dict[str, Any]:
    try:
        return parse_arguments(call)
    except ValueError as error:
        raise _wrong(f"{path} describes its network in a way that cannot be read: {error}") from error


def _with_aliases(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The four input convolutions of each DPT under both published names."""
    out = dict(state)
    for key, value in state.items():
        if found := _ALIAS.search(key):
            number, index = found.groups()
            twin = f"layer_rn.{int(number) - 1}" if number else f"layer{int(index) + 1}_rn"
            other = f"{key[: found.start()]}.dpt.scratch.{twin}.{key[found.end() :]}"
            if other in state and not torch.equal(state[other], value):
                raise _wrong(f"{key} and {other} must be one tensor, and differ")
            out.setdefault(other, value)
    return out


def _check_keys(path: Path, state: Mapping[str, Tensor], model: Mast3r) -> None:
    expected = {key: tuple(value.shape) for key, value in model.state_dict().items()}
    given = {key: tuple(value.shape) for key, value in state.items()}
    if missing := sorted(expected.keys() - given.keys()):
        raise _wrong(f"{path} lacks {len(missing)} tensors of the network, the first {missing[0]}")
    if surplus := sorted(given.keys() - expected.keys()):
        raise _wrong(f"{path} holds {len(surplus)} tensors the network does not have, the first {surplus[0]}")
    for key, shape in expected.items():
        if given[key] != shape:
            raise _wrong(f"{path}: {key} has shape {given[key]}, the network needs {shape}")
        if not state[key].is_floating_point():
            raise _wrong(f"{path}: {key} holds {state[key].dtype}, not weights")


def _require_mast3r(state: Mapping[str, Tensor]) -> None:
    if "patch_embed.proj.weight" not in state:
        raise _wrong("the checkpoint has no patch embedding: it is not of the DUSt3R family")
    if "downstream_head1.head_local_features.fc1.weight" not in state:
        raise _wrong("the checkpoint predicts no descriptors: it is DUSt3R or CroCo, not MASt3R")


def _heads(given: Any, dim: int) -> int:
    heads = given if given is not None else max(1, dim // 64)
    if not isinstance(heads, int) or heads < 1 or dim % heads:
        raise _wrong(f"{heads!r} attention heads do not divide {dim} channels")
    return heads


def _literal(node: ast.expr) -> Any:
    match node:
        case ast.Constant(value=bool() | int() | float() | str() | None):
            return node.value
        case ast.Name(id="inf"):
            return math.inf
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            value = _literal(operand)
            if isinstance(value, int | float):
                return -value
        case ast.Tuple(elts=elements) | ast.List(elts=elements):
            return tuple(_literal(element) for element in elements)
    raise ValueError(f"not a plain value: {ast.unparse(node)[:80]!r}")


def _wrong(what: str) -> WeightsError:
    return WeightsError(what, cause="the file belongs to another model", hint=_DOWNLOAD)


def _damaged(path: Path, error: object) -> WeightsError:
    return WeightsError(
        f"{path} cannot be read: {_first_line(error)}",
        cause="the download stopped early or the disk is damaged",
        hint=_DOWNLOAD,
    )


def _first_line(error: object) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
