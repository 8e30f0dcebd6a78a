"""Restore single images with known coefficients of the water and known depth.

    python examples/restore_images.py IMAGE... --depth FOLDER --cameras cameras.json --out FOLDER
        [--binf 0.09 0.53 0.52] [--beta-d 0.48 0.15 0.12] [--beta-b 0.36 0.26 0.24]

The coefficients are those of red, green and blue, per unit of the depth maps; a run has them in its summary.json. The
defaults are the water of the synthetic dive. FOLDER of --depth holds NAME.npz (as in RUN/sfm/z_depth), NAME.tif or
NAME.png for IMAGE's NAME; where a flat scene has one distance, give --distance in its place. Water acts along the ray,
so the camera's intrinsics are needed: --cameras is a cameras.json, whose first camera is taken.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

import swimm3r
from swimm3r.cameras import image_directions, ray_depth_from_z, resized
from swimm3r.io.depth import SUFFIXES, read_depth
from swimm3r.io.images import read_rgb, write_rgb


def main(arguments: Sequence[str] | None = None) -> None:
    """Write every image without its water, under its own name."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True, help="folder for the restored images")
    parser.add_argument("--cameras", type=Path, required=True, help="cameras.json with the intrinsics")
    depth = parser.add_mutually_exclusive_group(required=True)
    depth.add_argument("--depth", type=Path, help="folder of depth maps")
    depth.add_argument("--distance", type=float, help="distance of a flat scene along the optical axis")
    parser.add_argument("--binf", type=float, nargs=3, default=(0.09, 0.53, 0.52), help="veiling light, 0..1")
    parser.add_argument("--beta-d", type=float, nargs=3, default=(0.48, 0.15, 0.12), help="attenuation")
    parser.add_argument("--beta-b", type=float, nargs=3, default=(0.36, 0.26, 0.24), help="backscatter coefficient")
    given = parser.parse_args(arguments)

    water = swimm3r.Medium(*(torch.tensor(values) for values in (given.binf, given.beta_d, given.beta_b)))
    camera = swimm3r.load_cameras(given.cameras)[0]
    given.out.mkdir(parents=True, exist_ok=True)
    for path in given.images:
        stored = read_rgb(path)
        image = torch.from_numpy(stored.astype(np.float32) / np.iinfo(stored.dtype).max)
        height, width = image.shape[:2]
        if given.depth is None:
            z_depth = torch.full((height, width), given.distance)
        else:
            z_depth = torch.from_numpy(read_depth(depth_map_of(path, given.depth)))
        rays = image_directions(resized(camera, width, height)).float()
        restored = swimm3r.remove_water(image, ray_depth_from_z(z_depth, rays), water).clamp(0, 1)
        restored = torch.where((z_depth > 0)[..., None], restored, 0.0)  # where depth is not known, black
        write_rgb(given.out / f"{path.stem}.png", restored.numpy())
        print(f"{path.name}: {(z_depth > 0).float().mean().item():.0%} of the pixels restored")


def depth_map_of(image: Path, folder: Path) -> Path:
    """The depth map of an image: its name, with or without its own suffix."""
    names = [folder / f"{name}{suffix}" for name in (image.name, image.stem) for suffix in SUFFIXES]
    found = next((name for name in names if name.is_file()), None)
    if found is None:
        raise SystemExit(f"{folder} has no depth map of {image.name}; expected for example {names[0].name}")
    return found


if __name__ == "__main__":
    main()
