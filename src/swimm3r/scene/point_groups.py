"""Points in groups of near ones, so that those in some part of space are found without asking all."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import Cameras, directions, project_visible

_GROUP = 2048  # points, at most
_SQUARE = 2  # pixels along the side of a square that shows the nearest of its points alone


class PointGroups:
    """Points (n, 3) in groups, each in a sphere that is asked in their place."""

    def __init__(self, xyz: Float[Tensor, "n 3"]) -> None:
        self._none = xyz[:0]
        self._groups = _halved(xyz) if len(xyz) else []
        low = torch.cat([self._none, *(group.amin(0, keepdim=True) for group in self._groups)]).double()
        high = torch.cat([self._none, *(group.amax(0, keepdim=True) for group in self._groups)]).double()
        self._middle, self._radius = (low + high) / 2, (high - low).norm(dim=-1) / 2

    def within(self, center: Float[Tensor, "3"], reach: float) -> Float[Tensor, "m 3"]:
        """The points closer than `reach` to a center, in no certain order."""
        xyz = self._of((self._middle - center.double()).norm(dim=-1) - self._radius < reach)
        return xyz[(xyz - center.to(xyz)).square().sum(-1) < reach**2]

    def before(self, camera: Cameras) -> Float[Tensor, "m 3"]:
        """All points in a pinhole camera's image, and others near its edge or far from it in depth alone."""
        w, h = camera.width, camera.height
        corners = torch.tensor([[0, 0], [w, 0], [0, h], [w, h]], dtype=torch.float64)
        rays = torch.nn.functional.normalize(directions(camera, corners[None])[0], dim=-1)
        half = float(torch.arccos(rays[:, 2].clamp(max=1.0)).max())
        toward = self._middle - camera.centers[0].double()
        away = toward.norm(dim=-1).clamp(min=1e-12)
        angle = torch.arccos(((toward @ camera.cam2world[0, :3, 2].double()) / away).clamp(-1.0, 1.0))
        spread = torch.arcsin((self._radius / away).clamp(max=1.0))
        return self._of((angle - spread <= half) | (away <= self._radius))

    def z_depth(self, camera: Cameras) -> Float[Tensor, "h w"]:
        """Depth of the nearest point in each square of 2 x 2 pixels of a pinhole camera's image; 0 where none is."""
        pixels, z, visible = project_visible(camera, self.before(camera)[None].double())
        column, row = (pixels[visible] / _SQUARE).long().unbind(-1)
        rows, columns = -(-camera.height // _SQUARE), -(-camera.width // _SQUARE)
        nearest = torch.full((rows * columns,), torch.inf)
        nearest.scatter_reduce_(0, row * columns + column, z[visible].float(), "amin")
        squares = torch.where(nearest.isfinite(), nearest, 0.0).reshape(rows, columns)
        pixelwise = squares.repeat_interleave(_SQUARE, 0).repeat_interleave(_SQUARE, 1)
        return pixelwise[: camera.height, : camera.width]

    def _of(self, chosen: Bool[Tensor, " groups"]) -> Float[Tensor, "m 3"]:
        """The points of the chosen groups."""
        kept = [group for group, take in zip(self._groups, chosen.tolist(), strict=True) if take]
        return torch.cat([self._none, *kept])


def _halved(xyz: Float[Tensor, "n 3"]) -> list[Float[Tensor, "m 3"]]:
    """The points in groups of at most `_GROUP`, halved across the longest side until they are."""
    if len(xyz) <= _GROUP:
        return [xyz]
    along = xyz[:, int((xyz.amax(0) - xyz.amin(0)).argmax())].numpy()
    order = torch.from_numpy(np.argpartition(along, len(xyz) // 2))
    return _halved(xyz[order[: len(xyz) // 2]]) + _halved(xyz[order[len(xyz) // 2 :]])
