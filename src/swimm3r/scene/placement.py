"""A model of structure from motion placed by another instrument, before it has a unit or a place of its own."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sim3 import Sim3


@dataclass(frozen=True)
class Placement:
    """The similarity from a model to the local metres of its navigation, and where that saw the cameras."""

    local_from_model: Sim3
    scale_std: float  # relative
    rotation_std_deg: float  # about the axis that is known worst
    names: tuple[str, ...]  # frames with a position
    position: Float[np.ndarray, "k 3"]  # of the cameras, local metres
    std: Float[np.ndarray, "k 3"]  # metres; infinite where a coordinate is not known
    offset: float | None  # seconds added to the frames' times


@runtime_checkable
class Navigator(Protocol):
    """Places models of one clip in common local metres."""

    def place(self, rec: Reconstruction, frames: Frames) -> Placement:
        """The placement of a model. Raises InputError where the navigation contradicts it."""
        ...

    def place_part(self, rec: Reconstruction, frames: Frames, beside: Placement) -> Placement | None:
        """The placement of another model of the clip; None where the navigation does not hold it."""
        ...
