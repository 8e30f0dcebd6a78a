"""Tensors under their names in a safetensors file, everything else as a JSON record in its header."""

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from types import GenericAlias
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from swimm3r.io.files.atomic import atomic_path
from swimm3r.io.files.damage import Remedy, guard
from swimm3r.io.files.json_file import decode, structure

_KEY = "swimm3r"
T = TypeVar("T")


@dataclass(frozen=True)
class TensorFile(Generic[T]):
    """The tensors of a file and the record in its header."""

    tensors: dict[str, Tensor]
    about: T


def write_tensors(path: Path, tensors: Mapping[str, Tensor], about: Mapping[str, Any]) -> None:
    """Write tensors and header, whole or not at all."""
    stored = {name: values.detach().cpu().contiguous() for name, values in tensors.items()}
    with atomic_path(path) as draft:
        save_file(stored, draft, {"format": "pt", _KEY: json.dumps(about, sort_keys=True)})


def read_tensors(
    path: Path,
    kind: type[T] | GenericAlias,
    remedy: Remedy,
    schema: int | Collection[int] | None,
    *,
    finite: bool = True,
) -> TensorFile[T]:
    """Tensors, finite ones unless told otherwise, and the header as a record of `json_file`, of this `schema` if any.

    Raises the remedy's error, which names the file and the fault.
    """
    with guard(path, remedy):
        path.open("rb").close()  # the operating system's own word on a file that is missing or a folder
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
            if _KEY not in header:
                raise ValueError("it has no Swimm3R header")
            document = decode(header[_KEY])
            if schema is not None:
                _check_schema(document, (schema,) if isinstance(schema, int) else schema)
            about = structure(document, kind)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        for name, values in tensors.items():
            if finite and values.is_floating_point() and not bool(torch.isfinite(values).all()):
                raise ValueError(f"{name} has values that are not finite")
        return TensorFile(tensors, about)


def tensors_digest(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of tensors and their names, as float32: the same in whatever order and precision a file holds them."""
    digest = sha256()
    for name in sorted(tensors):
        values = np.ascontiguousarray(tensors[name].detach().float().cpu().numpy(), dtype="<f4")
        digest.update(f"{name}{values.shape}".encode())
        digest.update(values.data)
    return digest.hexdigest()


def _check_schema(document: Any, known: Collection[int]) -> None:
    found = document.get("schema") if isinstance(document, dict) else None
    if found in known:
        return
    by_whom = (
        f"it was written by {'a newer' if found > max(known) else 'an older'} Swimm3R: "
        if isinstance(found, int)
        else ""
    )
    raise ValueError(f"{by_whom}its schema is {found}, this version reads {' and '.join(map(str, sorted(known)))}")
