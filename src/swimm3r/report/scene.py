"""The 3D scene of the page: a thinned cloud in its two colors, and the cameras, packed for the page's own WebGL.

Points are stored as uint16 x y z on a cube around the scene, then uint8 colors as filmed and without the water, all of
one kind after another, as the page's script unpacks them.
"""

import base64
import json
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree

from swimm3r.cameras import image_directions
from swimm3r.report.head import caption
from swimm3r.report.plan_view import least_extended
from swimm3r.scene.frames import Frames, rows_of_one_camera
from swimm3r.scene.reconstruction import Reconstruction

_MOST_POINTS = 160_000  # 12 bytes each, 2.6 MB of text
_MOST_CAMERAS = 200
_SPREAD = 3.0  # times the distance that nine tenths of the points keep to the middle; what lies beyond is left out
_FRUSTUM = 0.06  # length of a camera's drawing, of the same distance
_STEPS = 65535


@dataclass(frozen=True)
class Scene3d:
    """The drawing of the page: `header` is JSON, `data` the packed points in base64."""

    header: str
    data: str
    shown: int
    found: int
    restored: bool  # whether the points have a second color


@dataclass(frozen=True)
class Colored:
    """Points with the colors that are shown."""

    xyz: Float[np.ndarray, "n 3"]
    filmed: Float[np.ndarray, "n 3"]
    restored: Float[np.ndarray, "n 3"] | None


def shown_points(rec: Reconstruction) -> Colored | None:
    """The dense cloud as people see it, else the sparse points; None without either."""
    if rec.cloud is not None and len(rec.cloud.xyz):
        restored = rec.cloud.shown(rec.white_balance).numpy()
        return Colored(rec.cloud.xyz.numpy(), rec.cloud.raw.numpy(), restored)
    if len(rec.points.xyz):
        return Colored(rec.points.xyz.numpy(), rec.points.rgb.numpy(), None)
    return None


def pack_scene(rec: Reconstruction, frames: Frames) -> Scene3d | None:
    """The scene of a reconstruction; None where it has no points."""
    points = shown_points(rec)
    if points is None:
        return None
    middle = np.median(points.xyz, axis=0)
    reach = float(np.quantile(np.linalg.norm(points.xyz - middle, axis=1), 0.9)) or 1.0
    kept = _thinned(points.xyz, middle, reach * _SPREAD)
    xyz = points.xyz[kept]
    low, side = xyz.min(0), float(np.ptp(xyz, axis=0).max()) or 1.0
    restored = points.filmed if points.restored is None else points.restored
    cells = np.round((xyz - low) / side * _STEPS).clip(0, _STEPS).astype("<u2")
    packed = cells.tobytes() + b"".join(_bytes(colors[kept]) for colors in (points.filmed, restored))
    poses = rec.cameras.cam2world.numpy()
    header = {
        "points": len(kept),
        "low": low.tolist(),
        "side": side,
        "middle": middle.tolist(),
        "reach": reach,
        "spacing": _spacing(xyz),
        "up": (-_rounded(_down(points.xyz, poses))).tolist(),
        "path": _rounded(poses[rows_of_one_camera(rec.names, frames), :3, 3]).tolist(),
        "cameras": _cameras(rec, frames, reach * _FRUSTUM),
    }
    return Scene3d(
        json.dumps(header, separators=(",", ":")).replace("<", "\\u003c"),  # no name may end the page's script
        base64.b64encode(packed).decode("ascii"),
        len(kept),
        len(points.xyz),
        points.restored is not None,
    )


def _thinned(xyz: Float[np.ndarray, "n 3"], middle: np.ndarray, farthest: float) -> np.ndarray:
    """Indices of at most so many points within reach, drawn evenly; the same ones every time."""
    near = np.flatnonzero(np.linalg.norm(xyz - middle, axis=1) <= farthest)
    if len(near) <= _MOST_POINTS:
        return near
    return np.sort(np.random.default_rng(0).choice(near, _MOST_POINTS, replace=False))


def _spacing(xyz: Float[np.ndarray, "n 3"]) -> float:
    """The usual distance from a point to its nearest neighbor."""
    if len(xyz) < 2:
        return 0.0
    asked = xyz[:: max(1, len(xyz) // 2000)]
    return float(np.median(KDTree(xyz).query(asked, k=2)[0][:, 1]))


def _down(xyz: Float[np.ndarray, "n 3"], poses: Float[np.ndarray, "c 4 4"]) -> np.ndarray:
    """The direction that a viewer takes for down: against the ground where the points are flat, else that of the
    images."""
    normal = least_extended(xyz)
    viewing, image_down = poses[:, :3, 2].mean(0), poses[:, :3, 1].mean(0)
    if normal is None:
        return image_down / max(float(np.linalg.norm(image_down)), 1e-12)
    along = normal @ viewing
    toward = along if abs(along) > 0.3 * np.linalg.norm(viewing) else normal @ image_down
    return normal if toward >= 0 else -normal


def _cameras(rec: Reconstruction, frames: Frames, length: float) -> list[dict[str, object]]:
    """Center, the four corners of the image at `length`, and the caption of evenly spread cameras."""
    count = len(rec.names)
    chosen = sorted({round(i) for i in np.linspace(0, count - 1, min(count, _MOST_CAMERAS))})
    found = []
    for i in chosen:
        camera = rec.cameras[i]
        rays = image_directions(camera)[[0, 0, -1, -1], [0, -1, -1, 0]].double()
        corners = rays * length @ camera.cam2world[0, :3, :3].T + camera.cam2world[0, :3, 3]
        view = torch.cat([camera.cam2world[0, :3, 3][None], corners]).numpy()
        found.append({"name": caption(frames, rec.names[i]), "xyz": _rounded(view).tolist()})
    return found


def _rounded(values: np.ndarray) -> np.ndarray:
    """Six significant digits of the largest, which is more than a screen shows."""
    largest = float(np.abs(values).max()) or 1.0
    return values.round(max(0, 5 - int(np.floor(np.log10(largest)))))


def _bytes(colors: Float[np.ndarray, "n 3"]) -> bytes:
    return (colors.clip(0, 1) * 255).round().astype(np.uint8).tobytes()
