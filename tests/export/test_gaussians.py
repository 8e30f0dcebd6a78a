"""Beta primitives as Gaussians of the same moments, in the file that 3DGS viewers read."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from swimm3r.cameras import Cameras
from swimm3r.export.formats.splat_ply import write_ply
from swimm3r.export.gaussians import (
    Gaussians,
    clear_difference,
    clear_gaussians,
    draw_gaussians,
    moment_matched,
    with_mean_color,
)
from swimm3r.export.settings import SplatPlySettings
from swimm3r.export.splats import arrays_of
from swimm3r.raster import Primitives2D, rasterize
from swimm3r.splat.medium.field import initial_field
from swimm3r.splat.primitives.beta import BetaPrimitives, inverse_softplus
from swimm3r.splat.primitives.gaussian import GaussianPrimitives, seen_color
from swimm3r.splat.projection.dispatch import project
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import MediumFieldSettings, UwbsSettings, mcmc_gs

PARTS = {"f_dc": 3, "f_rest": 45, "opacity": 0, "scale": 3, "rot": 4}  # f_rest: 3 (3 + 1)^2 - 3, which 3DGS asserts
FIELDS = ["x", "y", "z", "nx", "ny", "nz"]
FIELDS += [f"{part}_{k}" if n else part for part, n in PARTS.items() for k in range(n or 1)]


def camera() -> Cameras:
    K = torch.tensor([[70.0, 0, 37], [0, 66, 31], [0, 0, 1]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    return Cameras(K[None], torch.zeros(1, 0, dtype=torch.float64), pose[None], 80, 56)


def wall(n: int = 1500) -> SplatMap:
    """An opaque textured wall around z = 3."""
    rng = torch.Generator().manual_seed(0)
    x, y = 2.6 * (2 * torch.rand(2, n, generator=rng) - 1)
    xyz = torch.stack([x, 0.8 * y, 3 + 0.2 * torch.sin(2 * x) * torch.cos(3 * y)], -1)
    waves = torch.stack([torch.sin(5 * x + 2 * y), torch.sin(7 * y - x), torch.cos(4 * x - 5 * y)], -1)
    spread = torch.cat([torch.full((n, 3), 0.25), torch.ones(n, 3)], -1)
    p = BetaPrimitives(
        xyz, torch.nn.functional.normalize(xyz, dim=-1), 0.5 + 0.35 * waves, torch.full((n,), 3.0),
        torch.zeros(n, 4), inverse_softplus(spread), torch.zeros(n, 15), torch.full((n,), 0.02),
    )  # fmt: skip
    return SplatMap(p, initial_field(None, MediumFieldSettings(), rng), UwbsSettings(), True)


def gaussians(n: int = 5) -> Gaussians:
    rng = torch.Generator().manual_seed(0)
    A = 0.2 * torch.randn(n, 3, 3, generator=rng)
    xyz = torch.randn(n, 3, generator=rng) * 0.3 + torch.tensor([0.0, 0.0, 4.0])
    return Gaussians(
        xyz, torch.rand(n, 3, generator=rng), torch.rand(n, generator=rng) * 0.9, A @ A.mT, torch.zeros(n, 0, 3)
    )


def test_on_the_image_plane_mass_and_second_moments_are_those_of_the_beta_kernel():
    """Mass and moments summed over pixels: one splat of exponent B against the Gaussian that stands for it."""
    B, o, radius, size = 4.0, 0.4, 60.0, 200
    near = {"mean2d": torch.full((1, 2), size / 2), "color": torch.ones(1, 3), "depth": torch.ones(1)}

    def alphas(conic: float, exponent: float, opacity: float) -> torch.Tensor:
        p = Primitives2D(
            conic=torch.tensor([[conic, 0.0, conic]]), opacity=torch.tensor([opacity]),
            beta=torch.tensor([exponent]), **near,
        )  # fmt: skip
        return rasterize(p, None, size, size, alpha_min=0.0).alpha.double()

    beta = alphas(radius**-2, B, o)
    variance, peak = radius**2 / (2 * (B + 2)), o * (B + 2) / (B + 1)
    gaussian = alphas(1 / (variance * 400), 200.0, peak)
    x = torch.arange(size) + 0.5 - size / 2
    for moment in (torch.ones(size), x.double() ** 2):
        a, b = ((image * moment).sum() for image in (beta, gaussian))
        assert float(a) == pytest.approx(float(b), rel=0.02)


def test_the_file_holds_what_3dgs_viewers_expect(tmp_path):
    g = gaussians()
    write_ply(tmp_path / "g.ply", arrays_of(g))
    head, _, body = (tmp_path / "g.ply").read_bytes().partition(b"end_header\n")
    lines = head.decode().split("\n")
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 5"]
    assert [line.split() for line in lines[3:-1]] == [["property", "float", name] for name in FIELDS]
    v = np.frombuffer(body, [(name, "<f4") for name in FIELDS])
    q = torch.from_numpy(np.stack([v[f"rot_{k}"] for k in range(4)], -1).copy()).double()
    scale = np.exp(np.stack([v[f"scale_{k}"] for k in range(3)], -1))
    w, x, y, z = q.unbind(-1)  # the usual formula, written out
    R = torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ], -1,
    ).unflatten(-1, (3, 3))  # fmt: skip
    covariance = R @ torch.diag_embed(torch.from_numpy(scale).double() ** 2) @ R.mT
    torch.testing.assert_close(covariance.float(), g.covariance, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-v["opacity"])), g.opacity, rtol=1e-5)
    np.testing.assert_allclose(0.5 + 0.28209479 * v["f_dc_1"], g.rgb[:, 1], rtol=1e-5, atol=1e-6)


def test_a_gaussian_is_drawn_as_its_formula_says():
    g, view = gaussians(1), camera()
    out = draw_gaussians(g, view, 0.01)
    K = view.K[0].float()
    x, y, z = g.xyz[0]
    J = torch.tensor([[K[0, 0] / z, 0, -K[0, 0] * x / z**2], [0, K[1, 1] / z, -K[1, 1] * y / z**2]])
    S = J @ g.covariance[0] @ J.T + 0.3 * torch.eye(2)
    v, u = torch.meshgrid(torch.arange(view.height) + 0.5, torch.arange(view.width) + 0.5, indexing="ij")
    d = torch.stack([u - K[0, 0] * x / z - K[0, 2], v - K[1, 1] * y / z - K[1, 2]], -1)
    expected = g.opacity[0] * torch.exp(-0.5 * (d * (d @ torch.linalg.inv(S))).sum(-1))
    torch.testing.assert_close(out.alpha, expected, atol=5e-3, rtol=0)  # 1/255 is cut off


def test_the_wall_looks_like_itself_as_gaussians():
    scene = wall()
    g = moment_matched(scene, camera())
    assert 100 < len(g.xyz) <= 1500  # what the camera does not see is left out
    lost = clear_difference(scene, g, camera())
    assert lost.psnr > 22
    assert abs(lost.alpha) < 0.05
    faint = clear_difference(scene, replace(g, opacity=0.3 * g.opacity), camera())
    assert faint.psnr < lost.psnr
    assert faint.alpha < -0.02


def test_negative_colors_do_not_brighten_the_gaussians_as_a_whole():
    """A viewer takes them for 0; the map blends them as they are."""
    scene, view = wall(), camera()
    assert isinstance(scene.primitives, BetaPrimitives)
    p = scene.primitives._replace(rgb=scene.primitives.rgb - 0.25)
    dark = replace(scene, primitives=p)
    assert (p.rgb < 0).float().mean() > 0.15
    plain = moment_matched(dark, view)
    own = rasterize(project(p, view_camera(view), dark.settings.render).primitives, None, 56, 80).clear.mean((1, 2))
    brighter = draw_gaussians(plain, view, 0.01).clear.mean((1, 2)) / own
    assert brighter.min() > 1.05
    kept = draw_gaussians(with_mean_color(dark, plain, view), view, 0.01).clear.mean((1, 2))
    torch.testing.assert_close(kept, own, rtol=0.01, atol=0)


def gaussian_wall() -> SplatMap:
    """The wall in Gaussians whose colors change with the direction."""
    rng = torch.Generator().manual_seed(1)
    of, n = wall(600), 600
    assert isinstance(of.primitives, BetaPrimitives)
    p = GaussianPrimitives(
        of.primitives.xyz, torch.randn(n, 4, generator=rng), torch.full((n, 3), -2.5), of.primitives.opacity,
        torch.randn(n, 3, generator=rng), 0.2 * torch.randn(n, 15, 3, generator=rng), torch.zeros(n),
    )  # fmt: skip
    field = initial_field(None, MediumFieldSettings(model="none"), rng)
    return SplatMap(p, field, mcmc_gs(), True)


def test_gaussians_leave_as_they_are():
    scene = gaussian_wall()
    g = clear_gaussians(scene, camera())
    difference = clear_difference(scene, g, camera())
    assert difference.psnr > 60
    assert abs(difference.alpha) < 1e-4


def test_viewers_see_the_harmonics_with_their_own_signs(tmp_path):
    """3DGS's degree 1 is C1 (-y, z, -x), its coefficients stand channel by channel."""
    scene = gaussian_wall()
    assert isinstance(scene.primitives, GaussianPrimitives)
    p = scene.primitives._replace(harmonics=scene.primitives.harmonics.clone())
    p.harmonics[:, 3:] = 0
    g = clear_gaussians(replace(scene, primitives=p), camera())
    write_ply(tmp_path / "g.ply", arrays_of(g))
    head, _, body = (tmp_path / "g.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().split("\n") if line.startswith("property")]
    assert [name for name in names if name.startswith("f_rest")] == [f"f_rest_{k}" for k in range(45)]
    v = np.frombuffer(body, [(name, "<f4") for name in names])
    eye = torch.tensor([0.4, -0.3, 0.1])
    x, y, z = torch.nn.functional.normalize(g.xyz - eye, dim=-1).numpy().T
    expected = seen_color(p, eye).numpy()
    for c in range(3):
        k = [v[f"f_rest_{15 * c + i}"] for i in range(3)]
        along = 0.4886025119029199 * (-y * k[0] + z * k[1] - x * k[2])
        seen = np.maximum(0.5 + 0.28209479177387814 * v[f"f_dc_{c}"] + along, 0)
        np.testing.assert_allclose(seen, expected[:, c], atol=1e-5)


@pytest.mark.parametrize("time", [-1.0, math.nan, 1e9])
def test_a_time_outside_of_any_clip_is_refused(time: float):
    with pytest.raises(ValueError, match="time"):
        SplatPlySettings(time)
