"""A scene of two textured planes whose cameras are known: what poses are found from in these tests."""

from pathlib import Path

import cv2
import numpy as np
import torch

from swimm3r.cameras import Cameras
from swimm3r.geometry import align_similarity, rotation_angle, so3_exp
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.settings import ColmapSettings

WIDTH, HEIGHT, FOCAL, COUNT = 320, 240, 260.0, 8
SETTINGS = ColmapSettings(threads=2)
_OPENCV_PIXELS = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])  # the center of the first pixel is (0, 0) there


def texture(seed: int, size: int = 1024) -> np.ndarray:
    rng = np.random.default_rng(seed)
    total = np.zeros((size, size), np.float32)
    for cells in (8, 16, 32, 64, 128, 256):
        total += cv2.resize(rng.random((cells, cells), np.float32), (size, size), interpolation=cv2.INTER_CUBIC)
    return (255 * (total - total.min()) / np.ptp(total)).astype(np.uint8)


def camera_path() -> Cameras:
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    cam2world = torch.eye(4, dtype=torch.float64).repeat(COUNT, 1, 1)
    s = torch.linspace(-1, 1, COUNT, dtype=torch.float64)
    zero = torch.zeros_like(s)
    cam2world[:, :3, :3] = so3_exp(torch.stack([0.12 * torch.cos(3 * s), -0.35 * s, 0.05 * s], 1))
    cam2world[:, :3, 3] = torch.stack([1.3 * s, 0.3 * torch.sin(3 * s), zero], 1)
    return Cameras(K.repeat(COUNT, 1, 1), torch.zeros(COUNT, 0, dtype=torch.float64), cam2world, WIDTH, HEIGHT)


def render(cameras: Cameras, folder: Path) -> Frames:
    """Two planes: z = 4 behind, and slanted in front of it."""
    far, near = texture(0), texture(1)
    frames = []
    for i in range(len(cameras)):
        P = _OPENCV_PIXELS @ (cameras.K[i] @ cameras.world2cam[i, :3]).numpy()

        def homography(origin: list[float], u: list[float], v: list[float], P: np.ndarray = P) -> np.ndarray:
            return P @ np.stack([[*u, 0], [*v, 0], [*origin, 1]], 1)

        image = cv2.warpPerspective(
            far, homography([-5, -5, 4], [10 / 1024, 0, 0], [0, 10 / 1024, 0]), (WIDTH, HEIGHT), borderMode=1
        )
        H = homography([-0.9, -0.6, 2.4], [1.5 / 1024, 0, 0.9 / 1024], [0, 1.2 / 1024, 0.2 / 1024])
        front = cv2.warpPerspective(near, H, (WIDTH, HEIGHT))
        cover = cv2.warpPerspective(np.full_like(near, 255), H, (WIDTH, HEIGHT)) > 127
        path = folder / f"{i}.png"
        folder.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.where(cover, front, image))
        frames.append(Frame(f"dive one/{i}.png", path, float(i), 0.0, "train"))
    return Frames(tuple(frames), WIDTH, HEIGHT, ordered=True)


def worst_rotation_deg(rec: Reconstruction, truth: Cameras) -> float:
    fit = align_similarity(rec.cameras.centers, truth.centers)
    turned = fit.poses(rec.cameras.cam2world)[:, :3, :3]
    return torch.rad2deg(rotation_angle(turned.mT @ truth.cam2world[:, :3, :3])).max().item()


def off_true_lines(i: torch.Tensor, j: torch.Tensor, xy_i: torch.Tensor, xy_j: torch.Tensor) -> torch.Tensor:
    """Distance in pixels of pixels in frames i from the true epipolar lines of those of the same points in frames j."""
    truth = camera_path()
    R = truth.world2cam[i, :3, :3] @ truth.cam2world[j, :3, :3]
    t = (truth.world2cam[i, :3, :3] @ truth.cam2world[j, :3, 3:] + truth.world2cam[i, :3, 3:]).squeeze(-1)
    K_inverse = torch.linalg.inv(truth.K[0])
    rays_i, rays_j = (
        torch.cat([xy.double(), torch.ones(len(xy), 1, dtype=torch.float64)], 1) @ K_inverse.mT for xy in (xy_i, xy_j)
    )
    line = torch.linalg.cross(t, (R @ rays_j[..., None]).squeeze(-1))
    return (line * rays_i).sum(1).abs() / line[:, :2].norm(dim=1) * FOCAL
