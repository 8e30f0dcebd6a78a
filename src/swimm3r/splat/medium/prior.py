"""The prior of a map's water: the reconstruction's coefficients with their standard deviations."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.medium import MediumFit
from swimm3r.splat.medium.field import FieldGrid
from swimm3r.splat.shared_settings import MediumFieldSettings


def with_binf_prior(fit: MediumFit, color: Float[Tensor, "3"], std: float) -> MediumFit:
    """The fit with Binf drawn to `color` (0..1, within `std`) by what it does not know; backscatter in range stays.

    It stays as far as the new Binf can give it. Frames that never look far enough leave Binf open, and a map shows it
    wherever no frame has looked.
    """
    spread = fit.std.Binf.square()
    sure = std**2 / (std**2 + spread)
    Binf = sure * fit.Binf + (1 - sure) * color.to(fit.Binf)
    z = math.sqrt(fit.z_range[0] * fit.z_range[1])
    B = fit.Binf * -torch.expm1(-fit.beta_B * z)
    beta_B = -torch.log1p(-(B / Binf.clamp(min=1e-6)).clamp(max=0.999)) / z
    return replace(
        fit,
        Binf=Binf,
        beta_B=beta_B,
        std=replace(fit.std, Binf=(sure * spread).sqrt()),
    )


@dataclass(frozen=True)
class WaterPrior:
    """Prior of the water from the reconstruction: Binf, then ln beta_B and ln beta_D, in the field's order."""

    mean: Float[Tensor, "9"]
    std: Float[Tensor, "9"]


def water_prior(fit: MediumFit, length: float, settings: MediumFieldSettings) -> WaterPrior:
    """The prior of a fit for a field whose betas are per `length` scene units."""

    def logs(name: str) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        beta = getattr(fit, name).double().clamp(min=1e-6)
        return torch.log(beta * length), getattr(fit.std, name).double() / beta

    mean_B, std_B = logs("beta_B")
    mean_D, std_D = logs("beta_D")
    std = torch.cat([fit.std.Binf.double(), std_B, std_D])
    return WaterPrior(torch.cat([fit.Binf.double(), mean_B, mean_D]).float(), std.clamp(min=settings.least_std).float())


def deviation(grid: FieldGrid, prior: WaterPrior) -> Float[Tensor, ""]:
    """Mean pseudo-Huber deviation of the field from the prior, in its standard deviations d: 2 sqrt(1 + d^2) - 2.

    It is d^2 near the prior and 2 |d| far from it: open water that is twice as bright to one side must stay possible.
    """
    here = torch.cat([grid.values[:3], grid.values[3:].clamp(min=1e-6).log()])
    d = (here - prior.mean[:, None, None]) / prior.std[:, None, None]
    return 2 * ((1 + d.square()).sqrt() - 1).mean()
