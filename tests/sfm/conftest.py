"""A small dive over a flat, textured seafloor: exact depth maps, images with water, known truth."""

from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from torch import Tensor

from swimm3r.cameras import Cameras, image_directions, ray_depth_from_z
from swimm3r.io import images
from swimm3r.medium import AttenuationCurve, Medium, MediumFit, add_water
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import DepthMap, DepthMaps, Matches, Points, Reconstruction, Tracks

HEIGHT, WIDTH, FOCAL = 72, 96, 80.0


@dataclass(frozen=True)
class FlatDive:
    """Cameras that look straight down on the plane z = 0 from several heights."""

    frames: Frames
    rec: Reconstruction
    medium: Medium
    clear: list[Tensor]  # J per frame

    def seafloor(self, xy: Tensor) -> Tensor:
        """J of the plane at points (x, y)."""
        return seafloor(xy)


def seafloor(xy: Tensor) -> Tensor:
    """J of the plane at points (x, y): patches of several sizes, from black to bright, of all colors."""
    x, y = xy.unbind(-1)
    waves = [torch.sin(a * x + b * y + c) for a, b, c in ((7, 2, 0), (3, -9, 1), (15, 11, 2), (-4, 5, 3), (1, 1.5, 4))]
    value = torch.stack([waves[0] + waves[1], waves[1] + waves[2], waves[2] + waves[0]], -1) * 0.12
    shade = torch.sigmoid(12 * (waves[3] + 0.8))[..., None] * (0.75 + 0.25 * waves[4])[..., None]
    return ((0.45 + value) * shade).clamp(0.0, 0.95)


def flat_dive(folder: Path, medium: Medium, heights: tuple[float, ...]) -> FlatDive:
    """Write the images and depth maps of a flat dive."""
    count = len(heights)
    cam2world = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    for k, height in enumerate(heights):  # looking along +z at the plane z = 0
        cam2world[k, :3, 3] = torch.tensor([0.1 * k - 0.2, 0.05 * (k % 2), -height])
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    cameras = Cameras(K.repeat(count, 1, 1), torch.zeros(count, 0, dtype=torch.float64), cam2world, WIDTH, HEIGHT)
    depth = DepthMaps(folder / "z_depth")
    frames, clear = [], []
    for k, height in enumerate(heights):
        rays = image_directions(cameras[k])
        J = seafloor((rays * height)[..., :2] + cam2world[k, :2, 3]).float()
        z_depth = torch.full((HEIGHT, WIDTH), height)
        raw = add_water(J, ray_depth_from_z(z_depth, rays.float()), medium)
        name = f"{k:04d}.png"
        (folder / "images").mkdir(exist_ok=True)
        images.write_rgb(folder / "images" / name, raw.clamp(0, 1).numpy())
        depth.write(name, DepthMap(z_depth, torch.ones_like(z_depth)))
        frames.append(Frame(name, folder / "images" / name, float(k), 1.0, "train"))
        clear.append(J)
    none, index = torch.zeros(0), torch.zeros(0, dtype=torch.long)
    rec = Reconstruction(
        tuple(frame.name for frame in frames),
        cameras,
        Points(none.reshape(0, 3), none.reshape(0, 3), none),
        Tracks(index, index, none.reshape(0, 2)),
        Matches(index, index, none.reshape(0, 2), none.reshape(0, 2), none),
        depth,
        "truth",
    )
    return FlatDive(Frames(tuple(frames), WIDTH, HEIGHT, True), rec, medium, clear)


@pytest.fixture(scope="session")
def teal() -> Medium:
    return Medium(torch.tensor([0.09, 0.53, 0.5]), torch.tensor([0.5, 0.16, 0.13]), torch.tensor([0.38, 0.24, 0.2]))


@pytest.fixture(scope="session")
def dive(tmp_path_factory: pytest.TempPathFactory, teal: Medium) -> FlatDive:
    """Seven frames from 1 to 4 units above the ground."""
    return flat_dive(tmp_path_factory.mktemp("flat"), teal, (1.0, 1.3, 1.7, 2.2, 2.8, 3.4, 4.0))


@pytest.fixture(scope="session")
def known_water(teal: Medium) -> MediumFit:
    """The true water as if it had been fitted."""
    zero, yes = torch.zeros(3), torch.ones(3, dtype=torch.bool)
    known: dict[str, torch.Tensor] = {name: yes for name in ("Binf", "beta_D", "beta_B")}
    return MediumFit(
        **vars(teal),
        curve=AttenuationCurve(teal.beta_D, zero, zero, zero),
        std=Medium(zero, zero, zero),
        identifiable=known,
        z_range=(0.1, 50.0),
        encoding="srgb",
    )
