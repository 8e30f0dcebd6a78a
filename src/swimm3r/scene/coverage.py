"""The parts of a view that training frames measured."""

import torch
from jaxtyping import Bool
from torch import Tensor

from swimm3r.cameras import Cameras, project_visible
from swimm3r.scene.point_groups import PointGroups
from swimm3r.scene.reconstruction import Reconstruction

_GAP = 0.03  # of the image's width: gaps in the cloud up to this size are closed


class TrainingCoverage:
    """The measured points of a reconstruction, asked for many views.

    It asks the reconstruction, not the map: a map that leaves holes is not excused for them. The backdrop, whose depth
    is a guess, does not count.
    """

    def __init__(self, rec: Reconstruction) -> None:
        self._points = PointGroups(rec.points.xyz if rec.cloud is None else rec.cloud.xyz)

    def of(self, canvas: Cameras) -> Bool[Tensor, "h w"]:
        """The mask of the pixels of a pinhole view into which measured points fall, small gaps closed."""
        import cv2

        pixels, _, visible = project_visible(canvas, self._points.before(canvas)[None].double())
        column, row = pixels[visible].long().unbind(-1)
        hit = torch.zeros(canvas.height, canvas.width, dtype=torch.uint8)
        hit[row, column] = 1
        reach = max(3, round(_GAP * canvas.width)) | 1
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
        border = reach  # closing must not eat into the image's edge
        padded = cv2.copyMakeBorder(hit.numpy(), border, border, border, border, cv2.BORDER_REFLECT)
        closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)[border:-border, border:-border]
        return torch.from_numpy(closed.copy()) > 0
