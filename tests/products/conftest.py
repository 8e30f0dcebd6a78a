"""A small survey of an analytic seabed with exact depth and colors, in the axes and the unit of some run."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from swimm3r.cameras import Cameras, image_directions
from swimm3r.geometry import so3_exp
from swimm3r.io.images import write_rgb, write_rgb_16
from swimm3r.products.survey import Survey, open_survey
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.georeference import Georeference, save_georeference
from swimm3r.scene.reconstruction import DenseCloud, DepthMap, DepthMaps, Matches, Points, Reconstruction, Tracks

ORIGIN = (500_000.0, 5_000_000.0, -30.0)
SCALE, SCALE_STD = 0.4, 0.01  # metres per unit of the run
WIDTH, HEIGHT, FOCAL = 96, 72, 90.0
ALTITUDE = 1.0
LINES, EACH = 3, 4
SIDE, AHEAD = 0.5, 0.35  # metres between lines and frames
_TILT = (0.04, -0.03)


def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height of the seabed in metres: sand waves on a slope, with a smooth mound."""
    waves = 0.03 * np.sin(5 * x) * np.cos(4 * y)
    mound = 0.12 * np.exp(-((x - 0.5) ** 2 + (y - 0.5) ** 2) / 0.04)
    return waves + mound + _TILT[0] * x + _TILT[1] * y


def color(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Colors 0..1 of the seabed without water."""
    waves = [np.sin(a * x + b * y + c) for a, b, c in ((31, 7, 0), (-9, 37, 1), (23, -29, 2))]
    return np.stack([0.5 + 0.3 * wave for wave in waves], -1)


def in_water(clear: np.ndarray) -> np.ndarray:
    """The same through some water: the test needs only that it differs."""
    return clear * np.array([0.4, 0.8, 0.7]) + np.array([0.02, 0.1, 0.12])


@dataclass(frozen=True)
class Seabed:
    """The run folder of the survey."""

    folder: Path

    def survey(self) -> Survey:
        """The run as products read it."""
        return open_survey(self.folder)


def poses() -> np.ndarray:
    """cam2world in metres, z up: lines to the north, cameras nearly straight down."""
    rng, found = np.random.default_rng(0), []
    for line in range(LINES):
        for k in range(EACH):
            wobble = torch.from_numpy(rng.normal(0, 0.05, 3))
            pose = np.eye(4)
            pose[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ so3_exp(wobble[None])[0].numpy()
            pose[:3, 3] = line * SIDE, k * AHEAD, ALTITUDE + rng.normal(0, 0.05)
            found.append(pose)
    return np.stack(found)


def seen_by(camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Places where the pixels of a camera (metres) meet the seabed, and their z depth."""
    pose = camera.cam2world[0].numpy()
    rays = image_directions(camera).double().numpy() @ pose[:3, :3].T
    t = np.full(rays.shape[:2], ALTITUDE)
    for _ in range(60):
        at = pose[:3, 3] + t[..., None] * rays
        t = (height(at[..., 0], at[..., 1]) - pose[2, 3]) / rays[..., 2]
    return pose[:3, 3] + t[..., None] * rays, t


def run_from_world() -> tuple[np.ndarray, float]:
    """Rotation and scale from metres to the run's axes and unit."""
    return so3_exp(torch.tensor([[0.4, -1.1, 0.7]], dtype=torch.float64))[0].numpy(), 1 / SCALE


def write_survey(folder: Path) -> None:
    """A run folder with frames, structure from motion and georeference."""
    world = poses()
    count = len(world)
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64).repeat(
        count, 1, 1
    )
    metres = Cameras(K, torch.zeros(count, 0, dtype=torch.float64), torch.from_numpy(world), WIDTH, HEIGHT)
    R, s = run_from_world()
    placed = world.copy()
    placed[:, :3, :3] = R @ world[:, :3, :3]
    placed[:, :3, 3] = s * world[:, :3, 3] @ R.T
    names, listed, cloud, colors = [], [], [], []
    depth = DepthMaps(folder / "sfm" / "z_depth")
    for i in range(count):
        name = f"{i:04d}.png"
        at, z = seen_by(metres[i])
        clear = color(at[..., 0], at[..., 1])
        write_rgb(folder / "given" / name, in_water(clear))
        write_rgb(folder / "sfm" / "restored" / f"{name}.png", clear)
        write_rgb_16(folder / "sfm" / "restored_physical" / f"{name}.png", clear)
        depth.write(name, DepthMap(torch.from_numpy(z * s).float(), torch.ones(HEIGHT, WIDTH)))
        names.append(name)
        listed.append(Frame(name, folder / "given" / name, float(i), 1.0, "train"))
        cloud.append((s * at @ R.T).reshape(-1, 3)[::3])
        colors.append(clear.reshape(-1, 3)[::3])
    frames = Frames(tuple(listed), WIDTH, HEIGHT, True)
    frames.save(folder / "prepare")
    xyz, rgb = torch.from_numpy(np.concatenate(cloud)), torch.from_numpy(np.concatenate(colors)).float()
    none = torch.zeros(0, dtype=torch.int64)
    rec = Reconstruction(
        names=tuple(names),
        cameras=Cameras(K, metres.distortion, torch.from_numpy(placed), WIDTH, HEIGHT),
        points=Points(xyz[::50], rgb[::50], torch.ones(len(xyz[::50])).double()),
        tracks=Tracks(none, none, torch.zeros(0, 2)),
        matches=Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)),
        depth=depth,
        backend="truth",
        cloud=DenseCloud(xyz.float(), rgb * 0.5, rgb),
    )
    rec.save(folder / "sfm", frames)
    rows = tuple(tuple(float(value) for value in row) for row in R.T)
    save_georeference(
        folder,
        Georeference(32631, ORIGIN, rows, SCALE, SCALE_STD, ("a scale bar",), (0.05, 0.05, 0.1), (0.0, 0.0, 0.0)),  # pyright: ignore[reportArgumentType]
    )
    (folder / "settings.yaml").write_text("frames:\n  fps: 5.0\n")
    (folder / "versions.json").write_text('{"swimm3r": "0.2.0"}')
    (folder / "log.jsonl").write_text('{"time": "2026-11-22T17:12:43+0000", "event": "opened"}\n')
    cost = {"status": "done", "seconds": 1.0, "cpu_seconds": 1.0, "peak_mb": 100}
    done = {name: {**cost, "key": name} for name in ("prepare", "sfm")}
    (folder / "summary.json").write_text(
        json.dumps({"schema": 2, "input": {"path": "dive.mp4", "fingerprint": "none"}, "stages": done})
    )


@pytest.fixture(scope="session")
def seabed(tmp_path_factory: pytest.TempPathFactory) -> Seabed:
    """The survey, which no test writes into."""
    folder = tmp_path_factory.mktemp("products") / "seabed"
    write_survey(folder)
    return Seabed(folder)
