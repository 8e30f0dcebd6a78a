"""The published schedules in short runs, and the changes that the `fast` preset and `with_recipe` make.

    python benchmarks/short_runs.py RUN [--iterations 400] [--long-side 160] [--primitives 4000] [--only NAME ...]

Each variant is trained on the frames of a finished run, every fifth registered one held back; its PSNR is the mean over
those, at the poses structure from motion gave them. One seed: it finds what breaks a method, not which is best.
"""

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch

from swimm3r.evaluate.images import psnr
from swimm3r.imaging.undistortion import undistorted
from swimm3r.pipeline.finished_sfm import FinishedSfm, open_finished_sfm
from swimm3r.pipeline.presets import PRESETS
from swimm3r.splat import train
from swimm3r.splat.settings import (
    LearningRates,
    McmcGsSettings,
    OceanSplatSettings,
    SeaSplatSettings,
    SplatSettings,
    UirSettings,
    UwbsSettings,
    WaterSplattingSettings,
    mcmc_gs,
    seasplat,
    watersplatting,
    with_recipe,
)


def variants(size: UwbsSettings) -> dict[str, SplatSettings]:
    """The recipes as they are trained, and each without one of the changes made for short runs."""
    mcmc, water, sea = (with_recipe(size, name) for name in ("mcmc_gs", "watersplatting", "seasplat"))
    ocean, uir = (with_recipe(size, name) for name in ("oceansplat", "3d-uir"))
    assert isinstance(mcmc, McmcGsSettings)
    assert isinstance(water, WaterSplattingSettings)
    assert isinstance(sea, SeaSplatSettings)
    assert isinstance(ocean, OceanSplatSettings)
    assert isinstance(uir, UirSettings)
    slow = {
        f"{name}, rates as published": replace(of, rates=replace(of.rates, short_run_rate_exponent=0.0))
        for name, of in (("mcmc_gs", mcmc), ("watersplatting", water), ("seasplat", sea))
    }
    mcmc_first = replace(mcmc.initial, scale=mcmc_gs().initial.scale)
    faint = {
        of: replace(of.initial, opacity=published.initial.opacity)
        for of, published in ((water, watersplatting()), (sea, seasplat()))
    }
    return {
        "uwbs-static": size,
        "uwbs-static, rates as published": replace(size, rates=LearningRates()),
        "uwbs-static, rates held to the end": replace(size, rates=replace(size.rates, final_rate_factor=1.0)),
        "mcmc_gs": mcmc,
        "mcmc_gs, first scale as published": replace(mcmc, initial=mcmc_first),
        "watersplatting": water,
        "watersplatting, first opacity, culls and cuts as published": replace(
            water, initial=faint[water], densify=watersplatting().densify
        ),
        "seasplat": sea,
        "seasplat, first opacity and cuts as published": replace(sea, initial=faint[sea], densify=seasplat().densify),
        "seasplat, first opacity as published": replace(sea, initial=faint[sea]),
        "oceansplat": ocean,
        "oceansplat, without virtual views": replace(ocean, weights=replace(ocean.weights, trinocular=0.0)),
        "oceansplat, without triangulated depth": replace(
            ocean, weights=replace(ocean.weights, epipolar=0.0, epipolar_end=0.0)
        ),
        "oceansplat, opacities as they are": replace(ocean, alpha=replace(ocean.alpha, end=0.0, fade=0.0)),
        "3d-uir": uir,
        "3d-uir, not flattened": replace(uir, weights=replace(uir.weights, flat=0.0)),
        "3d-uir, without depth": replace(uir, weights=replace(uir.weights, depth=0.0)),
        "3d-uir, colors as they are": replace(uir, affine_colors=replace(uir.affine_colors, rate=0.0)),
        **slow,
    }


def score(sfm: FinishedSfm, settings: SplatSettings) -> tuple[float, int]:
    """PSNR on the frames held back, and the primitives of the map."""
    registered = [frame.name for frame in sfm.frames.train if frame.name in set(sfm.rec.names)]
    held = registered[2::5]
    split = (replace(f, split="test") if f.name in held else f for f in sfm.frames.frames)
    frames = replace(sfm.frames, frames=tuple(split))
    with tempfile.TemporaryDirectory() as folder:
        scene = train(sfm.rec, frames, settings, Path(folder))
    found = []
    for name in held:
        lens, f = sfm.rec.cameras[sfm.rec.index(name)], frames.index(name)
        canvas = lens.pinhole(settings.long_side)
        target, seen = undistorted(frames.image(f), frames.mask(f), lens, canvas)
        render = scene.render(canvas, frames.frames[f].time).rgb.clamp(0, 1)
        found.append(psnr(render[seen], target[seen]))
    return sum(found) / len(found), len(scene.primitives.xyz)


def main() -> None:
    """Print a line per variant."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--long-side", type=int, default=160)
    parser.add_argument("--primitives", type=int, default=4000)
    parser.add_argument("--only", nargs="*")
    given = parser.parse_args()
    torch.set_num_threads(1)
    sfm, preset = open_finished_sfm(given.run), PRESETS["fast"].splat
    assert isinstance(preset, UwbsSettings)
    size = replace(
        preset,
        iterations=given.iterations,
        long_side=given.long_side,
        initial=replace(preset.initial, primitives=given.primitives),
        densify=replace(preset.densify, cap_max=2 * given.primitives),
    )
    for name, settings in variants(size).items():
        if given.only and name not in given.only:
            continue
        started = time.process_time()
        found, count = score(sfm, settings)
        print(
            f"{name:60s} {found:6.2f} dB  {count:6d} primitives  {time.process_time() - started:4.0f} CPU-s", flush=True
        )


if __name__ == "__main__":
    main()
