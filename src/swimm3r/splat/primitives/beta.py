"""Beta primitives: what one stores, its activations, and the set that training starts from.

Derived in docs/derivations/beta-primitives.md.

    V = L L^T,   L = [[R diag(s_1..3), 0], [L21, L22]],   R = I + A,   A antisymmetric

is a primitive's covariance over position and query q, the view direction (D = 6) or direction and time (D = 7). Stored
values are before activation: opacity = sigmoid, exponent B = 4 exp, scales s = softplus, which is also L22's diagonal.
"""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import softplus

from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.splat.primitives.start import mean_directions, starting_points
from swimm3r.splat.settings import InitialSettings


class BetaPrimitives(NamedTuple):
    """n primitives over c conditioned dimensions, as trained; float32."""

    xyz: Float[Tensor, "n 3"]  # world
    query_mean: Float[Tensor, "n c"]  # mean direction camera -> primitive (not of unit length), then time
    rgb: Float[Tensor, "n 3"]  # clear color, not bounded
    opacity: Float[Tensor, " n"]
    beta: Float[Tensor, "n b"]  # 1 + c: spatial, then one per conditioned dimension
    scale: Float[Tensor, "n d"]  # 3 + c
    lower: Float[Tensor, "n l"]  # strict lower triangle: a01 a02 a12, then the rows from 3 on, left to right
    footprint: Float[Tensor, " n"]  # not trained: finest training pixel there, world units; 0 of maps without filter

    @property
    def dynamic(self) -> bool:
        """Return whether they change with time."""
        return self.query_mean.shape[1] > 3

    def to(self, device: torch.device) -> "BetaPrimitives":
        """The same on a device."""
        return BetaPrimitives(*(values.to(device) for values in self))


@runtime_checkable  # so that the suite can check calls against it
class PrimitiveRows(Protocol):
    """Primitives of any kind: tensors with a row for each."""

    def __iter__(self) -> Iterator[Tensor]: ...

    @classmethod
    def _make(cls, iterable: Iterable[Tensor]) -> Any: ...

    def _asdict(self) -> dict[str, Any]: ...


OfKind = TypeVar("OfKind", bound=PrimitiveRows)


def select(p: OfKind, which: Int[Tensor, " m"] | Bool[Tensor, " n"]) -> OfKind:
    """Some of the primitives."""
    return p._make(values[which] for values in p)


def trained(p: PrimitiveRows) -> dict[str, Tensor]:
    """The tensors of primitives that training moves, by name: all but the footprints, which are measured."""
    return {name: values for name, values in p._asdict().items() if name != "footprint"}


def kernel_exponent(p: BetaPrimitives) -> Float[Tensor, " n"]:
    """B of the kernel on the image plane."""
    return 4 * torch.exp(p.beta[:, 0])


def inverse_softplus(y: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """x with softplus(x) = y > 0."""
    return y + torch.log(-torch.expm1(-y))


def rescaled(p: BetaPrimitives, factor: float) -> BetaPrimitives:
    """The same primitives after every length was multiplied by `factor`; queries have no length."""
    scale = p.scale.clone()
    scale[:, :3] = inverse_softplus(softplus(p.scale[:, :3].double()) * factor).to(scale)
    return p._replace(xyz=p.xyz * factor, scale=scale, footprint=p.footprint * factor)


def initial_primitives(rec: Reconstruction, settings: InitialSettings, rng: torch.Generator) -> BetaPrimitives:
    """Primitives on the restored cloud and its backdrop, D = 6; on the sparse points, raw colors, without a cloud.

    Raises InputError for fewer than 4 points.
    """
    start = starting_points(rec, settings)
    xyz, n = start.xyz, len(start.xyz)
    if settings.directions == "mean":
        directions = mean_directions(xyz, rec, settings.max_views).float()
    else:
        directions = 2 * torch.rand(n, 3, generator=rng) - 1
    scale = torch.cat([settings.scale * start.spacing[:, None].expand(-1, 3).float(), torch.ones(n, 3)], -1)
    return BetaPrimitives(
        xyz=xyz.float(),
        query_mean=directions,
        rgb=start.rgb,
        opacity=torch.full((n,), settings.opacity).logit(),
        beta=torch.tensor([0.0, *[settings.view_exponent] * 3]).repeat(n, 1),
        scale=inverse_softplus(scale),
        lower=1e-5 * torch.randn(n, 15, generator=rng),
        footprint=torch.zeros(n),
    )


def with_time(p: BetaPrimitives, settings: InitialSettings, rng: torch.Generator) -> BetaPrimitives:
    """D = 7 of D = 6: each primitive around a moment of its own, as UBS begins; nothing moves or turns yet."""
    n = len(p.xyz)
    spread = inverse_softplus(torch.full((n, 1), settings.time_scale))
    return p._replace(
        query_mean=torch.cat([p.query_mean, torch.rand(n, 1, generator=rng)], -1),
        beta=torch.cat([p.beta, torch.full((n, 1), settings.time_exponent)], -1),
        scale=torch.cat([p.scale, spread], -1),
        lower=torch.cat([p.lower, 1e-5 * torch.randn(n, 6, generator=rng)], -1),
    )
