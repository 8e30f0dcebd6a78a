"""The image loss in Warp: on Warp's CPU device it is the plain form, and it compiles for every card."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from swimm3r.splat.training import losses

wp = pytest.importorskip("warp", reason="warp-lang is not installed: the GPU source was not compiled")
from swimm3r.splat.training import ssim_cuda  # noqa: E402

SIZES = [(40, 50), (7, 70), (33, 4), (1, 1), (11, 11)]  # three of them smaller than the window


def images(height: int, width: int) -> tuple[Tensor, Tensor]:
    rng = torch.Generator().manual_seed(height)
    a = torch.rand(3, height, width, generator=rng)
    b = (a + 0.3 * torch.rand(3, height, width, generator=rng)).clamp(0, 1)
    b[:, 1::3] = a[:, 1::3]  # where they are equal, L1 has no slope
    return a, b


def plain(render: Tensor, target: Tensor, seen: Tensor, ssim_weight: float) -> tuple[losses.Photometric, Tensor]:
    """The loss in float64 and its gradient."""
    x = render.double().requires_grad_()
    result = losses.photometric(x, target.double(), seen, ssim_weight)
    return result, torch.autograd.grad(result.loss, x)[0]


def close(found: Tensor, expected: Tensor) -> bool:
    return bool((found.cpu().double() - expected).norm() <= 3e-5 * expected.norm())


@pytest.fixture
def warp_in_place_of_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(losses.ssim_cpu, "photometric", ssim_cuda.photometric)


@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize("ssim_weight", [0.0, 0.2, 1.0])
def test_value_and_gradient_are_those_of_the_plain_form(height: int, width: int, ssim_weight: float):
    a, b = images(height, width)
    expected, slope = plain(a, b, torch.ones(height, width, dtype=torch.bool), ssim_weight)
    l1, ssim, gradient = ssim_cuda.photometric(a, b, ssim_weight)
    assert float(l1) == pytest.approx(float(expected.l1), rel=1e-5, abs=1e-7)
    assert float(ssim) == pytest.approx(float(expected.ssim), rel=1e-5)
    assert close(gradient, slope)


def test_images_in_any_order_of_memory_have_the_same_loss():
    a, b = images(20, 30)
    turned = [image.permute(2, 1, 0).contiguous().permute(2, 1, 0) for image in (a, b)]
    of_turned, of_plain = ssim_cuda.photometric(turned[0], turned[1], 0.2), ssim_cuda.photometric(a, b, 0.2)
    for found, expected in zip(of_turned, of_plain, strict=True):
        assert torch.equal(found, expected)


@pytest.mark.usefixtures("warp_in_place_of_numba")
@pytest.mark.parametrize("by_channel", [False, True])
def test_what_is_not_seen_has_no_gradient_and_no_say(by_channel: bool):
    a, b = images(40, 50)
    shape = a.shape if by_channel else a.shape[1:]
    seen = torch.rand(shape, generator=torch.Generator().manual_seed(3)) > 0.3
    expected, slope = plain(a, b, seen, 0.2)
    x = a.clone().requires_grad_()
    result = losses.photometric(x, torch.where(seen, b, torch.nan), seen, 0.2)
    (gradient,) = torch.autograd.grad(result.loss, x)
    assert float(result.loss.detach()) == pytest.approx(float(expected.loss.detach()), rel=1e-5)
    assert isinstance(result.l1, Tensor)  # so that no step waits for the number
    assert isinstance(result.ssim, Tensor)
    assert not gradient[~seen.expand_as(a)].any()
    assert close(gradient, slope)


@pytest.mark.parametrize("arch", [80, 86, 90])
def test_the_kernels_compile_ahead_of_time_without_a_gpu(arch: int, tmp_path: Path):
    made = wp.compile_aot_module(ssim_cuda, arch=arch, module_dir=tmp_path, use_ptx=True)
    ptx = Path(made[0]).read_text()
    assert f".target sm_{arch}" in ptx
    assert ptx.count(".visible .entry") == 4  # no adjoints
    assert ".local" not in ptx  # all values in registers


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: nothing ran on a GPU")
@pytest.mark.parametrize(("height", "width"), [*SIZES, (180, 320)])
def test_on_the_gpu_the_loss_is_the_plain_form(height: int, width: int):
    a, b = images(height, width)
    seen = torch.rand(height, width, generator=torch.Generator().manual_seed(3)) > 0.1
    seen[0, 0] = True
    expected, slope = plain(a, b, seen, 0.2)
    x = a.cuda().requires_grad_()
    result = losses.photometric(x, b.cuda(), seen.cuda(), 0.2)
    (gradient,) = torch.autograd.grad(result.loss, x)
    for found, number in ((result.l1, expected.l1), (result.ssim, expected.ssim), (result.loss, expected.loss)):
        assert isinstance(found, Tensor)
        assert found.device.type == "cuda"
        assert float(found.detach()) == pytest.approx(float(number), rel=1e-5, abs=1e-7)
    assert close(gradient, slope)
