"""A small finished run: a wall in water filmed by six turning cameras of one bent lens, and its map."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.splat.conftest import WATER, make_wall

from swimm3r.cameras import Cameras, project
from swimm3r.devices import torch_threads
from swimm3r.geometry import so3_exp
from swimm3r.io.images import write_rgb
from swimm3r.medium import AttenuationCurve, Medium, MediumFit
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import DenseCloud, DepthMap, DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.scene.white_balance import WhiteBalance
from swimm3r.splat.gaussian_settings import WaterSplattingSettings
from swimm3r.splat.medium.field import initial_field
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.primitives.gaussian import GaussianPrimitives
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import UwbsSettings, with_recipe

COUNT, WIDTH, HEIGHT = 6, 64, 48
BALANCE = WhiteBalance((1.25, 1.0, 0.8))
TIMES = tuple(0.25 * i for i in range(COUNT))


@pytest.fixture(autouse=True)
def threads_of_torch() -> Iterator[None]:
    """gsply, called directly by a test, would leave torch with as many threads as there are cores."""
    with torch_threads():
        yield


def cameras() -> Cameras:
    K = torch.tensor([[60.0, 0, 33], [0, 61, 23], [0, 0, 1]], dtype=torch.float64).repeat(COUNT, 1, 1)
    poses = torch.eye(4, dtype=torch.float64).repeat(COUNT, 1, 1)
    i = torch.arange(COUNT, dtype=torch.float64)
    poses[:, :3, :3] = so3_exp(torch.stack([0.03 * i, -0.02 * i, 0.05 * i], -1))
    poses[:, :3, 3] = torch.stack([0.2 * i - 0.5, 0.1 * torch.sin(i), 0.05 * i], -1)
    bent = torch.tensor([[0.02, -0.01, 0.001, -0.002]], dtype=torch.float64).repeat(COUNT, 1)
    return Cameras(K, bent, poses, WIDTH, HEIGHT, "OPENCV")


def harmonic_map() -> SplatMap:
    """The wall in Gaussians whose colors change with the direction, in the wall's water."""
    wall = make_wall(400)
    p, rng = wall.primitives, torch.Generator().manual_seed(1)
    assert isinstance(p, BetaPrimitives)
    n = len(p.xyz)
    gaussians = GaussianPrimitives(
        p.xyz, torch.randn(n, 4, generator=rng), torch.full((n, 3), -2.5) + 0.3 * torch.randn(n, 3, generator=rng),
        p.opacity, (p.rgb - 0.5) / 0.28209479, 0.05 * torch.randn(n, 15, 3, generator=rng),
        torch.zeros(n),
    )  # fmt: skip
    settings = with_recipe(UwbsSettings(), "watersplatting")
    assert isinstance(settings, WaterSplattingSettings)
    return SplatMap(gaussians, initial_field(WATER, settings.medium, rng), settings, True)


def write_run(folder: Path, scene: SplatMap | None) -> Reconstruction:
    """A run folder with prepared frames, structure from motion and, if given, a map."""
    rng, placed = np.random.default_rng(0), cameras()
    names = tuple(f"deck/{i:04d}.png" for i in range(COUNT))
    listed = []
    for i, name in enumerate(names):
        write_rgb(folder / "given" / name, rng.integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8))
        listed.append(Frame(name, folder / "given" / name, TIMES[i], 1.0, "train"))
    frames = Frames(tuple(listed), WIDTH, HEIGHT, True)
    frames.save(folder / "prepare")
    depth, flat = DepthMaps(folder / "sfm" / "z_depth"), torch.zeros(3)
    for i, name in enumerate(names):
        z = torch.from_numpy(rng.uniform(1, 7, (HEIGHT, WIDTH)).astype(np.float32))
        z[:4] = 0
        depth.write(name, DepthMap(z, torch.ones(HEIGHT, WIDTH)))
        write_rgb(folder / "sfm" / "restored" / f"{name}.png", np.full((HEIGHT, WIDTH, 3), 40 * i, np.uint8))
    points = torch.from_numpy(rng.uniform([-0.5, -0.5, 3], [0.5, 0.5, 4], (30, 3)))
    pixels, _ = project(placed, points.expand(COUNT, -1, -1))
    frame, point = (index.flatten() for index in torch.meshgrid(torch.arange(COUNT), torch.arange(30), indexing="ij"))
    cloud = torch.from_numpy(rng.integers(0, 256, (500, 3)) / 255).float()
    none = torch.zeros(0, dtype=torch.int64)
    rec = Reconstruction(
        names=names,
        cameras=placed,
        points=Points(points, torch.from_numpy(rng.integers(0, 256, (30, 3)) / 255).float(), torch.ones(30).double()),
        tracks=Tracks(point, frame, pixels.flatten(0, 1)),
        matches=Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)),
        depth=depth,
        backend="truth",
        metric=True,
        medium=MediumFit(
            Binf=flat, beta_D=flat, beta_B=flat, curve=AttenuationCurve(flat, flat, flat, flat),
            std=Medium(flat, flat, flat), z_range=(1.0, 4.0), encoding="srgb",
            identifiable={name: torch.ones(3, dtype=torch.bool) for name in ("Binf", "beta_D", "beta_B")},
        ),
        cloud=DenseCloud(torch.from_numpy(rng.normal(size=(500, 3))).float(), cloud, cloud.flip(0)),
        white_balance=BALANCE,
    )  # fmt: skip
    rec.save(folder / "sfm", frames)
    stages = ["prepare", "sfm"]
    if scene is not None:
        scene.save(folder / "splat" / "map.safetensors")
        stages.append("splat")
    done = {name: {"status": "done", "key": name} for name in stages}
    summary = {"schema": 2, "input": {"path": "dive.mp4", "fingerprint": "none"}, "stages": done}
    (folder / "summary.json").write_text(json.dumps(summary))
    return rec


@pytest.fixture(scope="session")
def wall_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose map is of Beta primitives."""
    folder = tmp_path_factory.mktemp("export") / "wall"
    write_run(folder, make_wall(600))
    return folder


@pytest.fixture(scope="session")
def harmonic_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose map is of Gaussians with spherical harmonics."""
    folder = tmp_path_factory.mktemp("export") / "harmonic"
    write_run(folder, harmonic_map())
    return folder


@pytest.fixture(scope="session")
def sfm_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of structure from motion alone."""
    folder = tmp_path_factory.mktemp("export") / "sfm"
    write_run(folder, None)
    return folder
