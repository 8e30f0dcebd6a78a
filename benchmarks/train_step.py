"""CPU time of a whole training step beside that of the rasterizer alone, part by part.

    python benchmarks/train_step.py [--sizes XS S M L] [--lenses pinhole fisheye] [--devices cpu cuda]
        [--threads N] [--repeats N]

The primitives are those of benchmarks/raster.py, lifted into space so that one camera sees them all, with conditioning
that does something. A fisheye has 150 degrees across its diagonal, and primitives of about the same ellipses. CPU-ms
are process CPU time summed over threads, medians. The bar is a ratio of 1.5 at M. Where there is a GPU, rows follow in
wall-clock milliseconds of it, the device waited for after every call, and, where gsplat can be built, one of its
rasterizer (its projection included, 3D Gaussians of the same place, size and number, no water) beside the sum of our
projection and rasterizer.
"""

import argparse
import math
import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import torch

from swimm3r.cameras import Cameras, directions
from swimm3r.raster import MediumMaps, rasterize
from swimm3r.selftest.speed import SIZES, Size, workload
from swimm3r.splat.medium.field import grid_of, initial_field, medium_at_pixels, per_z_depth
from swimm3r.splat.optimizer import adam_step
from swimm3r.splat.primitives.beta import BetaPrimitives, inverse_softplus
from swimm3r.splat.projection.dispatch import project
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.recipes import uwbs
from swimm3r.splat.rendering import Drawing
from swimm3r.splat.settings import UwbsSettings
from swimm3r.splat.training.scene import TrainingScene
from swimm3r.splat.training.state import first_state, parameters_of
from swimm3r.splat.views import TrainingView

LENSES = ("pinhole", "fisheye")
FISHEYE = (0.02, -0.01, 0.004, -0.001)


def camera(size: Size, lens: str = "pinhole") -> Cameras:
    """A camera at the origin: of about 65 degrees, or a fisheye."""
    fisheye = lens == "fisheye"
    f = math.hypot(size.width, size.height) / 2 / math.radians(75) if fisheye else 0.78 * size.width
    K = torch.tensor([[f, 0, size.width / 2], [0, f, size.height / 2], [0, 0, 1]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)[None]
    distortion = torch.tensor([FISHEYE if fisheye else ()], dtype=torch.float64)
    model = "OPENCV_FISHEYE" if fisheye else "PINHOLE"
    return Cameras(K[None], distortion, pose, size.width, size.height, model)


def lifted(size: Size, lens: str = "pinhole") -> BetaPrimitives:
    """Primitives in space that project to about the ellipses of the rasterizer's workload."""
    p, _ = workload(size)
    rng = torch.Generator().manual_seed(2)
    n, K = size.primitives, camera(size, lens).K[0].float()
    rays = directions(camera(size, lens), p.mean2d[None].double())[0].float()
    if lens == "fisheye":  # the size of its image follows the distance, not the depth
        rays = torch.nn.functional.normalize(torch.nan_to_num(rays), dim=-1)
    xyz = rays * p.depth[:, None]
    covariance = torch.linalg.inv(torch.stack([p.conic[:, :2], p.conic[:, 1:]], 1).double())
    axes = torch.linalg.eigvalsh(covariance).sqrt().float() * (p.depth / K[0, 0])[:, None]
    spatial = torch.cat([axes, axes.mean(-1, keepdim=True)], -1)
    direction = torch.nn.functional.normalize(xyz, dim=-1) + 0.05 * torch.randn(n, 3, generator=rng)
    return BetaPrimitives(
        xyz=xyz,
        query_mean=direction,
        rgb=p.color,
        opacity=p.opacity.logit(),
        beta=torch.cat([(p.beta / 4).log()[:, None], 0.1 * torch.randn(n, 3, generator=rng)], -1),
        scale=inverse_softplus(torch.cat([spatial, torch.ones(n, 3)], -1)),
        lower=0.05 * torch.randn(n, 15, generator=rng),
        footprint=torch.zeros(n),
    )


def now(device: torch.device) -> float:
    """Seconds of the processor, all threads; on a GPU those that have passed once it has finished."""
    if device.type == "cpu":
        return time.process_time()
    torch.cuda.synchronize()
    return time.perf_counter()


def median_ms(work: Callable[[], Any], repeats: int, device: torch.device) -> float:
    """Median milliseconds of a call; the first call is not counted."""
    times = []
    for _ in range(repeats + 1):
        start = now(device)
        work()
        times.append(1e3 * (now(device) - start))
    return statistics.median(times[1:])


def gsplat_ms(size: Size, repeats: int, device: torch.device) -> float | None:
    """The same of gsplat, forward and backward; None where it is not installed or cannot be built."""
    try:
        from gsplat import rasterization  # pyright: ignore[reportMissingImports]
    except (ImportError, OSError):
        return None
    p, lens = lifted(size), camera(size)
    leaves = [
        t.to(device).requires_grad_()
        for t in (
            p.xyz,
            torch.tensor([1.0, 0, 0, 0]).repeat(size.primitives, 1),
            torch.nn.functional.softplus(p.scale[:, :3]),
            p.opacity.sigmoid(),
            p.rgb,
        )
    ]
    view, K = torch.eye(4)[None].to(device), lens.K.float().to(device)

    def work() -> None:
        images, alpha, _ = rasterization(*leaves, view, K, size.width, size.height, render_mode="RGB+D")
        torch.autograd.grad(images.sum() + alpha.sum(), leaves)

    return median_ms(work, repeats, device)


def measure(size: Size, lens: str, repeats: int, device: torch.device) -> dict[str, float]:
    """Milliseconds of the step and of its parts."""
    settings = UwbsSettings(iterations=20_000)
    rng = torch.Generator().manual_seed(1)
    height, width = size.height, size.width
    unread: Any = None  # reconstruction and views are read at the start only
    recipe = uwbs.Uwbs(settings, TrainingScene(unread, 1.0, 1.0, unread, device=device))
    state = first_state(lifted(size, lens), initial_field(None, settings.medium, rng), None).to(device)
    p, field = state.primitives, state.field
    prior = 1 + 9 * torch.rand(height, width, generator=rng).to(device)
    view = TrainingView(
        name="benchmark",
        camera=camera(size, lens),
        rgb=torch.rand(3, height, width, generator=rng).to(device),
        seen=prior > 0,
        z_depth=prior,
        open_water=prior < 0,
    )
    sight = view_camera(view.camera).to(device)
    leaves = BetaPrimitives(*(t.clone().requires_grad_() for t in p))

    seen = project(leaves, sight, settings.render)
    plane = [t.detach().requires_grad_() for t in seen.primitives]
    water = per_z_depth(medium_at_pixels(grid_of(field, sight, settings.medium.stride), height, width), sight)
    maps = [t.detach().requires_grad_() for t in water]
    images = rasterize(type(seen.primitives)(*plane), MediumMaps(*maps), height, width)
    drawn = [t.detach().requires_grad_() for t in images]
    cotangent = [torch.randn(t.shape, generator=rng).to(device) / t.numel() for t in images]
    on_plane = [torch.randn(t.shape, generator=rng).to(device) for t in plane]
    on_maps = [torch.randn(t.shape, generator=rng).to(device) for t in maps]
    grid = grid_of(field, sight, settings.medium.stride)
    drawing = Drawing(type(images)(*drawn), seen, grid, MediumMaps(*maps), None)

    def raster() -> None:
        out = rasterize(type(seen.primitives)(*plane), MediumMaps(*maps), height, width)
        torch.autograd.grad(out, [*plane, *maps], cotangent)

    def projection() -> None:
        out = project(leaves, sight, settings.render).primitives
        torch.autograd.grad(out, [t for t in leaves], on_plane, allow_unused=True)

    def medium() -> None:
        out = per_z_depth(medium_at_pixels(grid_of(field, sight, settings.medium.stride), height, width), sight)
        torch.autograd.grad(out, list(field.network.parameters()), on_maps)

    def losses() -> None:
        loss = uwbs.objective(leaves, drawing, view, settings, None, True).total
        torch.autograd.grad(loss, [*drawn, leaves.opacity, leaves.scale], allow_unused=True)

    parameters = parameters_of(BetaPrimitives(*(t.clone() for t in p)), field)
    moments = first_state(p, field, None).to(device).moments
    gradients = {name: torch.randn(t.shape, generator=rng).to(device) for name, t in parameters.items()}
    rates = recipe._rates(1, parameters)

    def adam() -> None:
        with torch.no_grad():
            adam_step(parameters, gradients, moments, rates)

    works = {"raster": raster, "projection": projection, "medium": medium, "losses": losses, "adam": adam}
    parts = {name: median_ms(work, repeats, device) for name, work in works.items()}
    held = {"state": state}
    plain = replace(recipe, settings=replace(settings, sgg=replace(settings.sgg, enabled=False)))

    def step(of: uwbs.Uwbs) -> Callable[[], None]:
        def one() -> None:
            held["state"], _ = of.step(held["state"], view, 7_001)  # regularized, no round of densification

        return one

    steps = {"step": step(recipe), "plain": step(plain)}
    return {name: median_ms(work, repeats, device) for name, work in steps.items()} | parts


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=["S", "M"], choices=["XS", "S", "M", "L"])
    parser.add_argument("--lenses", nargs="+", default=["pinhole"], choices=LENSES)
    here = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    parser.add_argument("--devices", nargs="+", default=here, choices=here)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repeats", type=int, default=7)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    print(f"{arguments.threads} threads; CPU-ms, on a GPU milliseconds")
    columns = ["size", "lens", "on", "step with SGG", "step", "raster", "step / raster"]
    columns += ["projection", "medium", "losses", "adam", "peak MB"]
    print(f"| {' | '.join(columns)} |")
    print("|---" * len(columns) + "|")
    for kind, name, lens in product(arguments.devices, arguments.sizes, arguments.lenses):
        device = torch.device(kind)
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats()
        row = measure(SIZES[name], lens, arguments.repeats, device)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        if device.type == "cuda":
            peak = torch.cuda.max_memory_allocated() / 2**20
        digits = 0 if device.type == "cpu" else 2
        times = [
            f"{row[part]:.{digits}f}" for part in ("step", "plain", "raster", "projection", "medium", "losses", "adam")
        ]
        times.insert(3, f"{row['plain'] / row['raster']:.2f}")
        print(f"| {name} | {lens} | {device.type} | {' | '.join(times)} | {peak:.0f} |")
        if device.type == "cuda" and lens == "pinhole":
            theirs, ours = gsplat_ms(SIZES[name], arguments.repeats, device), row["raster"] + row["projection"]
            found = (
                "cannot be built here" if theirs is None else f"{theirs:.2f} ms, {theirs / ours:.2f} of our {ours:.2f}"
            )
            print(f"gsplat's rasterizer at {name}: {found}")


if __name__ == "__main__":
    main()
