"""Values at which a camera's sensor was full: the surface was at least as bright, and nothing more is known."""

from jaxtyping import Bool, Float
from torch import Tensor

CLIPPED = 250 / 255
"""The least of such values as stored, 0..1; compression moves them, 255 before it, by a few levels."""


def clipped(I: Float[Tensor, "*values"]) -> Bool[Tensor, "*values"]:
    """Mask of the values of images as stored, 0..1, that are clipped."""
    return I >= CLIPPED
