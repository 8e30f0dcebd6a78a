"""Frames that a camera exposed and balanced each by itself (`swimm3r.appearance`), in training.

Training compares in the colors that the dive has on average: a view is handed out as M_f^-1 (e^(-s_f) I_f - b_f), so
that every recipe is served alike; a frame's map is applied after the water. The first maps are those of the sparse
tracks (`imaging.appearance`), which also decide before training whether there are any; a few times during training they
are fitted again to what the map shows by then.
"""

import json
from dataclasses import asdict
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.appearance import ORDERS, ColorFit, image_cosines
from swimm3r.imaging.appearance import AppearanceDecision
from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.damage import Remedy
from swimm3r.io.files.json_file import read_json

_FILE = "appearance.json"
_STAY_GAIN, _STAY_MIX = 1e-4, 3e-3  # hold of a refit to the map of before: gains, and mixing or offsets


def fit_to_view(
    render: Float[Tensor, "3 h w"], target: Float[Tensor, "3 h w"], seen: Float[Tensor, "h w"], *, shaded: bool = False
) -> ColorFit:
    """The map from a rendering to a view, held to the identity where the view's colors do not tell.

    A shading, alike in all channels, is found together with the affine map, to first order in both.
    """
    weight = seen.reshape(-1).double()
    x = torch.cat([render, torch.ones_like(render[:1])]).reshape(4, -1).double()
    y = target.reshape(3, -1).double()
    waves = image_cosines(*render.shape[1:]).to(x).reshape(len(ORDERS), -1) if shaded else x[:0]
    stay = torch.full((4,), _STAY_MIX, dtype=torch.float64, device=x.device)
    stay = torch.cat([stay, torch.full((len(waves),), _STAY_GAIN / 3).to(stay)]) * weight.sum().clamp(min=1.0)
    system, products = x.new_zeros(12 + len(waves), 12 + len(waves)), x.new_zeros(12 + len(waves))
    for c in range(3):
        terms = torch.cat([x, waves * x[c]])
        own = stay.clone()
        own[c] *= _STAY_GAIN / _STAY_MIX
        rows = torch.cat([4 * c + torch.arange(4), 12 + torch.arange(len(waves))]).to(x.device)
        system[rows[:, None], rows] += (terms * weight) @ terms.mT + own.diag()
        products[rows] += (terms * weight) @ y[c] + own * (torch.arange(len(terms)) == c).to(own)
    found = torch.linalg.solve(system, products)
    maps = found[:12].reshape(3, 4)
    shading = found[12:, None] / maps[:, :3].diagonal().mean()
    return ColorFit(maps.float(), shading.expand(-1, 3).float() if shaded else None)


def write_decision(folder: Path, decision: AppearanceDecision) -> None:
    """Write appearance.json beside the map."""
    write_text(folder / _FILE, json.dumps(asdict(decision), indent=2) + "\n")


def read_decision(folder: Path) -> AppearanceDecision | None:
    """Read what `write_decision` wrote; None beside a map without it. Raises InputError where it is damaged."""
    path = folder / _FILE
    if not path.is_file():
        return None
    remedy = Remedy(f"remove {folder}; the command that trained the map trains it again")
    return read_json(path, AppearanceDecision, remedy)
