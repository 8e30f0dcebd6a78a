"""A blotchy wall as a map, filmed from a few places: everything localization needs, exact."""

from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch

from swimm3r.cameras import Cameras
from swimm3r.geometry import pose_from, so3_exp
from swimm3r.io.images import write_rgb
from swimm3r.medium import Medium
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import DepthMap, DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.splat.medium.field import initial_field
from swimm3r.splat.primitives.beta import BetaPrimitives, inverse_softplus
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import MediumFieldSettings, UwbsSettings

WATER = Medium(torch.tensor([0.1, 0.3, 0.4]), torch.tensor([0.2, 0.1, 0.08]), torch.tensor([0.2, 0.1, 0.1]))


@dataclass(frozen=True)
class Place:
    """The map, six frames of which four are registered, and the cameras of all."""

    scene: SplatMap
    rec: Reconstruction
    frames: Frames
    cameras: Cameras


@pytest.fixture(scope="session")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    folder: Path = tmp_path_factory.mktemp("place")
    scene = _blotchy_wall()
    turns = 0.03 * torch.randn(6, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    centers = torch.zeros(6, 3, dtype=torch.float64)
    centers[:, 0] = torch.linspace(-0.4, 0.4, 6)
    K = torch.tensor([[260.0, 0, 122], [0, 260, 88], [0, 0, 1]], dtype=torch.float64).repeat(6, 1, 1)
    cameras = Cameras(K, torch.zeros(6, 0, dtype=torch.float64), pose_from(so3_exp(turns), centers), 240, 180)
    depth, listed = DepthMaps(folder / "z_depth"), []
    for i in range(6):
        out = scene.render(cameras[i])
        path = folder / f"{i}.png"
        write_rgb(path, out.rgb.numpy())
        depth.write(path.name, DepthMap(out.z_depth, torch.ones_like(out.z_depth)))
        listed.append(Frame(path.name, path, 0.2 * i, 1.0, "test" if i in (2, 4) else "train"))
    frames = Frames(tuple(listed), 240, 180, True)
    none, xyz = torch.zeros(0, dtype=torch.int64), scene.primitives.xyz
    rec = Reconstruction(
        names=frames.train.names,
        cameras=cameras[[0, 1, 3, 5]],
        points=Points(xyz.double(), _beta(scene).rgb, torch.zeros(len(xyz))),
        tracks=Tracks(none, none, torch.zeros(0, 2)),
        matches=Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)),
        depth=depth,
        backend="truth",
        metric=True,
    )
    return Place(scene, rec, frames, cameras)


def _beta(scene: SplatMap) -> BetaPrimitives:
    assert isinstance(scene.primitives, BetaPrimitives)
    return scene.primitives


def _blotchy_wall() -> SplatMap:
    rng = torch.Generator().manual_seed(0)
    y, x = torch.meshgrid(torch.linspace(-1.4, 1.4, 110), torch.linspace(-1.8, 1.8, 140), indexing="ij")
    xyz = torch.stack([x, y, 2 + 0.1 * torch.sin(2 * x) * torch.cos(3 * y)], -1).reshape(-1, 3)
    blotches = torch.zeros(3, 110, 140) + sum(
        torch.nn.functional.interpolate(torch.rand(1, 3, n, n, generator=rng), (110, 140), mode="bicubic")[0] / n**0.3
        for n in (12, 40, 90)
    )
    rgb = (blotches - blotches.amin()) / (blotches.amax() - blotches.amin())
    n = len(xyz)
    p = BetaPrimitives(
        xyz,
        torch.nn.functional.normalize(xyz, dim=-1),
        rgb.permute(1, 2, 0).reshape(-1, 3).contiguous(),
        torch.full((n,), 3.0),
        torch.zeros(n, 4),
        inverse_softplus(torch.cat([torch.full((n, 3), 0.04), torch.ones(n, 3)], -1)),
        torch.zeros(n, 15),
        torch.zeros(n),
    )
    field = initial_field(WATER, MediumFieldSettings(), torch.Generator().manual_seed(0)).requires_grad_(False)
    return SplatMap(p, field, replace(UwbsSettings(), long_side=240), True)
