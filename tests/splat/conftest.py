"""Primitives, cameras and a tiny dive for the map's tests."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch

from swimm3r.cameras import Cameras, project_visible
from swimm3r.io.images import write_rgb
from swimm3r.medium import AttenuationCurve, Medium, MediumFit
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import DenseCloud, DepthMap, DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.selftest.scenes import beta_primitives, turned_camera
from swimm3r.splat.medium.field import initial_field
from swimm3r.splat.primitives.beta import BetaPrimitives, inverse_softplus
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import MediumFieldSettings, UwbsSettings


@pytest.fixture
def primitives() -> Callable[..., BetaPrimitives]:
    """Random primitives two to five units in front of the origin: `primitives(n, c=3, seed=0)`, float64."""

    return beta_primitives


@pytest.fixture
def camera() -> Callable[..., Cameras]:
    """A slightly turned pinhole camera near the origin, principal point off center: `camera(width=80, height=56)`."""

    return turned_camera


WATER = Medium(torch.tensor([0.1, 0.4, 0.5]), torch.tensor([0.4, 0.15, 0.1]), torch.tensor([0.3, 0.2, 0.2]))


@pytest.fixture
def wall() -> Callable[..., SplatMap]:
    """An opaque textured wall around z = 3 in known water: `wall(n=1500)`."""
    return make_wall


def make_wall(n: int = 1500) -> SplatMap:
    rng = torch.Generator().manual_seed(0)
    x, y = 2.6 * (2 * torch.rand(2, n, generator=rng) - 1)
    xyz = torch.stack([x, 0.8 * y, 3 + 0.2 * torch.sin(2 * x) * torch.cos(3 * y)], -1)
    waves = [torch.sin(5 * x + 2 * y), torch.sin(7 * y - x), torch.cos(4 * x - 5 * y)]
    spread = torch.cat([torch.full((n, 3), 0.25), torch.ones(n, 3)], -1)
    p = BetaPrimitives(
        xyz,
        torch.nn.functional.normalize(xyz, dim=-1),
        0.5 + 0.35 * torch.stack(waves, -1),
        torch.full((n,), 3.0),
        torch.zeros(n, 4),
        inverse_softplus(spread),
        torch.zeros(n, 15),
        torch.full((n,), 0.02),
    )
    field = initial_field(WATER, MediumFieldSettings(), torch.Generator().manual_seed(0)).requires_grad_(False)
    return SplatMap(p, field, UwbsSettings(), True)


@dataclass(frozen=True)
class TinyDive:
    """Nine images of the wall, two of them held back, with what structure from motion would know."""

    rec: Reconstruction
    frames: Frames
    truth: SplatMap
    cameras: Cameras  # of all nine


@pytest.fixture(scope="session")
def tiny_dive(tmp_path_factory: pytest.TempPathFactory) -> TinyDive:
    folder: Path = tmp_path_factory.mktemp("tiny")
    truth, width, height, count = make_wall(), 64, 48, 9
    K = torch.tensor([[60.0, 0, 33], [0, 60, 23], [0, 0, 1]], dtype=torch.float64).repeat(count, 1, 1)
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    poses[:, 0, 3] = torch.linspace(-0.6, 0.6, count)
    poses[:, 1, 3] = 0.2 * torch.sin(torch.arange(count))
    cameras = Cameras(K, torch.zeros(count, 0, dtype=torch.float64), poses, width, height)
    depth = DepthMaps(folder / "z_depth")
    listed = []
    for i in range(count):
        out = truth.render(cameras[i])
        path = folder / f"{i}.png"
        write_rgb(path, out.rgb.numpy())
        depth.write(path.name, DepthMap(out.z_depth, torch.ones_like(out.z_depth)))
        listed.append(Frame(path.name, path, float(i), 1.0, "test" if i % 8 == 0 else "train"))
    frames = Frames(tuple(listed), width, height, True)
    flat = torch.zeros(3)
    assert isinstance(truth.primitives, BetaPrimitives)
    xyz, rgb = truth.primitives.xyz, truth.primitives.rgb
    none = torch.zeros(0, dtype=torch.int64)
    rec = Reconstruction(
        names=frames.train.names,
        cameras=cameras[1:8],
        points=Points(xyz.double(), rgb, torch.zeros(len(xyz))),
        tracks=Tracks(none, none, torch.zeros(0, 2)),
        matches=Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)),
        depth=depth,
        backend="truth",
        metric=True,
        medium=MediumFit(
            **vars(WATER),
            curve=AttenuationCurve(WATER.beta_D, flat, flat, flat),
            std=Medium(flat, flat, flat),
            identifiable={name: torch.ones(3, dtype=torch.bool) for name in ("Binf", "beta_D", "beta_B")},
            z_range=(1.0, 4.0),
            encoding="srgb",
        ),
        cloud=DenseCloud(xyz, rgb, rgb),
    )  # fmt: skip
    return TinyDive(rec, frames, truth, cameras)


GAINS = torch.tensor([[0.8, 0.9, 1.1], [1.2, 1.1, 0.85], [1.0, 0.8, 1.0], [0.9, 1.2, 1.15], [1.1, 1.0, 0.9]])
"""Of frames of the tiny dive that were exposed and balanced each by itself, in turn."""


@pytest.fixture(scope="session")
def tracked(tiny_dive) -> Reconstruction:
    """The tiny dive's reconstruction, the wall's points tracked by every frame that shows them."""
    xyz = tiny_dive.rec.points.xyz.double().expand(len(tiny_dive.rec.names), -1, 3)
    pixels, _, visible = project_visible(tiny_dive.rec.cameras, xyz)
    frame, point = torch.nonzero(visible).unbind(-1)
    return replace(tiny_dive.rec, tracks=Tracks(point, frame, pixels[visible].float()))


@pytest.fixture(scope="session")
def relit(tiny_dive, tmp_path_factory) -> Frames:
    """The tiny dive's frames, each exposed and balanced by itself."""
    folder: Path = tmp_path_factory.mktemp("relit")
    listed = []
    for i, frame in enumerate(tiny_dive.frames):
        path = folder / frame.name
        write_rgb(path, (tiny_dive.frames.image(i) * GAINS[i % 5]).clamp(0, 1).numpy())
        listed.append(replace(frame, path=path))
    return replace(tiny_dive.frames, frames=tuple(listed))
