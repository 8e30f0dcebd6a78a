"""A map in blocks beside one map of the same density: PSNR on frames held back, by the distance from block borders.

    python benchmarks/blocks.py RUN [--blocks 4] [--steps 1 1.5] [--long-side 320] [--images DIR]

RUN is a `fast` run of a survey up to structure from motion. Every fifth registered frame is held back and rendered at
the pose that structure from motion gave it. Both maps start from as many points per area, grow to as many primitives
and show each piece of ground as often; `--steps` are factors on the steps of the blocks. Distances are on the ground,
in median depths; pixels without measured depth count among all, and in no band.
"""

import argparse
import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import pixel_grid, unproject
from swimm3r.imaging.undistortion import nearest_pixels, undistorted
from swimm3r.io.images import write_rgb
from swimm3r.pipeline.finished_sfm import FinishedSfm, open_finished_sfm
from swimm3r.pipeline.presets import PRESETS
from swimm3r.scene.frames import Frames
from swimm3r.scene.surface import surface_of
from swimm3r.splat import train
from swimm3r.splat.blocks.plan import PlannedBlock, plan_blocks
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import UwbsSettings, with_primitives
from swimm3r.splat.views import median_z_depth

BANDS = (0.02, 0.1, math.inf)  # median depths from the nearest border


def of_size(preset: UwbsSettings, images: float, long_side: int) -> UwbsSettings:
    """The preset with points, primitives and steps in proportion to ground of so many images."""
    return replace(
        with_primitives(preset, images / preset.full_area),
        full_area=images,
        long_side=long_side,
        iterations=round(images / preset.blocks.largest * preset.iterations),
        blocks=replace(preset.blocks, largest=0),
    )


def border_distance(plan: Sequence[PlannedBlock], xyz: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Distance of points, along the ground, from the nearest edge of the block that holds them."""
    distance = torch.full((len(xyz),), math.inf, dtype=torch.float64)
    for block in plan:
        window = block.window
        uv = window.plane.coordinates(xyz)
        low, high = (torch.tensor(edge, dtype=torch.float64) for edge in (window.low, window.high))
        inside = torch.minimum(uv - low, high - uv).amin(-1)
        distance = torch.where(inside >= 0, inside, distance)
    return distance


def score(
    scene: SplatMap, sfm: FinishedSfm, frames: Frames, plan: Sequence[PlannedBlock], images: Path | None
) -> list[float]:
    """PSNR over all held-out pixels, and over those of each band, dB."""
    depth = median_z_depth(sfm.rec)
    total, count = torch.zeros(1 + len(BANDS)), torch.zeros(1 + len(BANDS))
    for frame in frames.test:
        i, f = sfm.rec.index(frame.name), frames.index(frame.name)
        lens = sfm.rec.cameras[i]
        canvas = lens.pinhole(scene.settings.long_side)
        target, seen = undistorted(frames.image(f), frames.mask(f), lens, canvas)
        rgb = scene.render(canvas, frame.time).rgb.clamp(0, 1)
        if images is not None:
            write_rgb(images / f"{Path(frame.name).stem}.png", rgb.numpy())
        z_depth = sfm.rec.depth[frame.name].z_depth[nearest_pixels(lens, canvas)]
        pixels = pixel_grid(canvas.height, canvas.width).reshape(1, -1, 2).double()
        points = unproject(canvas, pixels, z_depth.reshape(1, -1).double())[0]
        away = (border_distance(plan, points) / depth).reshape(z_depth.shape)
        known, last = seen & (z_depth > 0), 0.0
        groups = [seen]
        for band in BANDS:
            groups.append(known & (away >= last) & (away < band))
            last = band
        error = (rgb - target).square().mean(-1)
        total += torch.stack([error[group].sum() for group in groups])
        count += torch.stack([group.sum() for group in groups])
    return (-10 * torch.log10(total / count)).tolist()


def main() -> None:
    """Print a row per map."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--blocks", type=int, default=4)
    parser.add_argument("--steps", type=float, nargs="*", default=[1.0, 1.5])
    parser.add_argument("--long-side", type=int, default=320)
    parser.add_argument("--images", type=Path)
    given = parser.parse_args()
    sfm, preset = open_finished_sfm(given.run), PRESETS["fast"].splat
    assert isinstance(preset, UwbsSettings)
    registered = [frame.name for frame in sfm.frames.train if frame.name in set(sfm.rec.names)]
    held = set(registered[2::5])
    kept = (replace(f, split="test" if f.name in held else "train") for f in sfm.frames.frames if f.name in registered)
    frames = replace(sfm.frames, frames=tuple(kept))
    depth = median_z_depth(sfm.rec)
    surface = surface_of(sfm.rec, depth)
    images = float(surface.area.sum())
    largest = 1.0001 * images / given.blocks
    block = of_size(preset, largest, given.long_side)
    water_steps = min(1.0, preset.blocks.water_steps * preset.blocks.largest / largest)
    limits = replace(preset.blocks, largest=largest, water_steps=water_steps)
    plan = plan_blocks(surface, depth, limits)
    maps = {"one map": of_size(preset, images, given.long_side)}
    for steps in given.steps:
        maps[f"{len(plan)} blocks, {steps:g} x steps"] = replace(block, blocks=replace(limits, steps=steps))
    print(f"{images:.1f} images of ground, {len(frames.train)} frames, {len(frames.test)} held back")
    bands = [f"within {BANDS[0]:g}", f"to {BANDS[1]:g}", "farther"]
    print("| map | primitives | PSNR | " + " | ".join(bands) + " | CPU s |")
    print("| --- " * (4 + len(bands)) + "| --- |")
    for name, settings in maps.items():
        with tempfile.TemporaryDirectory() as folder:
            started = time.process_time()
            scene = train(sfm.rec, frames, settings, Path(folder))
            seconds = time.process_time() - started
            shown = None if given.images is None else given.images / name.replace(" ", "_")
            if shown is not None:
                shown.mkdir(parents=True, exist_ok=True)
            found = score(scene, sfm, frames, plan, shown)
        print(
            f"| {name} | {scene.count:,} | " + " | ".join(f"{v:.2f}" for v in found) + f" | {seconds:.0f} |", flush=True
        )


if __name__ == "__main__":
    main()
