"""Points marked in frames -> points of the scene with covariance, and the scale that known distances between them give.

A point is the one with the least squared reprojection error, by Gauss-Newton from the linear solution; its covariance
is (J^T J)^-1 sigma^2. Of n points whose true shape is known, L^2 = sum |x_i - mean|^2 against the true one gives

    s = L_true / L,   var(log s) = sum_i (x_i - mean)^T C_i (x_i - mean) / L^4

with the bias of noise, sum tr(C_i) (1 - 1/n), taken off L^2.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from swimm3r.cameras import Cameras, directions, project

_ROUNDS = 15
_LEAST_ANGLE = np.radians(0.3)  # between rays, below which a point has no depth


@dataclass(frozen=True)
class Sighting:
    """A point in a frame, pixels."""

    frame: int  # index of the registered frame
    xy: tuple[float, float]


@dataclass(frozen=True)
class ScenePoint:
    """A point in the coordinates of the run."""

    xyz: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    rms_px: float  # of its reprojections
    worst: int  # frame with the largest one
    frames: int


class PoorGeometryError(ValueError):
    """The sightings of a point do not determine it."""


def triangulate(cameras: Cameras, sightings: Sequence[Sighting], sigma_px: float) -> ScenePoint:
    """The point that frames see at these pixels. Raises PoorGeometryError where they do not determine it."""
    if len({sighting.frame for sighting in sightings}) < 2:
        raise PoorGeometryError("it is marked in one frame only, and one frame holds no depth")
    index = [sighting.frame for sighting in sightings]
    chosen = cameras[index]
    pixels = torch.tensor([sighting.xy for sighting in sightings], dtype=torch.float64)
    rays = directions(chosen, pixels[:, None])[:, 0]
    if not bool(torch.isfinite(rays).all()):
        raise PoorGeometryError("one of its pixels lies outside of what the lens shows")
    pose = chosen.cam2world.double()
    world = torch.nn.functional.normalize((pose[:, :3, :3] @ rays[..., None])[..., 0], dim=-1)
    xyz = _nearest_to_rays(pose[:, :3, 3].numpy(), world.numpy())
    to_point = xyz - pose[:, :3, 3].numpy()
    cosines = (
        (to_point / np.linalg.norm(to_point, axis=1, keepdims=True)) @ to_point.T / np.linalg.norm(to_point, axis=1)
    )
    if np.arccos(np.clip(cosines, -1, 1)).max() < _LEAST_ANGLE:
        raise PoorGeometryError("its frames see it from nearly the same place, which holds no depth")
    if (np.einsum("ij,ij->i", to_point, world.numpy()) <= 0).any():
        raise PoorGeometryError("its rays meet behind a camera: the pixels are of different points")
    residual, J = _reprojection(chosen, xyz, pixels.numpy())
    for _ in range(_ROUNDS):
        step = np.linalg.lstsq(J, -residual, rcond=None)[0]
        xyz = xyz + step
        residual, J = _reprojection(chosen, xyz, pixels.numpy())
        if np.linalg.norm(step) < 1e-12 * (1 + np.linalg.norm(xyz)):
            break
    freedom = max(1, 2 * len(sightings) - 3)
    each = np.linalg.norm(residual.reshape(-1, 2), axis=1)
    spread = max(1.0, float((residual**2).sum()) / freedom / sigma_px**2)
    covariance = np.linalg.pinv(J.T @ J) * sigma_px**2 * spread
    return ScenePoint(xyz, covariance, float(np.sqrt((each**2).mean())), index[int(each.argmax())], len(set(index)))


def scale_of_shape(
    points: Sequence[ScenePoint], shape: Float[np.ndarray, "n d"], shape_std: float
) -> tuple[float, float]:
    """Metres per unit by points whose true positions are known up to a motion, and its relative standard deviation.

    `shape_std` is the relative standard deviation of the true shape.
    """
    xyz = np.stack([point.xyz for point in points])
    from_mean = xyz - xyz.mean(0)
    squared = float((from_mean**2).sum())
    noise = sum(float(np.trace(point.covariance)) for point in points) * (1 - 1 / len(points))
    true = float(((shape - shape.mean(0)) ** 2).sum())
    along = sum(float(d @ point.covariance @ d) for d, point in zip(from_mean, points, strict=True))
    variance = along / squared**2
    return float(np.sqrt(true / max(squared - noise, 0.25 * squared))), float(np.hypot(np.sqrt(variance), shape_std))


def scale_of_distance(one: ScenePoint, other: ScenePoint, length: float, length_std: float) -> tuple[float, float]:
    """Metres per unit by the known distance of two points, and its relative standard deviation."""
    return scale_of_shape((one, other), np.array([[0.0], [length]]), length_std / length)


def triangulate_all(
    cameras: Cameras, sightings: Mapping[str, Sequence[Sighting]], sigma_px: float
) -> tuple[dict[str, ScenePoint], dict[str, str]]:
    """Every point that its frames determine, by name; and of the others why not."""
    points, failed = {}, {}
    for name, seen in sightings.items():
        try:
            points[name] = triangulate(cameras, seen, sigma_px)
        except PoorGeometryError as error:
            failed[name] = str(error)
    return points, failed


def _nearest_to_rays(centers: Float[np.ndarray, "m 3"], rays: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "3"]:
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    return np.linalg.lstsq(across.sum(0), (across @ centers[..., None]).sum(0)[:, 0], rcond=None)[0]


def _reprojection(
    cameras: Cameras, xyz: Float[np.ndarray, "3"], pixels: Float[np.ndarray, "m 2"]
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of all sightings, pixels, and their derivatives by the point."""
    point = torch.from_numpy(xyz)
    reach = 1e-6 * max(1e-3, float(np.linalg.norm(xyz - cameras.centers.double().numpy().mean(0))))
    offsets = torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)]).double() * reach
    seen, _ = project(cameras, (point + offsets)[None].expand(len(cameras), -1, -1))
    values = seen.numpy()
    J = (values[:, 1:4] - values[:, 4:7]).transpose(0, 2, 1) / (2 * reach)
    return (values[:, 0] - pixels).ravel(), J.reshape(-1, 3)
