"""The water of a metric run as a table in 1/m, and what is derived from it.

The relative standard deviation of the scale adds to that of every coefficient. Derived, and marked so: the distance at
which a black target keeps 2% of its contrast against open water, 3.912 / beta_B, and the Jerlov type whose attenuation
is nearest on a logarithmic scale, by the channels that the frames determine.
"""

import math
from typing import Any

import torch

from swimm3r.medium import MediumFit
from swimm3r.water_types import JERLOV

RANGES = (1.0, 2.0, 3.0, 5.0, 8.0)  # metres of ray depth
_CONTRAST = -math.log(0.02)


def water_table(fit: MediumFit, scale_std: float) -> dict[str, Any]:
    """The section "water" of summary.json; `scale_std` is relative. Lists are R, G, B."""
    near, far = fit.z_range
    z = torch.tensor(RANGES)
    relative = {
        name: [_relative(value, error, scale_std) for value, error in zip(values, errors, strict=True)]
        for name in ("beta_D", "beta_B")
        for values, errors in [(getattr(fit, name).tolist(), getattr(fit.std, name).tolist())]
    }
    visibility = [_visibility(beta, share) for beta, share in zip(fit.beta_B.tolist(), relative["beta_B"], strict=True)]
    return {
        "unit": "1/m",
        "encoding": fit.encoding,
        "scale_std": scale_std,
        "Binf": {"value": fit.Binf.tolist(), "std": fit.std.Binf.tolist(), **_known(fit, "Binf")},
        "beta_D": {"value": fit.beta_D.tolist(), "std": _std(fit.beta_D, relative["beta_D"]), **_known(fit, "beta_D")},
        "beta_B": {"value": fit.beta_B.tolist(), "std": _std(fit.beta_B, relative["beta_B"]), **_known(fit, "beta_B")},
        "beta_D_at": [
            {
                "range_m": range_m,
                "value": beta.tolist(),
                "std": _std(beta, relative["beta_D"]),
                "within_data": near <= range_m <= far,
            }
            for range_m, beta in zip(RANGES, fit.at(z).beta_D, strict=True)
        ],
        "z_range_m": [near, far],
        "derived": {
            "visibility_m": [each[0] for each in visibility],
            "visibility_std_m": [each[1] for each in visibility],
            "visibility_of": "a black target that keeps 2% of its contrast, 3.912 / beta_B",
            **nearest_jerlov(fit, relative["beta_D"]),
        },
    }


def nearest_jerlov(fit: MediumFit, relative: list[float]) -> dict[str, Any]:
    """The Jerlov type nearest to beta_D, and by how many standard deviations it is off; None with the reason.

    Jerlov's types are about linear light: of a fit on stored pixel values there is none.
    """
    if fit.encoding != "linear":
        return {"jerlov": None, "jerlov_reason": "the coefficients are of stored pixel values, not of linear light"}
    known = [c for c, flag in enumerate(fit.identifiable["beta_D"].tolist()) if flag]
    if not known:
        return {"jerlov": None, "jerlov_reason": "the frames determine beta_D in no channel"}
    logs = fit.beta_D.clamp(min=1e-6).log().tolist()
    away = {
        kind: math.sqrt(
            sum((logs[c] - math.log(values[c])) ** 2 / max(relative[c], 0.05) ** 2 for c in known) / len(known)
        )
        for kind, values in JERLOV.items()
    }
    best = min(away, key=away.__getitem__)
    return {"jerlov": best, "jerlov_in_std": round(away[best], 2), "jerlov_channels": ["RGB"[c] for c in known]}


def _relative(value: float, std: float, scale_std: float) -> float:
    return math.hypot(std / value if value > 0 else 0.0, scale_std)


def _std(values: torch.Tensor, relative: list[float]) -> list[float]:
    return [value * share for value, share in zip(values.tolist(), relative, strict=True)]


def _known(fit: MediumFit, name: str) -> dict[str, list[bool]]:
    return {"identifiable": [bool(flag) for flag in fit.identifiable[name]]}


def _visibility(beta: float, share: float) -> tuple[float | None, float | None]:
    return (_CONTRAST / beta, _CONTRAST / beta * share) if beta > 0 else (None, None)
