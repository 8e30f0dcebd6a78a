"""Depth that the water's color tells of surfaces without measured depth.

A surface at ray depth z shows I = B(z) + T(z) J + n (Eq. 3). Where the water is known, surfaces of known depth tell
which J the frame has, mean m and covariance S, so that

    I | z  ~  N(B + T m, T S T + noise^2)

for a surface of any kind at z. Over depths that are as likely before as any in proportion, this gives the mean and the
variance of 1/z: narrow where haze or a lamp's fall-off change quickly with distance, as wide as before where they do
not. The radiance cube of Meng et al. (2013), "Efficient image dehazing with boundary constraint and contextual
regularization", is the bound of the same statement.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from swimm3r.imaging.depth_completion import DepthCue, filled_range, on_grid
from swimm3r.medium import MediumFit, backscatter, transmittances
from swimm3r.scene.reconstruction import DepthMap

_NOISE = 0.01  # of a cell's color, and of the water's
_LEAST_VARIANCE = 1e-4  # of J along any direction of color
_DEPTHS = 16  # that are tried
_FEWEST = 30  # cells of known depth that tell the frame's colors
_SAMPLES = 500  # of them that tell how well colors tell depth
_LEAST_ERROR = 0.02  # of the depth that colors tell
_WEIGHT = 1e-7  # as a confidence, where colors tell depth as well as its mean does: neighbors err alike
_MOST = 100.0  # times that weight


def depth_from_color(
    I: Float[Tensor, "h w 3"],
    depth: DepthMap,
    sea: Float[Tensor, "h w"],
    rays: Float[Tensor, "h w 3"],
    fit: MediumFit,
) -> DepthCue | None:
    """Depth that the colors `I`, in the encoding of `fit`, tell on the grid of `fill_z_depth`; None where too little is
    known.

    `rays` are the pixels' directions with z = 1. How far colors are to be believed is measured on the frame itself:
    with r = spread of 1/z over the known cells / error of the 1/z that color tells there, cells weigh as r^4. Weight
    and power were chosen on the clips of docs/experiments/medium.md.
    """
    known = (depth.z_depth > 0).float()
    share = on_grid(known)
    measured = share > 0.5
    if int(measured.sum()) < _FEWEST:
        return None
    unit = normalize(torch.nan_to_num(rays, nan=0.0), dim=-1)
    view = _Cells(
        on_grid(I.permute(2, 0, 1)).permute(1, 2, 0),
        normalize(on_grid(unit.permute(2, 0, 1)).permute(1, 2, 0), dim=-1),
        on_grid(torch.nan_to_num(rays.norm(dim=-1), nan=1.0)),
        fit,
    )
    z = on_grid(depth.z_depth) / share.clamp(min=1e-6)
    mean, covariance = view.colors(z, measured)

    nearest, farthest = filled_range(1 / depth.z_depth[depth.z_depth > 0])
    depths = torch.linspace(-math.log(nearest), -math.log(farthest), _DEPTHS).exp()
    some = torch.zeros_like(measured)
    places = torch.nonzero(measured)
    some[tuple(places[:: max(1, len(places) // _SAMPLES)].T)] = True
    asked = some | (~measured & (on_grid(sea) < 0.5))
    likelihood = view.log_likelihoods(depths, asked, mean, covariance)
    inverse, precision = _moments(1 / depths, likelihood)

    at_known, true = some[asked], 1 / z[some]
    error = max(_LEAST_ERROR**2, float((inverse[at_known] / true - 1).square().mean()))
    told = torch.minimum(precision, 1 / (error * inverse.square()))
    spread = float((true / true.mean()).var())
    weight = _WEIGHT * min(_MOST, (spread / error) ** 2) * true.median().square()
    cue = DepthCue(torch.ones_like(z), torch.zeros_like(z))
    cue.inverse[asked], cue.trust[asked] = inverse.float(), (weight * told).float()
    cue.trust[measured] = 0.0
    return cue


@dataclass(frozen=True)
class _Cells:
    """A frame on the grid, under its water."""

    color: Float[Tensor, "r c 3"]
    direction: Float[Tensor, "r c 3"]  # unit
    per_z: Float[Tensor, "r c"]  # ray depth over z-depth
    fit: MediumFit

    def water(
        self, z: Float[Tensor, " n"], where: Bool[Tensor, "r c"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """T and B of the cells `where`, at z-depth `z`."""
        path = z * self.per_z[where]
        medium = self.fit.at(path, self.direction[where])
        return transmittances(path, medium)[0], backscatter(path, medium)

    def colors(
        self, z: Float[Tensor, "r c"], measured: Bool[Tensor, "r c"]
    ) -> tuple[Float[Tensor, "3"], Float[Tensor, "3 3"]]:
        """Mean and covariance of J over the measured cells, each channel weighed by what arrives of it."""
        T, B = self.water(z[measured], measured)
        arrives = self.color[measured] - B
        mean = (T * arrives).sum(0) / T.square().sum(0).clamp(min=1e-9)
        rest = arrives - T * mean
        covariance = ((rest.T @ rest) / (T.T @ T).clamp(min=1e-9)).double()
        values, vectors = torch.linalg.eigh(covariance)
        return mean, ((vectors * values.clamp(min=_LEAST_VARIANCE)) @ vectors.T).float()

    def log_likelihoods(
        self,
        depths: Float[Tensor, " d"],
        where: Bool[Tensor, "r c"],
        mean: Float[Tensor, "3"],
        covariance: Float[Tensor, "3 3"],
    ) -> Float[Tensor, "d n"]:
        """ln p(I | z) of the cells `where` at each of the depths."""
        found = []
        for z in depths:
            T, B = self.water(z.expand(int(where.sum())), where)
            varies = T[:, :, None] * covariance * T[:, None, :] + _NOISE**2 * torch.eye(3)
            lower = torch.linalg.cholesky(varies)
            off = torch.linalg.solve_triangular(lower, (self.color[where] - B - T * mean)[..., None], upper=False)
            found.append(-0.5 * off[..., 0].square().sum(-1) - lower.diagonal(dim1=-2, dim2=-1).log().sum(-1))
        return torch.stack(found)


def _moments(
    inverse: Float[Tensor, " d"], log_likelihood: Float[Tensor, "d n"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Mean of 1/z, and its precision beyond that of not having looked."""
    probability = torch.softmax(log_likelihood.double(), 0)
    values = inverse.double()[:, None]
    mean = (probability * values).sum(0)
    variance = (probability * (values - mean).square()).sum(0)
    before = values.var(correction=0)
    return mean, (1 / variance.clamp(min=1e-6 * before) - 1 / before).clamp(min=0)
