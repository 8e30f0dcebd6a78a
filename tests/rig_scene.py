"""A rig without images: its cameras along a winding path over rough ground, seen with exact or noisy pixels."""

from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from swimm3r.cameras import Cameras, project_visible
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.scene.rig import Rig, RigCamera

WIDTH, HEIGHT, FOCAL = 640, 480, 500.0
BASELINE = 0.1  # metres
UNIT = 0.25  # metres of a unit of the reconstruction
RIGHT = np.eye(4)  # pose of the right camera in the axes of the left one, metres
RIGHT[:3, :3] = Rotation.from_rotvec([0.01, -0.02, 0.005]).as_matrix()
RIGHT[0, 3] = BASELINE


def path(at: np.ndarray) -> np.ndarray:
    """cam2world [n, 4, 4] in metres of a camera that looks down, at places along a path (one unit per image)."""
    poses = np.tile(np.eye(4), (len(at), 1, 1))
    turns = np.stack([np.pi + 0.1 * np.sin(at), 0.12 * np.cos(at / 2), 0.5 * np.sin(at / 5)], 1)
    poses[:, :3, :3] = Rotation.from_euler("xyz", turns).as_matrix()
    poses[:, :3, 3] = np.stack([0.15 * at, 0.6 * np.sin(at / 4), 1.5 + 0.2 * np.cos(at / 3)], 1)
    return poses


def stereo(count: int = 14, later: float = 0.0, seed: int = 0) -> tuple[np.ndarray, Frames]:
    """cam2world [2 n, 4, 4] in metres of left and right in turn, and their frames."""
    at = np.arange(count, dtype=float)
    poses = np.stack([path(at), path(at + later) @ RIGHT], 1).reshape(-1, 4, 4)
    frames = tuple(
        Frame(f"{side}/{i:04d}.png", Path(f"{side}/{i:04d}.png"), float(i), 1.0, "train", camera=side, instant=i)
        for i in range(count)
        for side in ("left", "right")
    )
    rig = Rig((RigCamera("left"), RigCamera("right")))
    return poses, Frames(frames, WIDTH, HEIGHT, True, rig=rig)


def reconstruction(
    poses: np.ndarray, frames: Frames, noise_px: float = 0.0, noise: float = 0.0, seed: int = 0
) -> Reconstruction:
    """The frames with points and tracks, in units of `UNIT` metres; noise of the pixels, and of poses in units."""
    rng = np.random.default_rng(seed)
    scaled = poses.copy()
    scaled[:, :3, 3] /= UNIT
    count = len(poses)
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    cameras = Cameras(K.repeat(count, 1, 1), torch.zeros(count, 0).double(), torch.from_numpy(scaled), WIDTH, HEIGHT)
    ground = np.stack([rng.uniform(-2, 4.5, 1200), rng.uniform(-2.5, 2.5, 1200), 0.15 * rng.normal(size=1200)], 1)
    xyz = torch.from_numpy(ground / UNIT)
    xy, _, seen = project_visible(cameras, xyz[None].expand(count, -1, -1))
    often = seen.sum(0) >= 3
    xyz, xy, seen = xyz[often], xy[:, often], seen[:, often]
    frame, point = seen.nonzero().T
    pixels = xy[frame, point] + noise_px * torch.from_numpy(rng.normal(size=(len(frame), 2)))
    moved = cameras.cam2world.clone()
    moved[:, :3, 3] += noise * torch.from_numpy(rng.normal(size=(count, 3)))
    none = torch.zeros(0, dtype=torch.int64)
    return Reconstruction(
        names=frames.names,
        cameras=Cameras(cameras.K, cameras.distortion, moved, WIDTH, HEIGHT),
        points=Points(xyz, torch.rand(len(xyz), 3), torch.full((len(xyz),), noise_px, dtype=torch.float64)),
        tracks=Tracks(point, frame, pixels),
        matches=Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)),
        depth=DepthMaps(Path("z_depth")),
        backend="truth",
    )
