"""Parts of a view that training frames saw: the map's depth in small images of them, and a test of visibility.

A point was observed where it falls into a training frame, on a pixel that its mask admits, and lies no farther than
what the map shows there: depth is that of the finished map, so that a training frame observes all that it shows,
whether its depth was measured or guessed. Open water is observed along the rays along which a frame looks into it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d

from swimm3r.cameras import Cameras, check_cameras, pixel_grid, project, unproject

SIDE = 64  # pixels of the longer side of the small images
MOST = 600  # of them: of longer dives every k-th frame, which sees what its neighbors see
COVERED = 0.5  # alpha from which on a pixel shows a surface
_BEHIND = 1.05  # of the depth, up to where a point counts as the surface: depth has errors, and pixels extent
_HOLE = 5  # pixels of the small images, the least extent of open water
_DEEP, _BESIDE = 1.3, 0.15  # of depth and of the image, how far primitives may lie off what a frame shows
_FAR = 8.0  # largest depths, where open water is asked for
_AT_ONCE = 32  # frames
_STRIDE = 4  # pixels between the rays that are asked
_SMALL = 0.0015  # of the image, below which a hole is none in what frames saw: 2.5 pixels of the small images across


@dataclass(frozen=True)
class TrainingCoverage:
    """Training frames as small depth images."""

    cameras: Cameras  # as drawn, scene units
    z_depth: Float[Tensor, "n h w"]  # scene units; infinite in open water, 0 where the mask excludes

    def sees(self, points: Float[Tensor, "p 3"], viewed_from: Float[Tensor, "3"] | None = None) -> Bool[Tensor, " p"]:
        """Mask of the points that some frame saw; frames near `viewed_from` are asked first, which only saves time."""
        return self._seen(points, viewed_from, _BEHIND, 0.0)

    def needs(self, points: Float[Tensor, "p 3"]) -> Bool[Tensor, " p"]:
        """Mask of the centers of primitives that can be part of what frames saw, some way behind it and beside it."""
        return self._seen(points, None, _DEEP, _BESIDE)

    def _seen(
        self, points: Float[Tensor, "p 3"], viewed_from: Float[Tensor, "3"] | None, behind: float, beside: float
    ) -> Bool[Tensor, " p"]:
        seen = torch.zeros(len(points), dtype=torch.bool)
        order = torch.arange(len(self.cameras))
        if viewed_from is not None:
            order = (self.cameras.centers.double() - viewed_from.double()).norm(dim=-1).argsort()
        for some in order.split(_AT_ONCE):
            left = torch.nonzero(~seen)[:, 0]
            if not len(left):
                break
            seen[left] = self._seen_by(some, points[left].double(), behind, beside)
        return seen

    def _seen_by(
        self, some: Int[Tensor, " k"], points: Float[Tensor, "p 3"], behind: float, beside: float
    ) -> Bool[Tensor, " p"]:
        cameras = self.cameras[some]
        pixels, z = project(cameras, points.expand(len(some), -1, 3))
        size = torch.tensor([cameras.width, cameras.height]).to(pixels)
        inside = (z > 0) & ((pixels >= -beside * size) & (pixels < (1 + beside) * size)).all(-1)
        nearest = torch.where(inside[..., None], pixels, 0.0).clamp(min=0).minimum(size - 1)
        column, row = nearest.long().unbind(-1)
        surface = self.z_depth[some[:, None], row, column].double()
        return (inside & (z <= behind * surface)).any(0)

    def of_view(
        self, camera: Cameras, z_depth: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"]
    ) -> Bool[Tensor, "h w"]:
        """Mask of the pixels of a view whose surface, or open water, some frame saw."""
        height, width = z_depth.shape
        few = slice(_STRIDE // 2, None, _STRIDE) if min(height, width) > 4 * _STRIDE else slice(None)
        near = z_depth.cpu()[few, few]
        surface = (alpha.cpu()[few, few] > COVERED) & (near > 0)
        known = self.z_depth[self.z_depth.isfinite()]
        far = _FAR * float(torch.cat([known, near.reshape(-1)]).max().clamp(min=1e-6))
        z = torch.where(surface, near, far).reshape(1, -1).double()
        grid = pixel_grid(height, width)[few, few].reshape(1, -1, 2).double()
        here = replace(camera, cam2world=camera.cam2world.double().cpu(), K=camera.K.double().cpu())
        seen = self.sees(unproject(here, grid, z)[0], here.centers[0]).reshape(near.shape)
        most = avg_pool2d(seen[None, None].float(), 3, stride=1, padding=1, count_include_pad=False)[0, 0] > 0.5
        whole = _without_small_holes(most)
        return interpolate(whole[None, None].float(), (height, width), mode="nearest")[0, 0] > 0.5

    def tensors(self) -> dict[str, Tensor]:
        """The record as a map's file keeps it: -1 in open water, as files hold finite numbers only."""
        depth = torch.where(self.z_depth.isinf(), -1.0, self.z_depth).half()
        kept = {"seen.K": self.cameras.K, "seen.cam2world": self.cameras.cam2world, "seen.z_depth": depth}
        lens = {} if self.cameras.model == "PINHOLE" else {"seen.fisheye": self.cameras.distortion}
        return kept | lens


def coverage_from(tensors: Mapping[str, Tensor]) -> TrainingCoverage | None:
    """The inverse of `TrainingCoverage.tensors`; None of a file without. Raises ValueError where it is damaged."""
    if "seen.z_depth" not in tensors:
        return None
    z_depth, K, cam2world = tensors["seen.z_depth"].float(), tensors["seen.K"], tensors["seen.cam2world"]
    n = len(z_depth)
    if z_depth.dim() != 3 or K.shape != (n, 3, 3) or cam2world.shape != (n, 4, 4) or not bool((z_depth >= -1).all()):
        raise ValueError(f"its small depth images have the shapes {tuple(z_depth.shape)} and {tuple(cam2world.shape)}")
    fisheye = tensors.get("seen.fisheye")
    if fisheye is not None and fisheye.shape != (n, 4):
        raise ValueError(f"its fisheye lenses have the shape {tuple(fisheye.shape)}")
    model, distortion = ("PINHOLE", K.new_zeros(n, 0)) if fisheye is None else ("OPENCV_FISHEYE", fisheye)
    cameras = Cameras(K, distortion, cam2world, z_depth.shape[2], z_depth.shape[1], model)
    check_cameras(cameras)
    return TrainingCoverage(cameras, torch.where(z_depth < 0, torch.inf, z_depth))


def coverage_of(
    cameras: Cameras,
    z_depth: Sequence[Float[Tensor, "h w"]],
    alpha: Sequence[Float[Tensor, "h w"]],
    admitted: Sequence[Bool[Tensor, "h w"]],
) -> TrainingCoverage:
    """The record of small views as the map renders them: the farthest depth of a pixel and those around it.

    Open water is all of a window of `_HOLE` pixels that shows no surface (a morphological opening), up to its edge: a
    smaller hole in the map is no open water.
    """
    z, cover = torch.stack(list(z_depth))[:, None], torch.stack(list(alpha))[:, None]
    surface = (cover > COVERED) & (z > 0)
    core = _spread(surface.float(), _HOLE) == 0
    open_water = _spread(core.float(), _HOLE) > 0
    farthest = _spread(torch.where(surface, z, 0.0), 3)
    z = torch.where(open_water, torch.inf, farthest)[:, 0]
    return TrainingCoverage(cameras, torch.where(torch.stack(list(admitted)), z, 0.0).half().float())


def _without_small_holes(seen: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """The mask with small holes filled: a mean over depths, as before open water, is beside what frames saw."""
    import cv2

    height, width = seen.shape
    _, groups, boxes, _ = cv2.connectedComponentsWithStats((~seen).byte().numpy(), connectivity=4)
    left, top, across, down, size = boxes.T
    cut = (left == 0) | (top == 0) | (left + across == width) | (top + down == height)  # they may go on
    return seen | torch.from_numpy((~cut & (size < _SMALL * seen.numel()))[groups])


def _spread(image: Float[Tensor, "n 1 h w"], size: int) -> Float[Tensor, "n 1 h w"]:
    """The largest value within a window of each pixel."""
    return max_pool2d(image, size, stride=1, padding=size // 2)
