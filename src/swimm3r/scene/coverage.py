"""The parts of a view that training frames measured."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import Cameras, directions, project_visible
from swimm3r.scene.reconstruction import Reconstruction

_GAP = 0.03  # of the image's width: gaps in the cloud up to this size are closed
_GROUP = 2048  # points that are asked together whether they may lie in a view


class TrainingCoverage:
    """The measured points of a reconstruction, in groups of near ones: a view asks those before it alone.

    It asks the reconstruction, not the map: a map that leaves holes is not excused for them. The backdrop, whose depth
    is a guess, does not count.
    """

    def __init__(self, rec: Reconstruction) -> None:
        xyz = (rec.points.xyz if rec.cloud is None else rec.cloud.xyz).double()
        self._groups = _groups(xyz) if len(xyz) else []
        low = torch.stack([group.amin(0) for group in self._groups]) if self._groups else torch.zeros(0, 3).double()
        high = torch.stack([group.amax(0) for group in self._groups]) if self._groups else torch.zeros(0, 3).double()
        self._middle, self._reach = (low + high) / 2, (high - low).norm(dim=-1) / 2

    def of(self, canvas: Cameras) -> Bool[Tensor, "h w"]:
        """The mask of the pixels of a pinhole view into which measured points fall, small gaps closed."""
        import cv2

        hit = torch.zeros(canvas.height, canvas.width, dtype=torch.uint8)
        for xyz in self._before(canvas):
            pixels, _, visible = project_visible(canvas, xyz[None])
            column, row = pixels[visible].long().unbind(-1)
            hit[row, column] = 1
        reach = max(3, round(_GAP * canvas.width)) | 1
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
        border = reach  # closing must not eat into the image's edge
        padded = cv2.copyMakeBorder(hit.numpy(), border, border, border, border, cv2.BORDER_REFLECT)
        closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)[border:-border, border:-border]
        return torch.from_numpy(closed.copy()) > 0

    def _before(self, canvas: Cameras) -> list[Float[Tensor, "n 3"]]:
        """The groups whose spheres meet the cone that holds the view."""
        w, h = canvas.width, canvas.height
        corners = torch.tensor([[0, 0], [w, 0], [0, h], [w, h]], dtype=torch.float64)
        rays = torch.nn.functional.normalize(directions(canvas, corners[None])[0], dim=-1)
        half = float(torch.arccos(rays[:, 2].clamp(max=1.0)).max())
        axis, center = canvas.cam2world[0, :3, 2].double(), canvas.centers[0].double()
        toward = self._middle - center
        away = toward.norm(dim=-1).clamp(min=1e-12)
        angle = torch.arccos(((toward @ axis) / away).clamp(-1.0, 1.0))
        spread = torch.arcsin((self._reach / away).clamp(max=1.0))
        near = (angle - spread <= half) | (away <= self._reach)
        return [self._groups[k] for k in np.flatnonzero(near.numpy())]


def _groups(xyz: Float[Tensor, "n 3"]) -> list[Float[Tensor, "m 3"]]:
    """The points in groups of at most `_GROUP`, halved across the longest side until they are."""
    if len(xyz) <= _GROUP:
        return [xyz]
    along = xyz[:, int((xyz.amax(0) - xyz.amin(0)).argmax())].numpy()
    order = torch.from_numpy(np.argpartition(along, len(xyz) // 2))
    return _groups(xyz[order[: len(xyz) // 2]]) + _groups(xyz[order[len(xyz) // 2 :]])
