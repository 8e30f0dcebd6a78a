"""Promises of the CPU back end alone: threads do not change a bit, inner loops are SIMD, tiles are exact."""

import inspect
import platform
import re
from collections.abc import Callable

import numba
import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate

from swimm3r.raster import ALPHA_MIN, Backend, Kernel, MediumMaps, Primitives2D, SggBuffers, bin_primitives, rasterize
from swimm3r.raster.cpu import adjoint, forward, math, tiles

Scene = Callable[..., tuple[Primitives2D, MediumMaps]]


def float32(scene: tuple[Primitives2D, MediumMaps]) -> tuple[Primitives2D, MediumMaps]:
    p, medium = scene
    return Primitives2D(*(t.float() for t in p)), MediumMaps(*(t.float() for t in medium))


def full_pass(p: Primitives2D, medium: MediumMaps, kernel: Kernel = "beta") -> list[torch.Tensor]:
    """Everything a training step reads from the rasterizer."""
    leaves = [t.detach().requires_grad_() for t in (*p, *medium)]
    sgg = SggBuffers.zeros(len(p.depth))
    height, width = medium.Binf.shape[1:]
    out = rasterize(Primitives2D(*leaves[:6]), MediumMaps(*leaves[6:]), height, width, kernel=kernel, sgg=sgg)
    rng = torch.Generator().manual_seed(1)
    grads = torch.autograd.grad(out, leaves, [torch.randn(image.shape, generator=rng) for image in out])
    return [*out, *grads, *sgg]


def test_the_number_of_threads_changes_no_bit(scene: Scene):
    p, medium = float32(scene(3000, 150, 200))
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(full_pass(p, medium))
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert torch.equal(a, b)


X86 = platform.machine() in ("x86_64", "AMD64")
PACKED = r"\tv?(?:f\w+\d|mul|add|sub)ps\s" if X86 else r"\t(?:fml[as]|fmul|fadd|fsub)(?:\.4s\s+v\d|\s+v\d+\.4s)"


def packed_operations(assembly: str) -> list[int]:
    """SIMD arithmetic instructions in each run of code without a branch or a call, most first."""
    blocks = re.split(r"\n\.?LBB\d+_\d+:", assembly)
    return sorted((len(re.findall(PACKED, b)) for b in blocks if not re.search(r"\t(?:call|bl)", b)), reverse=True)


@pytest.mark.parametrize(
    ("name", "kernel", "expected"),
    [
        # light through near and far water, then the coverage; in the adjoint, before that, the sums
        ("forward_tiles", "beta", [70, 50, 30]),
        pytest.param("forward_tiles", "gaussian", [70, 50, 15], marks=pytest.mark.long),  # no logarithm
        ("adjoint_tiles", "beta", [110, 100, 60, 35]),
        pytest.param("adjoint_tiles", "gaussian", [110, 100, 60, 18], marks=pytest.mark.long),
    ],
)
def test_the_loops_over_pixels_are_simd(name: str, kernel: Kernel, expected: list[int], scene: Scene):
    full_pass(*float32(scene(10, 20, 20)), kernel)
    cached = {"forward_tiles": forward.forward_tiles, "adjoint_tiles": adjoint.adjoint_tiles}[name]
    options = {key: cached.targetoptions[key] for key in ("nogil", "error_model", "fastmath")}
    fresh = numba.njit(**options)(cached.py_func)  # code from Numba's cache cannot be looked into
    parameters = list(inspect.signature(cached.py_func).parameters)
    left_out = {"gaussian"} if kernel == "beta" else set()  # other tests may have had instances without water compiled
    for signature in cached.signatures:
        if {name for name, t in zip(parameters, signature, strict=True) if t == numba.types.none} == left_out:
            fresh.compile(signature)
    assemblies = fresh.inspect_asm()
    assert assemblies
    for assembly in assemblies.values():
        assert not re.findall(r"\.weak\s+_ZN7swimm3r", assembly)  # calls that the linker resolves, see math.inlined
        found = packed_operations(assembly)
        assert len(found) >= len(expected)
        assert all(n >= least for n, least in zip(found, expected, strict=False)), found
        if X86 and re.search(r"\tvfmadd", assembly):  # a machine with AVX2: 8 lanes
            assert re.search(r"%[yz]mm", assembly)


def test_the_guard_sees_a_loop_that_is_not_simd():
    """libm's exp2 in place of the polynomial is the easiest way to lose the lanes."""

    @numba.njit(error_model="numpy")
    def with_libm(x, out):
        for i in range(len(out)):
            out[i] = np.exp2(x[i]) * np.log2(x[i]) + np.sin(x[i])

    with_libm(np.ones(8, np.float32), np.zeros(8, np.float32))
    (assembly,) = with_libm.inspect_asm().values()
    assert max(packed_operations(assembly), default=0) < 3


@pytest.mark.parametrize("kernel", ["beta", "gaussian"])
def test_every_covered_pixel_is_in_a_tile_list_and_every_listed_tile_is_touched(kernel: Kernel, scene: Scene):
    p, _ = float32(scene(200, 70, 90))
    bins = bin_primitives(p, 70, 90, kernel=kernel)
    listed = {(t, int(i)) for t in range(30) for i in bins.ids[bins.tile_start[t] : bins.tile_start[t + 1]]}
    y, x = np.mgrid[0:70, 0:90] + 0.5
    covered, near = set(), set()
    fainter = p.opacity.double() / ALPHA_MIN
    r2_max = 1 - fainter ** (-1 / p.beta.double()) if kernel == "beta" else fainter.log() / p.beta.double()
    for i in range(200):
        dx, dy = x - p.mean2d[i, 0].item(), y - p.mean2d[i, 1].item()
        a, b, c = p.conic[i].tolist()
        r2 = a * dx**2 + 2 * b * dx * dy + c * dy**2
        for limit, found in ((1.0, covered), (1.6, near)):  # near: the ellipse may pass between pixel centers
            rows, columns = np.nonzero(r2 < limit * r2_max[i].item() - (1e-5 if limit == 1 else -0.2))
            found |= {(t, i) for t in np.unique(rows // 16 * 6 + columns // 16).tolist()}
    assert covered <= listed <= near


def test_tile_lists_run_front_to_back_and_slots_group_by_primitive(scene: Scene):
    p, _ = float32(scene(200, 70, 90))
    bins = bin_primitives(p, 70, 90)
    for t in range(30):
        z = p.depth[bins.ids[bins.tile_start[t] : bins.tile_start[t + 1]]]
        assert (z.diff() >= 0).all()
    assert torch.equal(bins.cpu.slot.sort().values, torch.arange(len(bins.ids), dtype=torch.int32))
    owner = torch.empty_like(bins.ids)
    owner[bins.cpu.slot.long()] = bins.ids
    assert torch.equal(owner, bins.cpu.order.repeat_interleave(bins.cpu.first_slot.diff()))


def test_water_of_a_tile_is_that_of_its_middle_times_a_short_polynomial():
    """At the limit of the departure, too, and where the water lets nothing through."""
    for middle in (-0.02, -1.0, -8.0):
        for z in (0.1, 1.0, 7.0):
            k, at_middle = np.float32(middle), math.exp2(np.float32(middle) * np.float32(z))
            for share in np.linspace(-0.5, 0.5, 101):
                departure = np.float32(share / z)
                near, far = (
                    tiles.through_water((departure,) * 3, np.float32(z), (k,) * 3, (at_middle,) * 3, way)
                    for way in (None, True)
                )
                rounding = 6e-8 * (3 + abs(middle * z))  # of the exponent, in float32
                exact = np.exp2((float(k) + float(departure)) * float(np.float32(z)))
                np.testing.assert_allclose((near, far), exact, rtol=3e-7 + rounding)


def test_smooth_water_and_water_that_changes_within_a_tile_agree_with_the_oracle(scene: Scene):
    """Near primitives take the polynomial, and far ones do not where the water changes fast."""
    p, rough = scene(200, 48, 64)
    corners = [maps[:, :2, :2][None] for maps in rough]
    smooth = MediumMaps(*(interpolate(c, (48, 64), mode="bilinear", align_corners=True)[0] for c in corners))
    for medium in (smooth, rough, MediumMaps(*(maps.mean((1, 2), keepdim=True).expand_as(maps) for maps in rough))):
        results = []
        kinds: list[tuple[torch.dtype, Backend]] = [(torch.float32, "numba"), (torch.float64, "reference")]
        for dtype, backend in kinds:
            leaves = [t.to(dtype).requires_grad_() for t in (*p, *medium)]
            out = rasterize(Primitives2D(*leaves[:6]), MediumMaps(*leaves[6:]), 48, 64, backend=backend)
            results.append([*out, *torch.autograd.grad(out.rgb.square().sum(), leaves)])
        for a, b in zip(*results, strict=True):
            assert (a - b).norm() <= 5e-6 * b.norm()


def test_integers_sort_as_their_floats_do():
    x = np.array([-np.float32(3e38), -2.0, -1e-30, 0.0, 1e-30, 0.5, 3e38], np.float32)
    keys = [math.ordered(v) for v in x]
    assert keys == sorted(keys)
    np.testing.assert_array_equal([math.disordered(k) for k in keys], x)


def test_the_polynomials_are_good_to_float32():
    x = np.linspace(-79, 20, 20001).astype(np.float32)
    power = np.array([math.exp2(v) for v in x])
    np.testing.assert_allclose(power, np.exp2(x.astype(float)), rtol=4e-7)
    u = np.geomspace(1e-6, 1, 20001).astype(np.float32)
    np.testing.assert_allclose([math.log2(v) for v in u], np.log2(u.astype(float)), rtol=3e-7, atol=1e-7)
