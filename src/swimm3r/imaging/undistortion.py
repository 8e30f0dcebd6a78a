"""Images and pixels of a lens with distortion as a pinhole camera at the same place has them, and back.

    u_lens = K_lens distort(K_pinhole^-1 u_pinhole)

Depth along the optical axis is the same number in both images. Each function takes the camera of a frame and the
pinhole camera (`Cameras.pinhole` of the same field's middle, `covering_pinholes` of all of it) that stands for it, or
where maps are drawn the camera of `Cameras.drawn`, which is a smaller fisheye for a fisheye.
"""

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from swimm3r.cameras import (
    Cameras,
    directions,
    distort,
    image_directions,
    inside_image,
    pixel_grid,
    resized,
    rows_of_frames,
)

_ASIDE = 1e-3  # cosine of the angle from the axis beyond which a ray has no place in the image
WIDEST = 2.5  # tangent of the half angle that pinhole images made here show at most: 136 degrees


def undistorted(
    image: Float[Tensor, "h w *c"],
    mask: Bool[Tensor, "h w"],
    camera: Cameras,
    pinhole: Cameras,
    turn: Float[Tensor, "3 3"] | None = None,
) -> tuple[Float[Tensor, "ph pw *c"], Bool[Tensor, "ph pw"]]:
    """A frame's image as its pinhole camera sees it, and which of its pixels the frame shows and its mask admits.

    `turn` are the pinhole camera's axes in those of the frame, where they differ.
    """
    import cv2

    focal, wanted = (K[0, [0, 1], [0, 1]].double() for K in (camera.K, pinhole.K))
    width, height = (camera.width, camera.height) * np.minimum(1.0, (wanted / focal).numpy())
    size = (max(2, round(width)), max(2, round(height)))
    values, usable = image.numpy(), mask.numpy().astype(np.float32)
    if size != (camera.width, camera.height):  # smaller first, by area, so that nothing aliases
        values = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
        usable = cv2.resize(usable, size, interpolation=cv2.INTER_AREA)
        camera = resized(camera, *size)
    if turn is not None or not _same_image(camera, pinhole):
        column, row, inside = _grid(_key(camera), _key(pinhole), _turn_key(turn))
        values = cv2.remap(values, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        usable = cv2.remap(usable, column, row, cv2.INTER_LINEAR) * inside
    return torch.from_numpy(values), torch.from_numpy(usable > 0.999)


def shown_pixels(camera: Cameras, pinhole: Cameras) -> Bool[Tensor, "ph pw"]:
    """The pixels of the pinhole camera that the lens's image shows."""
    return torch.from_numpy(_grid(_key(camera), _key(pinhole))[2])


def nearest_pixels(camera: Cameras, pinhole: Cameras) -> tuple[Int[Tensor, "ph pw"], Int[Tensor, "ph pw"]]:
    """Row and column of the frame's pixel nearest to each pixel of the pinhole camera, at its border where outside."""
    column, row, _ = (torch.from_numpy(a) for a in _grid(_key(camera), _key(pinhole)))
    return row.round().long().clamp(0, camera.height - 1), column.round().long().clamp(0, camera.width - 1)


def pinhole_grid(
    camera: Cameras, pinhole: Cameras, turn: Float[Tensor, "3 3"] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Column and row (index coordinates) of every pixel of the frame in the pinhole image, -9 where it has none."""
    return _pinhole_grid(_key(camera), _key(pinhole), _turn_key(turn))


def frame_rays(camera: Cameras) -> Float[Tensor, "h w 3"]:
    """`image_directions` of a frame's camera in float32; those of a few lenses are kept."""
    return _rays(_key(camera))


def frame_directions(camera: Cameras) -> Float[Tensor, "h w 3"]:
    """Unit directions of a frame's pixels in its camera's axes; 0 where the lens model has none."""
    return torch.nn.functional.normalize(torch.nan_to_num(frame_rays(camera), nan=0.0), dim=-1)


def undistorted_pixels(
    camera: Cameras, xy: Float[Tensor, "m 2"], K: Float[Tensor, "3 3"] | None = None
) -> Float[Tensor, "m 2"]:
    """Pixels of one camera as a pinhole camera with `K`, by default its own, has them; NaN where no ray meets them."""
    rays = directions(camera, xy.double()[None])[0]
    return (rays @ (camera.K[0] if K is None else K).double().mT)[:, :2]


def undistorted_matches(
    cameras: Cameras, frame: Int[Tensor, " m"], xy: Float[Tensor, "m 2"], K: Float[Tensor, "c 3 3"] | None = None
) -> Float[Tensor, "m 2"]:
    """`undistorted_pixels` of pixels that lie in the images of various cameras."""
    straight = torch.empty_like(xy, dtype=torch.float64)
    for i, rows in enumerate(rows_of_frames(frame, len(cameras))):
        straight[rows] = undistorted_pixels(cameras[i], xy[rows], None if K is None else K[i])
    return straight


def distorted_pixels(camera: Cameras, xy: Float[Tensor, "*m 2"]) -> Float[Tensor, "*m 2"]:
    """The inverse of `undistorted_pixels` with the camera's own K."""
    K = camera.K[0].double()
    return through_lens(camera, (xy.double() - K[:2, 2]) / K[:2, :2].diagonal())


def covering_pinholes(cameras: Cameras, long_side: int) -> Cameras:
    """Pinhole cameras of one common, even size that cover what the frames show, `long_side` setting the scale."""
    scale = min(1.0, long_side / max(cameras.width, cameras.height))
    work = resized(cameras, max(2, round(cameras.width * scale)), max(2, round(cameras.height * scale)))
    lenses, which = _lenses(work)
    border = _outline(work.width, work.height)[None]
    extents = []
    for k in range(len(lenses)):
        rays = directions(lenses[k], border)[0, :, :2]
        rays = rays[rays.isfinite().all(-1)].clamp(-WIDEST, WIDEST)
        extents.append(torch.cat([rays.amin(0), rays.amax(0)]))
    extent = torch.stack(extents)
    focal = torch.stack([lenses.K[:, 0, 0], lenses.K[:, 1, 1]], -1).to(extent)
    size = ((extent[:, 2:] - extent[:, :2]) * focal).amax(0).tolist()
    width, height = (2 * int(np.ceil(s / 2 - 1e-3)) for s in size)
    K = torch.zeros(len(lenses), 3, 3, dtype=torch.float64)
    K[:, 0, 0], K[:, 1, 1], K[:, 2, 2] = focal[:, 0], focal[:, 1], 1
    K[:, :2, 2] = -extent[:, :2] * focal
    return Cameras(K[which], cameras.distortion[:, :0], cameras.cam2world, width, height)


def distorted_grid(
    camera: Cameras, pinhole: Cameras, turn: Float[Tensor, "3 3"] | None = None
) -> tuple[Float[Tensor, "h w 2"], Bool[Tensor, "h w"]]:
    """The pixel of the lens's image for every pixel of the pinhole camera, and whether the image shows it."""
    rays, ahead = image_directions(pinhole).double(), torch.tensor(True)
    if turn is not None:
        rays = rays @ turn.mT
        ahead = rays[..., 2] > _ASIDE * torch.linalg.vector_norm(rays, dim=-1)
    rays = rays[..., :2] / torch.where(ahead, rays[..., 2], 1.0)[..., None]
    pixels = through_lens(camera, rays)
    edge = directions(camera, _outline(camera.width, camera.height)[None])[0, :, :2]
    reach = torch.linalg.vector_norm(edge[edge.isfinite().all(-1)], dim=-1).max()
    shown = inside_image(pixels, camera.width, camera.height)
    # beyond the farthest ray of the outline the lens model may fold back into the image
    return pixels, shown & ahead & (torch.linalg.vector_norm(rays, dim=-1) <= reach * 1.001)


def through_lens(camera: Cameras, rays: Float[Tensor, "*m 2"]) -> Float[Tensor, "*m 2"]:
    """Pixels of points on the plane z = 1."""
    xy = distort(rays, camera.distortion[0].to(rays), camera.model)
    return xy @ camera.K[0, :2, :2].to(rays).mT + camera.K[0, :2, 2].to(rays)


def _same_image(camera: Cameras, pinhole: Cameras) -> bool:
    """Return whether the image is the frame's own: a fisheye without parameters is no pinhole camera."""
    if camera.model == pinhole.model == "OPENCV_FISHEYE":
        straight = torch.allclose(camera.distortion.double(), pinhole.distortion.double(), rtol=0, atol=1e-9)
    else:
        straight = camera.model != "OPENCV_FISHEYE" and not bool(camera.distortion.any())
    same_size = (camera.width, camera.height) == (pinhole.width, pinhole.height)
    return straight and same_size and torch.allclose(camera.K.double(), pinhole.K.double(), rtol=0, atol=1e-6)


_Key = tuple[tuple[float, ...], tuple[float, ...], int, int, str]


def _key(camera: Cameras) -> _Key:
    K, distortion = camera.K[0].flatten().tolist(), camera.distortion[0].tolist()
    return tuple(K), tuple(distortion), camera.width, camera.height, camera.model


_Turn = tuple[float, ...] | None


def _turn_key(turn: Float[Tensor, "3 3"] | None) -> _Turn:
    return None if turn is None else tuple(turn.flatten().tolist())


def _turn(key: _Turn) -> Float[Tensor, "3 3"] | None:
    return None if key is None else torch.tensor(key, dtype=torch.float64).reshape(3, 3)


def _camera(key: _Key) -> Cameras:
    K, distortion, width, height, model = key
    return Cameras(
        torch.tensor(K, dtype=torch.float64).reshape(1, 3, 3),
        torch.tensor(distortion, dtype=torch.float64).reshape(1, -1),
        torch.eye(4, dtype=torch.float64)[None],
        width,
        height,
        model,
    )


@lru_cache(maxsize=8)  # one lens per clip as a rule, at a few sizes
def _grid(camera: _Key, pinhole: _Key, turn: _Turn = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`distorted_grid` as columns and rows (index coordinates) and the pixels shown, for OpenCV."""
    pixels, shown = distorted_grid(_camera(camera), _camera(pinhole), _turn(turn))
    column, row = (pixels - 0.5).float().unbind(-1)
    return column.contiguous().numpy(), row.contiguous().numpy(), shown.numpy()


@lru_cache(maxsize=4)
def _pinhole_grid(camera: _Key, pinhole: _Key, turn: _Turn) -> tuple[np.ndarray, np.ndarray]:
    lens, K, axes = _camera(camera), _camera(pinhole).K[0], _turn(turn)
    rays = directions(lens, pixel_grid(lens.height, lens.width).double().reshape(1, -1, 2))[0]
    rays = rays if axes is None else rays @ axes
    ahead = rays[:, 2:] > _ASIDE * torch.linalg.vector_norm(rays, dim=-1, keepdim=True)
    at = (rays @ K.mT)[:, :2] / torch.where(ahead, rays[:, 2:], 1.0) - 0.5
    column, row = torch.where(ahead & at.isfinite().all(-1, keepdim=True), at, -9.0).numpy().T
    return np.ascontiguousarray(column), np.ascontiguousarray(row)


@lru_cache(maxsize=4)
def _rays(camera: _Key) -> Float[Tensor, "h w 3"]:
    return image_directions(_camera(camera)).float()


def _lenses(cameras: Cameras) -> tuple[Cameras, Int[Tensor, " c"]]:
    """The distinct intrinsics among cameras, and which each camera has."""
    rows = torch.cat([cameras.K.flatten(1), cameras.distortion], -1)
    unique, which = torch.unique(rows, dim=0, return_inverse=True)
    first = [int((which == k).nonzero()[0]) for k in range(len(unique))]
    return cameras[first], which


def _outline(width: int, height: int) -> Float[Tensor, "n 2"]:
    """Points along the borders of an image, whose middles a bulging lens moves farthest."""
    x = torch.linspace(0, width, 65, dtype=torch.float64)
    y = torch.linspace(0, height, 65, dtype=torch.float64)
    return torch.cat(
        [torch.stack([x, torch.full_like(x, v)], -1) for v in (0, height)]
        + [torch.stack([torch.full_like(y, u), y], -1) for u in (0, width)]
    )
