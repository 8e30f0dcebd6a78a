"""Real orthonormal spherical harmonics of degrees 0..3, by degree and order, without the Condon-Shortley sign."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

HARMONICS = 16
Y_00 = 0.5 / math.sqrt(math.pi)


def spherical_harmonics(d: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 16"]:
    """Real orthonormal spherical harmonics of degrees 0..3 of unit vectors."""
    x, y, z = d.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    pi = math.pi
    return torch.stack(
        [
            torch.full_like(x, 0.5 / math.sqrt(pi)),
            math.sqrt(3 / (4 * pi)) * y,
            math.sqrt(3 / (4 * pi)) * z,
            math.sqrt(3 / (4 * pi)) * x,
            0.5 * math.sqrt(15 / pi) * x * y,
            0.5 * math.sqrt(15 / pi) * y * z,
            0.25 * math.sqrt(5 / pi) * (3 * zz - 1),
            0.5 * math.sqrt(15 / pi) * x * z,
            0.25 * math.sqrt(15 / pi) * (xx - yy),
            0.25 * math.sqrt(35 / (2 * pi)) * y * (3 * xx - yy),
            0.5 * math.sqrt(105 / pi) * x * y * z,
            0.25 * math.sqrt(21 / (2 * pi)) * y * (5 * zz - 1),
            0.25 * math.sqrt(7 / pi) * z * (5 * zz - 3),
            0.25 * math.sqrt(21 / (2 * pi)) * x * (5 * zz - 1),
            0.25 * math.sqrt(105 / pi) * z * (xx - yy),
            0.25 * math.sqrt(35 / (2 * pi)) * x * (xx - 3 * yy),
        ],
        -1,
    )
