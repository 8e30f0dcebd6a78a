"""Maps of a fine pattern, filtered and dilated, rendered at other sizes than that of their training images.

    python benchmarks/antialiasing.py --out DIR [--iterations 400] [--long-side 160] [--primitives 6000] [--noise 0]

A plane with stripes, rings and spots of 2.4 training pixels is filmed from 12 places, of which 2 are held back, at
exact poses, depth and colors, in clear water. The truth of any size is the mean of 8 x 8 samples per pixel of that
size, without noise. The table holds the PSNR of the views held back, dB; DIR receives the images.
"""

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from swimm3r.cameras import Cameras, image_directions, resized
from swimm3r.evaluate.images import psnr
from swimm3r.io.images import write_rgb
from swimm3r.pipeline.presets import PRESETS
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import DenseCloud, DepthMap, DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.splat import train
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import UwbsSettings

SAMPLES = 8  # per pixel and axis
SIZES = (0.25, 0.5, 1.0, 2.0, 4.0)
VIEWS, HELD_BACK = 12, (4, 9)
DISTANCE = 3.0


def pattern(xy: Float[Tensor, "*p 2"], pixel: float) -> Float[Tensor, "*p 3"]:
    """Colors of the plane: stripes of 3 to 12 times `pixel`, rings that grow finer outward, and spots."""
    x, y = xy.unbind(-1)
    stripes = (torch.sin(6.28318 * x / (pixel * (7.5 + 4.5 * torch.sin(1.7 * y)))) > 0).float()
    rings = 0.5 + 0.5 * torch.sin(9 * (x * x + y * y))
    cell = 5 * pixel
    spots = (
        torch.hypot(torch.remainder(x, cell) - cell / 2, torch.remainder(y, cell) - cell / 2) < 1.2 * pixel
    ).float()
    channels = 0.15 + 0.6 * stripes * rings + 0.2 * spots, 0.2 + 0.5 * rings + 0.25 * spots, 0.3 + 0.4 * stripes
    return torch.stack(channels, -1)


@dataclass(frozen=True)
class Plane:
    """The plane z = 0 and the cameras above it."""

    cameras: Cameras
    pixel: float  # of the training images, on the plane

    def points(self, camera: Cameras) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
        """The points of the plane that a camera's pixels show, and their z depth."""
        rays = image_directions(camera).double() @ camera.cam2world[0, :3, :3].double().mT
        center = camera.centers[0].double()
        z = -center[2] / rays[..., 2]
        return center + rays * z[..., None], z.float()

    def image(self, camera: Cameras) -> Float[Tensor, "h w 3"]:
        """The plane as a camera sees it: means of samples."""
        fine = resized(camera, SAMPLES * camera.width, SAMPLES * camera.height)
        colors = pattern(self.points(fine)[0][..., :2].float(), self.pixel).permute(2, 0, 1)
        return avg_pool2d(colors[None], SAMPLES)[0].permute(1, 2, 0).contiguous()

    def view(self, k: int, size: float) -> Cameras:
        """Camera k with images of another size."""
        return resized(self.cameras[k], round(size * self.cameras.width), round(size * self.cameras.height))


def filmed(long_side: int) -> Plane:
    """Oblique cameras in two rows, about as far from the plane's middle."""
    width, height, f = long_side, round(0.75 * long_side), 1.1 * long_side
    K = torch.tensor([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]], dtype=torch.float64).repeat(VIEWS, 1, 1)
    poses = torch.eye(4, dtype=torch.float64).repeat(VIEWS, 1, 1)
    for k in range(VIEWS):
        place = torch.tensor([0.35 * (k % 6 - 2.5), 0.5 * (k // 6 - 0.5), DISTANCE], dtype=torch.float64)
        ahead = normalize(-place, dim=0)
        right = normalize(torch.linalg.cross(torch.tensor([0.0, -1, 0], dtype=torch.float64), ahead), dim=0)
        poses[k, :3] = torch.stack([right, torch.linalg.cross(ahead, right), ahead, place], -1)
    cameras = Cameras(K, torch.zeros(VIEWS, 0, dtype=torch.float64), poses, width, height)
    return Plane(cameras, DISTANCE / f)


def dive_of(plane: Plane, folder: Path, noise: float) -> tuple[Frames, Reconstruction]:
    """The images of the plane on disk, and the reconstruction that has made no error."""
    rng = torch.Generator().manual_seed(0)
    depth, listed, clouds = DepthMaps(folder / "z_depth"), [], []
    for k in range(VIEWS):
        path = folder / f"{k:02d}.png"
        image, (xyz, z) = plane.image(plane.cameras[k]), plane.points(plane.cameras[k])
        write_rgb(path, (image + noise * torch.randn(image.shape, generator=rng)).clamp(0, 1).numpy())
        depth.write(path.name, DepthMap(z, torch.ones_like(z)))
        listed.append(Frame(path.name, path, float(k), 1.0, "test" if k in HELD_BACK else "train"))
        if k not in HELD_BACK:
            clouds.append((xyz.reshape(-1, 3).float(), image.reshape(-1, 3)))
    frames = Frames(tuple(listed), plane.cameras.width, plane.cameras.height, True)
    xyz, rgb = (torch.cat(parts) for parts in zip(*clouds, strict=True))
    some = slice(None, None, 50)
    none, flat = torch.zeros(0, dtype=torch.int64), torch.zeros(0, 2)
    rec = Reconstruction(
        names=frames.train.names,
        cameras=plane.cameras[[k for k in range(VIEWS) if k not in HELD_BACK]],
        points=Points(xyz[some].double(), rgb[some], torch.zeros(len(xyz[some]))),
        tracks=Tracks(none, none, flat),
        matches=Matches(none, none, flat, flat, torch.zeros(0)),
        depth=depth,
        backend="truth",
        metric=True,
        cloud=DenseCloud(xyz, rgb, rgb),
    )
    return frames, rec


def score(plane: Plane, scene: SplatMap, size: float, out: Path) -> float:
    """Mean PSNR of the views held back, whose images go to `out` and the truth beside it."""
    found = []
    for k in HELD_BACK:
        camera = plane.view(k, size)
        truth, shown = plane.image(camera), scene.render(camera).rgb.clamp(0, 1)
        write_rgb(out.with_name(f"{out.name}_{k}_{size:g}.png"), shown.numpy())
        write_rgb(out.with_name(f"truth_{k}_{size:g}.png"), truth.numpy())
        found.append(psnr(shown, truth))
    return sum(found) / len(found)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--long-side", type=int, default=160)
    parser.add_argument("--primitives", type=int, default=6000)
    parser.add_argument("--noise", type=float, default=0.0, help="standard deviation, pixel values")
    a = parser.parse_args()
    torch.set_num_threads(1)
    fast = PRESETS["fast"].splat
    assert isinstance(fast, UwbsSettings)
    plane = filmed(a.long_side)
    frames, rec = dive_of(plane, a.out / "dive", a.noise)
    settings = replace(
        fast,
        iterations=a.iterations,
        long_side=a.long_side,
        initial=replace(fast.initial, primitives=a.primitives),
        densify=replace(fast.densify, cap_max=2 * a.primitives),
        medium=replace(fast.medium, model="none"),
    )
    print(f"{'':12s}" + "".join(f"{size:>9g}x" for size in SIZES) + "   CPU-s")
    for name in ("dilation", "mip"):
        started = time.process_time()
        render = replace(settings.render, antialiasing=name)
        scene = train(rec, frames, replace(settings, render=render), a.out / name)
        spent = time.process_time() - started
        row = [score(plane, scene, size, a.out / name) for size in SIZES]
        print(f"{name:12s}" + "".join(f"{value:10.2f}" for value in row) + f"{spent:8.0f}", flush=True)


if __name__ == "__main__":
    main()
