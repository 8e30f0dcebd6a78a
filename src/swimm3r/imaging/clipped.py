"""Values at which a camera's sensor was full: the surface was at least as bright, and nothing more is known."""

from jaxtyping import Bool, Float
from torch import Tensor

CLIPPED = 0.98
"""The least of such values as stored: compression moves 255 of 255 by a few levels."""


def clipped(I: Float[Tensor, "*values"], level: float = CLIPPED) -> Bool[Tensor, "*values"]:
    """Mask of the values of images as stored, 0..1, that are clipped."""
    return I.ge(level)
