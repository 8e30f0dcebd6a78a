"""Conditioning against the shared vectors and its own limits."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.projection.conditioning import condition, conditioned_in_view, factor, queries, rotation_block
from swimm3r.splat.settings import RenderSettings

VECTORS = Path(__file__).parents[2] / "data/uwbs_vectors.npz"


@pytest.fixture(scope="module")
def nd6() -> dict[str, torch.Tensor]:
    with np.load(VECTORS) as stored:
        return {k[4:]: torch.from_numpy(stored[k]) for k in stored.files if k.startswith("nd6_")}


def stored_primitives(nd6: dict[str, torch.Tensor]) -> BetaPrimitives:
    mean = nd6["in_mean"]
    return BetaPrimitives(
        mean[:, :3], mean[:, 3:], torch.zeros(len(mean), 3, dtype=mean.dtype), nd6["in_raw_opacity"][:, 0],
        nd6["in_raw_beta"], nd6["in_raw_scale"], nd6["in_ltri"], torch.zeros(len(mean), dtype=mean.dtype),
    )  # fmt: skip


def test_the_vectors_covariance_is_reproduced(nd6: dict[str, torch.Tensor]):
    p = stored_primitives(nd6)
    torch.testing.assert_close(rotation_block(p.lower[:, :3]), nd6["out_rot"], rtol=1e-10, atol=1e-10)
    L = factor(p)
    torch.testing.assert_close(L, nd6["out_L"], rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(L @ L.mT, nd6["out_cov"], rtol=1e-10, atol=1e-10)


def test_the_vectors_conditionals_are_reproduced(nd6: dict[str, torch.Tensor]):
    p = stored_primitives(nd6)
    query = queries(p.xyz, nd6["in_cam"])
    torch.testing.assert_close(query, nd6["in_query"], rtol=1e-10, atol=1e-10)
    seen = condition(p, query)
    torch.testing.assert_close(seen.mean, nd6["out_cmean"], rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(seen.covariance, nd6["out_ccov"], rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(seen.opacity, nd6["out_copacity"][:, 0], rtol=1e-10, atol=1e-10)
    both = conditioned_in_view(p, nd6["in_cam"], RenderSettings())
    torch.testing.assert_close(both.covariance, nd6["out_ccov_sym"], rtol=1e-10, atol=1e-10)


def test_the_vectors_gradients_are_reproduced(nd6: dict[str, torch.Tensor]):
    p = BetaPrimitives(*(t.clone().requires_grad_() for t in stored_primitives(nd6)))
    seen = condition(p, queries(p.xyz, nd6["in_cam"]))
    i, j = [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]
    loss = (seen.mean * nd6["in_wm"]).sum() + (seen.covariance[:, i, j] * nd6["in_wS"]).sum()
    loss = loss + (seen.opacity * nd6["in_wo"][:, 0]).sum()
    d = dict(zip(p._fields, torch.autograd.grad(loss, p, materialize_grads=True), strict=True))
    torch.testing.assert_close(torch.cat([d["xyz"], d["query_mean"]], -1), nd6["out_d_mean"], rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(d["scale"], nd6["out_d_raw_scale"], rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(d["lower"], nd6["out_d_ltri"], rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(d["opacity"], nd6["out_d_raw_opacity"][:, 0], rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(d["beta"][:, 1:], nd6["out_d_raw_beta"][:, 1:], rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("c", [3, 4])
def test_gradients_agree_with_finite_differences(c: int, primitives: Callable[..., BetaPrimitives]):
    p = primitives(3, c)
    center, time = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64), torch.tensor(0.4, dtype=torch.float64)
    wanted = [p.xyz, p.query_mean, p.opacity, p.beta, p.scale, p.lower, center]

    def results(xyz, query_mean, opacity, beta, scale, lower, center):
        q = BetaPrimitives(xyz, query_mean, p.rgb, opacity, beta, scale, lower, p.footprint)
        seen = conditioned_in_view(q, center, RenderSettings(), time if c == 4 else None)
        return seen.mean, seen.covariance, seen.opacity

    assert torch.autograd.gradcheck(results, [t.clone().requires_grad_() for t in wanted])


def test_a_primitive_seen_from_its_mean_direction_keeps_its_place_and_opacity(primitives):
    p = primitives(20)
    center = torch.zeros(3, dtype=torch.float64)
    p = p._replace(query_mean=queries(p.xyz, center))
    seen = condition(p, queries(p.xyz, center))
    torch.testing.assert_close(seen.mean, p.xyz)
    torch.testing.assert_close(seen.opacity, torch.sigmoid(p.opacity))


def test_a_primitive_whose_shape_ignores_direction_keeps_its_covariance(primitives):
    p = primitives(20)
    lower = p.lower.clone()
    lower[:, 3:] = 0
    p = p._replace(lower=lower)
    seen = condition(p, queries(p.xyz, torch.zeros(3, dtype=torch.float64)))
    L = factor(p)[:, :3, :3]
    torch.testing.assert_close(seen.covariance, L @ L.mT)


def test_the_exponential_rotation_is_a_rotation_that_starts_as_the_first_order_one():
    entries = 1e-3 * torch.randn(10, 3, dtype=torch.float64)
    R = rotation_block(entries, "exponential")
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand(10, 3, 3))
    torch.testing.assert_close(R, rotation_block(entries), atol=1e-5, rtol=0)
