"""Records beside rectified frames: the way from the images before them, and the lens that they have since."""

import json
from dataclasses import asdict, astuple, dataclass
from pathlib import Path

import numpy as np
import torch

from swimm3r.cameras import Cameras
from swimm3r.imaging.rectification import Rectification, from_key
from swimm3r.imaging.turned_rows import RowTurns
from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.damage import guard, remake
from swimm3r.io.files.json_file import read_json

_RECTIFICATION, _TURNS, _PINHOLE = "rectification.json", "turns.json", "cameras.txt"


@dataclass(frozen=True)
class _RectificationDocument:
    """rectification.json."""

    numbers: tuple[float, ...]
    width: int
    height: int
    rectified_width: int
    rectified_height: int


@dataclass(frozen=True)
class _TurnsDocument:
    """turns.json."""

    model: str
    width: int
    height: int
    K: tuple[tuple[float, float, float], ...]
    distortion: tuple[float, ...]
    turns: dict[str, tuple[float, float, float]]


def write_rectification(rectification: Rectification, folder: Path) -> None:
    """Write rectification.json."""
    _write(_RectificationDocument(*rectification.key), folder / _RECTIFICATION)


def read_rectification(folder: Path) -> Rectification:
    """Read rectification.json. Raises InputError where it is damaged."""
    path, remedy = folder / _RECTIFICATION, remake(folder)
    document = read_json(path, _RectificationDocument, remedy)
    with guard(path, remedy):
        return from_key(*astuple(document))


def write_pinhole(pinhole: Cameras, folder: Path) -> Path:
    """Write cameras.txt, the lens of rectified frames as their source would state it, and return its path."""
    focal, middle = pinhole.K[0, 0, 0].item(), f"{pinhole.width / 2} {pinhole.height / 2}"
    path = folder / _PINHOLE
    write_text(path, f"1 PINHOLE {pinhole.width} {pinhole.height} {focal!r} {focal!r} {middle}\n")
    return path


def write_turns(found: RowTurns, folder: Path) -> None:
    """Write turns.json."""
    lens = found.lens
    K = tuple((a, b, c) for a, b, c in lens.K[0].double().tolist())
    turns = {name: (x, y, z) for name, (x, y, z) in ((name, turn.tolist()) for name, turn in found.turns.items())}
    distortion = tuple(lens.distortion[0].double().tolist())
    _write(_TurnsDocument(lens.model, lens.width, lens.height, K, distortion, turns), folder / _TURNS)


def read_turns(folder: Path) -> RowTurns:
    """Read turns.json. Raises InputError where it is damaged."""
    path, remedy = folder / _TURNS, remake(folder)
    document = read_json(path, _TurnsDocument, remedy)
    with guard(path, remedy):
        K = torch.tensor(document.K, dtype=torch.float64).reshape(1, 3, 3)
        distortion = torch.tensor(document.distortion, dtype=torch.float64)[None]
        origin = torch.eye(4, dtype=torch.float64)[None]
        lens = Cameras(K, distortion, origin, document.width, document.height, document.model)
    return RowTurns(lens, {name: np.array(turn) for name, turn in document.turns.items()})


def _write(document: _RectificationDocument | _TurnsDocument, path: Path) -> None:
    write_text(path, json.dumps(asdict(document), indent=1) + "\n")
