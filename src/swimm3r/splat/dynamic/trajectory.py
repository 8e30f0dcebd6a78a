"""Trajectory triangulation: the path of a moving object from the rays of one moving camera at many times.

At every time it lies on a known ray; of all courses along the rays the slow and steady one is taken, the minimum of

    |projection - pixel|^2 / s_p^2 + |v / z|^2 / s_v^2 + |a / z|^2 / s_a^2 + log(z / assumed)^2 / s_z^2

over all times, v the velocity and a the acceleration, which count as angles, or what is near would always seem the
slower. That is trajectory triangulation (Avidan & Shashua 2000; Park et al. 2010) with priors: a camera that goes
another way than the thing determines the distance, and one that does not leaves it as assumed.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.functional import jacobian

from swimm3r.cameras import Cameras, directions, unproject

_PIXEL = 1.5  # s_p
_VELOCITY = 0.1  # s_v, radians per unit of time
_ACCELERATION = 1.5e-3  # s_a, radians per unit of time squared
_DEPTH = 1.0  # s_z: a factor of e is one standard deviation
_ROUNDS = 60
_ENOUGH = 1e-6  # relative gain of a round that is the last


def course(
    cameras: Cameras, pixels: Float[Tensor, "n 2"], times: Float[Tensor, " n"], z_depth: Float[Tensor, " n"]
) -> Float[Tensor, "n 3"]:
    """Positions, float64, of what camera k sees at pixel k at time k (rising), if it is about `z_depth` away.

    `times` count in intervals between frames, which the priors are made for. Levenberg-Marquardt over all positions.
    """
    assumed, pixels = z_depth.double(), pixels.double()
    rotation, centers = cameras.cam2world[:, :3, :3].double(), cameras.centers.double()
    bearing = directions(cameras, pixels[:, None])[:, 0, :2]
    focal = cameras.K[:, 0, 0].double()
    steady = _steadiness(times.double())
    around = (steady != 0).double()
    around /= around.sum(1, keepdim=True)

    def errors(xyz: Float[Tensor, "n 3"]) -> Float[Tensor, " rows"]:
        local = torch.einsum("nij,ni->nj", rotation, xyz - centers)
        z = local[:, 2]
        off = (local[:, :2] / z[:, None] - bearing) * focal[:, None] / _PIXEL
        unsteady = steady @ xyz / (around @ z)[:, None]
        return torch.cat([off.flatten(), (z / assumed).log() / _DEPTH, unsteady.flatten()])

    xyz = unproject(cameras, pixels[:, None], assumed[:, None])[:, 0]
    now, damping = errors(xyz), 1e-3
    for _ in range(_ROUNDS):
        J = jacobian(errors, xyz, vectorize=True).flatten(1)
        normal = J.mT @ J
        step = torch.linalg.solve(normal + damping * torch.diag(normal.diagonal()), J.mT @ now)
        moved = xyz - step.reshape(-1, 3)
        then = errors(moved)
        gain = 1 - float(then.square().sum() / now.square().sum())  # not a number behind a camera: no gain
        if gain > 0:
            xyz, now, damping = moved, then, damping / 5
        else:
            damping *= 5
        if 0 <= gain < _ENOUGH or damping > 1e9:
            break
    return xyz


def _steadiness(times: Float[Tensor, " n"]) -> Float[Tensor, "rows n"]:
    """Velocity and acceleration of a course over their standard deviations, as a linear map of its positions.

    Each counts in proportion to the time it lasts, so that a missing frame does not change what a course is worth.
    """
    n, gap = len(times), times.diff()
    velocity = torch.zeros(n - 1, n, dtype=torch.float64)
    k = torch.arange(n - 1)
    velocity[k, k], velocity[k, k + 1] = -1 / gap, 1 / gap
    span = (gap[1:] + gap[:-1]) / 2
    acceleration = velocity.diff(dim=0) / span[:, None]
    return torch.cat([velocity * gap.sqrt()[:, None] / _VELOCITY, acceleration * span.sqrt()[:, None] / _ACCELERATION])
