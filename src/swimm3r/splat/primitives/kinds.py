"""The kinds of primitives, and the check that the tensors of a file are of one kind."""

from collections.abc import Mapping
from typing import Any, get_type_hints

import torch
from torch import Tensor

from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.primitives.gaussian import GaussianPrimitives, harmonics_of_degree

Primitives = BetaPrimitives | GaussianPrimitives
"""Primitives that can be projected."""


def primitives_from(
    tensors: Mapping[str, Tensor], kind: type[Primitives], prefix: str, *, may_be_empty: bool = False
) -> Primitives:
    """The primitives among a file's tensors; without footprints those of a map without filter.

    Raises KeyError or ValueError where their parts do not fit each other.
    """
    own = {name: tensors[prefix + name] for name in kind._fields if prefix + name in tensors or name != "footprint"}
    p: Any = kind(**{"footprint": torch.zeros(len(own["xyz"])), **own})
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if not isinstance(getattr(p, name), hint):
            raise ValueError(f"{prefix}{name} has the shape {tuple(getattr(p, name).shape)}")
    if {len(values) for values in p} != {len(p.xyz)}:
        raise ValueError("its primitives' parts are of different lengths")
    if not len(p.xyz) and not may_be_empty:
        raise ValueError("it holds no primitives")
    if not _fit_together(p):
        raise ValueError(f"its primitives' parts are {', '.join(str(tuple(v.shape[1:])) for v in p)} numbers wide")
    return p


def _fit_together(p: Primitives) -> bool:
    match p:
        case BetaPrimitives():
            conditioned = p.query_mean.shape[1]  # direction; in dynamic maps time, too
            D = 3 + conditioned
            widths = p.beta.shape[1], p.scale.shape[1], p.lower.shape[1]
            return conditioned in (3, 4) and widths == (1 + conditioned, D, D * (D - 1) // 2)
        case GaussianPrimitives():
            return p.harmonics.shape[1] in {harmonics_of_degree(degree) for degree in range(4)}
