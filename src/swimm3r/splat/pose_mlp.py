"""The pose MLP of 3R-GS: one code per camera, and the network that reads the camera's motion from it.

    cam2world_i' = cam2world_i [R(w_i) | spread v_i],   (v_i, w_i) = MLP(code_i)

Codes and last layer are zero at first and w is added to the 6D form of the identity: training starts from given poses.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from swimm3r.geometry import pose_from, rotation_from_6d
from swimm3r.splat.shared_settings import TrainingPoseSettings

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)  # in the 6D form


class PoseMlp(nn.Module):
    """One code per camera, and the network that reads motions from them."""

    def __init__(self, cameras: int, settings: TrainingPoseSettings, rng: torch.Generator | None = None) -> None:
        super().__init__()
        width = settings.width
        self.codes = nn.Parameter(torch.zeros(cameras, width))
        self.network = nn.Sequential(
            nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 9)
        )
        with torch.no_grad():
            for layer in (self.network[0], self.network[2]):
                assert isinstance(layer, nn.Linear)
                bound = 1 / math.sqrt(width)  # torch's own default, but from our generator
                layer.weight.uniform_(-bound, bound, generator=rng)
                layer.bias.uniform_(-bound, bound, generator=rng)
            last = self.network[4]
            assert isinstance(last, nn.Linear)
            last.weight.zero_()
            last.bias.zero_()

    def forward(self, which: Int[Tensor, " k"]) -> Float[Tensor, "k 9"]:
        """The motions (v, w) of some cameras."""
        return self.network(self.codes[which])


def moved(cam2world: Float[Tensor, "*k 4 4"], motion: Float[Tensor, "*k 9"], length: float) -> Float[Tensor, "*k 4 4"]:
    """Poses after motions (v, w) in their own cameras' axes, v in units of `length`."""
    motion = motion.to(cam2world)
    rotation = rotation_from_6d(motion[..., 3:] + torch.tensor(IDENTITY).to(motion))
    return cam2world @ pose_from(rotation, motion[..., :3] * length)


def pose_rate(settings: TrainingPoseSettings, iterations: int) -> float:
    """Adam's rate for the poses: `rate` in 20,000 steps, in inverse proportion to others."""
    return min(settings.largest_rate, settings.rate * 20_000 / iterations)
