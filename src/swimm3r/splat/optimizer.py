"""Adam over named tensors whose rows come and go (eps 1e-15, as all 3DGS code has it).

The one place where tensors are changed in place: at 35 numbers per primitive a copy would cost as much as the step.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.optim.adam import adam

BETA_1, BETA_2, EPS = 0.9, 0.999, 1e-15


@dataclass(frozen=True)
class Moments:
    """Adam's running means of a gradient and of its square; each tensor counts its own steps."""

    first: Tensor
    second: Tensor
    steps: Tensor  # float32 scalar


def fresh(parameter: Tensor) -> Moments:
    """Moments before the first step."""
    return Moments(torch.zeros_like(parameter), torch.zeros_like(parameter), torch.zeros((), device=parameter.device))


def adam_step(
    parameters: dict[str, Tensor], gradients: dict[str, Tensor], moments: dict[str, Moments], rates: dict[str, float]
) -> None:
    """One step of every parameter at its own rate."""
    for name, parameter in parameters.items():
        m = moments[name]
        adam(
            [parameter], [gradients[name]], [m.first], [m.second], [], [m.steps],
            fused=True, amsgrad=False, beta1=BETA_1, beta2=BETA_2, lr=rates[name], weight_decay=0.0, eps=EPS,
            maximize=False,
        )  # fmt: skip


def log_linear(start: float, end: float, share: float) -> float:
    """A rate that falls evenly in its logarithm while `share` goes from 0 to 1."""
    return float(
        torch.tensor(start, dtype=torch.float64) ** (1 - share) * torch.tensor(end, dtype=torch.float64) ** share
    )
