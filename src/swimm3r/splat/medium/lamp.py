"""The lamp of a map, which moves with the camera: `swimm3r.lamp`, trained with the water.

A primitive of color c is drawn with c L(X) exp(-beta_D |X - p|), X being its center in the camera's axes: only the way
from the surface to the camera is left to the water of the pixels. Trained are the beam and the pattern of the
backscatter. The lamp's position, strength and fall-off stay those of the reconstruction.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from swimm3r.lamp import TERMS, Lamp, lamp_distance, log_light
from swimm3r.splat.projection.view_camera import ViewCamera

NO_LIGHT = Lamp(torch.zeros(3), 1.0, 0.0, 1.0, torch.zeros(TERMS), torch.zeros(TERMS))
"""A lamp whose values are read from a file."""
_MOST, _LEAST = 4.0, -9.0  # of the logarithm of light: primitives behind the camera have any


class CameraLamp(nn.Module):
    """A lamp in working units."""

    position: Tensor
    reference: Tensor
    fall_off: Tensor
    strength: Tensor

    def __init__(self, lamp: Lamp) -> None:
        super().__init__()
        self.beam, self.veil = nn.Parameter(lamp.beam.float().clone()), nn.Parameter(lamp.veil.float().clone())
        for name in ("position", "reference", "fall_off", "strength"):
            self.register_buffer(name, torch.as_tensor(getattr(lamp, name)).float().clone())

    @property
    def lamp(self) -> Lamp:
        """The lamp as it is now; beam and pattern carry gradients."""
        numbers = (float(self.reference), float(self.fall_off), float(self.strength))
        return Lamp(self.position, *numbers, self.beam, self.veil)

    def light(
        self, xyz: Float[Tensor, "n 3"], view: ViewCamera, beta_D: Float[Tensor, "3"], length: Tensor
    ) -> Float[Tensor, "n 3"]:
        """Light on points of the world in scene units, `length` of which are a working unit; beta_D per scene unit."""
        points = (xyz @ view.R.mT + view.t) / length
        lamp = self.lamp
        way = lamp_distance(points, lamp)[:, None] * length
        return (log_light(points, lamp)[:, None] - beta_D * way).clamp(_LEAST, _MOST).exp()
