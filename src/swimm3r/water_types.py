"""The four families of water of the paper, for augmentation and for synthetic dives; Jerlov's types, to look at.

    Binf ~ U(family), beta_D,R ~ U(0.3, 2.0) (cyan: U(0.7, 1.6)), beta_D,G, beta_D,B ~ U(0.04, 0.85),
    beta_B = r beta_D with r ~ U(0, 1) per channel            (paper, "Parametric water-type augmentation")

Coefficients are 1/m and act on pixel values as stored (sRGB), as the paper applies them.

Jerlov's optical water types are classes by the attenuation of downward daylight, and act on linear light. Here both
coefficients are that attenuation, and the veiling light has the color of the daylight that is left at `_JERLOV_DEPTH`.
"""

from dataclasses import dataclass
from typing import Literal

import torch

from swimm3r.medium import Medium

Family = Literal["cyan", "teal", "green", "warm"]
Interval = tuple[float, float]


@dataclass(frozen=True)
class WaterType:
    """Ranges of the coefficients of one family, per RGB channel."""

    Binf: tuple[Interval, Interval, Interval]
    beta_D: tuple[Interval, Interval, Interval]  # 1/m


_CLEAR_CHANNEL = (0.04, 0.85)
FAMILIES: dict[Family, WaterType] = {
    "cyan": WaterType(
        ((0.02, 0.08), (0.30, 0.50), (0.30, 0.45)),
        ((0.7, 1.6), _CLEAR_CHANNEL, _CLEAR_CHANNEL),  # red nearly gone: the regime where it can only be guessed
    ),
    "teal": WaterType(((0.05, 0.15), (0.45, 0.70), (0.30, 0.55)), ((0.3, 2.0), _CLEAR_CHANNEL, _CLEAR_CHANNEL)),
    "green": WaterType(((0.10, 0.25), (0.30, 0.50), (0.10, 0.30)), ((0.3, 2.0), _CLEAR_CHANNEL, _CLEAR_CHANNEL)),
    "warm": WaterType(((0.20, 0.40), (0.15, 0.30), (0.10, 0.25)), ((0.3, 2.0), _CLEAR_CHANNEL, _CLEAR_CHANNEL)),
}

JerlovType = Literal["I", "IA", "IB", "II", "III", "1C", "3C", "5C", "7C", "9C"]
JERLOV: dict[JerlovType, tuple[float, float, float]] = {  # 1/m at 600, 525 and 475 nm
    "I": (0.235, 0.043, 0.018),
    "IA": (0.24, 0.048, 0.025),
    "IB": (0.245, 0.054, 0.033),
    "II": (0.26, 0.076, 0.062),
    "III": (0.295, 0.116, 0.116),
    "1C": (0.30, 0.13, 0.17),
    "3C": (0.33, 0.20, 0.29),
    "5C": (0.40, 0.31, 0.43),
    "7C": (0.48, 0.49, 0.71),
    "9C": (0.60, 0.78, 1.23),
}
"""Attenuation of downward daylight (Jerlov 1976, Marine Optics, Table XXVII): oceanic types I (clearest) to III,
coastal types 1C to 9C (most turbid)."""
_JERLOV_DEPTH = 5.0  # metres of water above the camera
_JERLOV_VEIL = 0.4  # largest channel of the veiling light, linear


def jerlov(kind: JerlovType) -> Medium:
    """The medium of a Jerlov type, 1/m, on linear light."""
    beta = torch.tensor(JERLOV[kind])
    daylight = torch.exp(-beta * _JERLOV_DEPTH)
    return Medium(_JERLOV_VEIL * daylight / daylight.max(), beta, beta)


def typical(family: Family) -> Medium:
    """The middle of a family's ranges, 1/m, on pixel values as stored; beta_B is half of beta_D."""
    water = FAMILIES[family]
    Binf, beta_D = (torch.tensor(ranges).mean(-1) for ranges in (water.Binf, water.beta_D))
    return Medium(Binf, beta_D, beta_D / 2)


def sample(family: Family, generator: torch.Generator) -> Medium:
    """One water of a family: fields of shape [3], float32."""
    water = FAMILIES[family]
    beta_D = _uniform(water.beta_D, generator)
    return Medium(_uniform(water.Binf, generator), beta_D, beta_D * torch.rand(3, generator=generator))


def draw(generator: torch.Generator, probability: float = 0.5) -> Medium | None:
    """With that probability one water of a family drawn evenly, else None: the augmentation of the paper.

    `add_water` with it turns a clear image into a student's; both frames of a pair take the same water.
    """
    if torch.rand(1, generator=generator).item() >= probability:
        return None
    names = list(FAMILIES)
    return sample(names[int(torch.randint(len(names), (1,), generator=generator))], generator)


def _uniform(intervals: tuple[Interval, Interval, Interval], generator: torch.Generator) -> torch.Tensor:
    low, high = torch.tensor(intervals).unbind(-1)
    return low + (high - low) * torch.rand(3, generator=generator)
