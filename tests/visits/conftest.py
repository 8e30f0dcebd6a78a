"""Two visits to a small analytic seabed, with exact depth and water and real features, each in axes of its own."""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import ndimage

from swimm3r.cameras import Cameras, image_directions
from swimm3r.geometry import so3_exp
from swimm3r.io.images import write_rgb, write_rgb_16
from swimm3r.medium import AttenuationCurve, Medium, MediumFit, add_water
from swimm3r.products.survey import Survey, open_survey
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.georeference import Georeference, save_georeference
from swimm3r.scene.reconstruction import DepthMap, DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.sfm.colmap.triangulation import triangulate
from swimm3r.sfm.features.settings import FeatureSettings

WIDTH, HEIGHT, FOCAL = 240, 180, 220.0
ALTITUDE = 1.0
TRANSMITTED = (0.05, 0.8, 0.8)  # light from the ground straight below
SIDE, AHEAD = 0.45, 0.3  # metres between lines and frames
LINES, EACH = 2, 4
MOUND = (0.25, 0.3, 0.12, 0.05)  # x, y, radius and height of what has grown at the second visit
BLEACHED = (0.55, 0.75, 0.1)  # x, y and radius
LATER_LIGHT = (0.7, 0.9, 1.0)
ORIGIN = (500_000.0, 5_000_000.0, -30.0)


def dome_volume() -> float:
    """Volume of the mound, a paraboloid, m^3."""
    return np.pi * MOUND[2] ** 2 * MOUND[3] / 2


@cache
def _texture(seed: int) -> np.ndarray:
    """Colors of the ground 0..1, a cell every 4 mm over 4 x 4 m."""
    rng = np.random.default_rng(seed)
    layers = [ndimage.gaussian_filter(rng.normal(size=(1000, 1000)), s) * s for s in (1.2, 2.5, 6, 15)]
    gray = np.sum(layers, axis=0) / np.std(np.sum(layers, axis=0))
    tint = ndimage.gaussian_filter(rng.normal(size=(1000, 1000, 3)), (8, 8, 0)) * 8
    return np.clip(0.42 + 0.13 * gray[..., None] + 0.03 * tint, 0.05, 0.95)


@dataclass(frozen=True)
class Seabed:
    """The ground at one visit."""

    seed: int = 0
    changed: bool = False
    light: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Height in metres."""
        waves = 0.03 * np.sin(5 * x) * np.cos(4 * y)
        r = np.hypot(x - MOUND[0], y - MOUND[1]) / MOUND[2]
        return waves + (MOUND[3] * np.clip(1 - r**2, 0, None) if self.changed else 0)

    def color(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Clear colors 0..1 in the light of this visit."""
        at = np.stack([(y + 1.5) / 0.004, (x + 1.5) / 0.004])
        texture = _texture(self.seed)
        found = np.stack([ndimage.map_coordinates(texture[..., k], at, order=1, mode="wrap") for k in range(3)], -1)
        if self.changed:
            white = np.hypot(x - BLEACHED[0], y - BLEACHED[1]) < BLEACHED[2]
            found = np.where(white[..., None], 0.6 + 0.35 * found, found)
        return found * np.array(self.light)


def _poses(rng: np.random.Generator, east: float) -> np.ndarray:
    found = []
    for line in range(LINES):
        for k in range(EACH):
            pose = np.eye(4)
            turn = torch.from_numpy(rng.normal(0, 0.06, 3))[None]
            pose[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ so3_exp(turn)[0].numpy()
            pose[:3, 3] = east + line * SIDE, k * AHEAD, ALTITUDE
            pose[:3, 3] += rng.normal(0, 0.03, 3)
            found.append(pose)
    return np.stack(found)


def _water(scale: float) -> MediumFit:
    """Water that leaves 0.05 of red and 0.8 of green and blue at the altitude, in a unit of 1 / `scale` metres."""
    beta = -torch.tensor(TRANSMITTED, dtype=torch.float64).log() / (ALTITUDE * scale)
    none = torch.zeros(3, dtype=torch.float64)
    known = {name: torch.ones(3, dtype=torch.bool) for name in ("Binf", "beta_D", "beta_B")}
    curve = AttenuationCurve(beta, none, none, none)
    return MediumFit(0.5 * torch.ones(3), beta, beta, curve, Medium(none, none, none), known, (0.1, 9.0), "srgb")


def _filmed(clear: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Colors through the water at distances in metres."""
    z = torch.from_numpy(distance)
    return add_water(torch.from_numpy(clear), z, _water(1.0).at(z)).numpy()


def write_visit(folder: Path, seabed: Seabed, seed: int, *, place: bool, east: float = 0.0) -> None:
    """A run folder of a visit with finished structure from motion, its axes and unit drawn from the seed."""
    rng = np.random.default_rng(seed)
    world, scale = _poses(rng, east), rng.uniform(0.4, 2.5)
    R = so3_exp(torch.from_numpy(rng.normal(0, 1, 3))[None])[0].numpy()
    count = len(world)
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    K = K.repeat(count, 1, 1)
    metres = Cameras(K, torch.zeros(count, 0, dtype=torch.float64), torch.from_numpy(world), WIDTH, HEIGHT)
    own = world.copy()
    own[:, :3, :3] = R @ world[:, :3, :3]
    own[:, :3, 3] = scale * world[:, :3, 3] @ R.T
    names, listed = [], []
    depth = DepthMaps(folder / "sfm" / "z_depth")
    for i in range(count):
        name = f"{i:04d}.png"
        rays = image_directions(metres[i]).double().numpy() @ world[i, :3, :3].T
        t = np.full(rays.shape[:2], ALTITUDE)
        for _ in range(40):
            at = world[i, :3, 3] + t[..., None] * rays
            t = (seabed.height(at[..., 0], at[..., 1]) - world[i, 2, 3]) / rays[..., 2]
        clear = np.clip(seabed.color(at[..., 0], at[..., 1]), 0, 1)
        write_rgb(folder / "given" / name, _filmed(clear, t * np.linalg.norm(rays, axis=-1)))
        write_rgb_16(folder / "sfm" / "restored_physical" / f"{name}.png", clear)
        noise = rng.normal(0, 0.001, t.shape)
        z = torch.from_numpy((t + noise) * scale).float()
        depth.write(name, DepthMap(z, torch.ones(HEIGHT, WIDTH)))
        names.append(name)
        listed.append(Frame(name, folder / "given" / name, float(i), 1.0, "train"))
    frames = Frames(tuple(listed), WIDTH, HEIGHT, True)
    frames.save(folder / "prepare")
    none = torch.zeros(0, dtype=torch.int64)
    empty = torch.zeros(0, 3, dtype=torch.float64)
    bare = Reconstruction(
        names=tuple(names),
        cameras=Cameras(K, metres.distortion, torch.from_numpy(own), WIDTH, HEIGHT),
        points=Points(empty, empty.float(), torch.zeros(0, dtype=torch.float64)),
        tracks=Tracks(none, none, torch.zeros(0, 2, dtype=torch.float64)),
        matches=Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)),
        depth=depth,
        backend="truth",
        medium=_water(scale),
    )
    triangulate(bare, frames, FeatureSettings(), folder / "features").save(folder / "sfm", frames)
    if place:
        rows = tuple(tuple(float(value) for value in row) for row in R.T)
        georeference = Georeference(32631, ORIGIN, rows, 1 / scale, 0.001, ("a scale bar",))  # pyright: ignore[reportArgumentType]
        save_georeference(folder, georeference)
    (folder / "settings.yaml").write_text("frames:\n  fps: 5.0\n")
    (folder / "versions.json").write_text('{"swimm3r": "0.2.0"}')
    (folder / "log.jsonl").write_text('{"time": "2026-11-22T17:12:43+0000", "event": "opened"}\n')
    cost = {"status": "done", "seconds": 1.0, "cpu_seconds": 1.0, "peak_mb": 100}
    done = {name: {**cost, "key": name} for name in ("prepare", "sfm")}
    (folder / "summary.json").write_text(
        json.dumps({"schema": 2, "input": {"path": "dive.mp4", "fingerprint": "none"}, "stages": done})
    )


@dataclass(frozen=True)
class Visits:
    """Run folders: the first visit in metres; a later one of the changed ground; one of a place far away."""

    first: Path
    later: Path
    elsewhere: Path

    def surveys(self) -> tuple[Survey, Survey]:
        """The first and the later visit as products read them."""
        return open_survey(self.first), open_survey(self.later)


@pytest.fixture(scope="session")
def visits(tmp_path_factory: pytest.TempPathFactory) -> Visits:
    """The runs; nobody may write into them."""
    folder = tmp_path_factory.mktemp("visits")
    made = Visits(folder / "spring", folder / "autumn", folder / "elsewhere")
    write_visit(made.first, Seabed(), 1, place=True)
    write_visit(made.later, Seabed(changed=True, light=LATER_LIGHT), 2, place=False)
    write_visit(made.elsewhere, Seabed(seed=9), 3, place=False)
    return made
