"""Relocation, growth and noise."""

from pathlib import Path
from typing import Literal

import numpy as np
import torch

from swimm3r.splat.densify.mcmc_beta import noise, relocate_and_grow, shared_opacity
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.projection.conditioning import rotation_block
from swimm3r.splat.settings import DensifySettings

VECTORS = Path(__file__).parents[2] / "data/uwbs_vectors.npz"


def rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def with_opacity(p: BetaPrimitives, opacity: torch.Tensor) -> BetaPrimitives:
    return BetaPrimitives(*(t.float() for t in p._replace(opacity=opacity.logit())))


def test_the_vectors_opacities_are_reproduced():
    with np.load(VECTORS) as v:
        opacity, n, expected = (torch.from_numpy(v[f"reloc_{k}"]) for k in ("opacity", "n", "new_opacity"))
    found = shared_opacity(opacity[:, None].expand(-1, len(n)), n.double().expand(len(opacity), -1), 0.005)
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


def test_copies_in_one_place_block_the_light_of_the_one_they_replace_at_center_and_rim_and_more_in_between():
    o, n = torch.tensor([0.2, 0.7, 0.95]).double()[:, None], torch.tensor([2.0, 3.0, 5.0]).double()[:, None]
    each = shared_opacity(o, n, 0.005)
    v = (1 - torch.linspace(0, 1, 101).double()) ** 4  # a Beta kernel from its center to its rim
    more = (1 - o * v) - (1 - each * v) ** n
    torch.testing.assert_close(more[:, [0, -1]], torch.zeros(3, 2).double())
    assert (more[:, 1:-1] > 0).all()
    torch.testing.assert_close(more[0], each[0] ** 2 * v * (1 - v))  # two copies


def test_the_dead_move_onto_the_living_and_share_their_opacity(primitives):
    opacity = torch.full((40,), 0.6)
    opacity[:10] = 0.004
    p = with_opacity(primitives(40), opacity)
    done = relocate_and_grow(p, 40, 0.005, rng())
    assert done.relocated == 10
    assert (done.source[:10] >= 10).all()
    assert torch.equal(done.primitives.xyz[:10], p.xyz[done.source[:10]])
    assert torch.equal(done.primitives.scale[:10], p.scale[done.source[:10]])
    after = torch.sigmoid(done.primitives.opacity)
    for k in done.source[:10].unique():
        copies = int((done.source == k).sum())
        assert abs((1 - after[k]) ** copies - 0.4) < 1e-5
    untouched = torch.ones(40, dtype=torch.bool)
    untouched[:10] = untouched[done.source[:10]] = False
    assert torch.equal(done.primitives.opacity[untouched], p.opacity[untouched])
    assert set(done.restarted.tolist()) == set(done.source[:10].tolist())


def test_growth_appends_copies_drawn_by_opacity(primitives):
    opacity = torch.full((40,), 0.01)
    opacity[7] = 0.99
    done = relocate_and_grow(with_opacity(primitives(40), opacity), 60, 0.005, rng())
    assert len(done.primitives.xyz) == 60
    assert done.added == 20
    assert (done.source[40:] == 7).sum() > 8
    assert set(range(40, 60)) <= set(done.restarted.tolist())


def test_nothing_happens_where_nobody_is_dead_and_the_number_is_reached(primitives):
    p = with_opacity(primitives(30), torch.full((30,), 0.5))
    done = relocate_and_grow(p, 30, 0.005, rng())
    assert all(torch.equal(a, b) for a, b in zip(done.primitives, p, strict=True))
    assert not len(done.restarted)


def test_noise_moves_the_faint_along_their_own_shape_only(primitives):
    opacity = torch.full((200,), 0.9)
    opacity[:100] = 0.004
    p = with_opacity(primitives(200), opacity)
    thin = p.scale.clone()
    thin[:, 2] = -9.0
    p = p._replace(scale=thin, lower=torch.zeros_like(p.lower))
    moved = noise(p, 1.0, DensifySettings(), "first_order", rng())
    assert (moved[100:] == 0).all()
    assert (moved[:100, :2].abs() > 0).all()
    assert moved[:100, 2].abs().max() < 1e-5 * moved[:100, :2].abs().max()


def test_the_gates_are_those_of_the_two_papers(primitives):
    opacity = torch.tensor([0.001, 0.005, 0.02, 0.05])
    p = with_opacity(primitives(4), opacity)
    p = p._replace(scale=p.scale[:1].expand(4, -1), lower=p.lower[:1].expand(4, -1))
    gates: dict[Literal["sigmoid", "power"], torch.Tensor]
    gates = {"sigmoid": 1 / (1 + torch.exp(100 * (opacity - 0.005))), "power": (1 - opacity) ** 100}
    L = rotation_block(p.lower[:1, :3])[0] * torch.nn.functional.softplus(p.scale[0, :3])
    eps = torch.randn(4, 3, 1, generator=rng())[..., 0]
    for gate, expected in gates.items():
        moved = noise(p, 2.0, DensifySettings(noise_gate=gate), "first_order", rng())
        torch.testing.assert_close(moved, 2 * expected[:, None] * eps @ (L @ L.mT).mT, rtol=1e-4, atol=1e-7)


def test_a_cap_below_the_number_there_is_removes_nobody(primitives):
    p = with_opacity(primitives(30), torch.full((30,), 0.5))
    assert len(relocate_and_grow(p, 10, 0.005, rng()).primitives.xyz) == 30
