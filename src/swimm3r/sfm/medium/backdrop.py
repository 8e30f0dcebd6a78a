"""Ground that images show and no two of them confirm: a guess at where it is, for a map to start on.

Smooth sand, ground that passes once through a corner, far slopes: plane sweep gives them no depth, so the dense cloud
has nothing there. Their depth is filled in from the surroundings (`imaging.depth_completion`), which is no measurement,
so these points are kept apart from the cloud. Each piece of ground is taken from the first frame that shows it, unless
most of that frame's neighbors contradict: they look through the point at a surface behind it, or show another color
there.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from swimm3r.cameras import Cameras, directions, project_visible
from swimm3r.imaging.filters import blur
from swimm3r.io.files.cache import ArrayCache
from swimm3r.scene.frames import Frames
from swimm3r.scene.point_groups import PointGroups
from swimm3r.scene.reconstruction import DenseCloud, Reconstruction
from swimm3r.sfm.medium.restore import RestoredImage

_CELLS = 48  # cells along the long side of an image in which ground is looked for
_POINTS = 6  # along each side of a cell: more of them than the primitives that maps start with
_LOOKED = 3  # places along each side of a cell, of which the cloud shows those that hold one of its points
_SURFACE = 0.5  # share of open water from which there is no ground
_MEASURED = 0.1  # share of an image below which depth known from any frame is too little to guess the rest from
_NEIGHBORS = 8  # frames before and after that may contradict
_IN_FRONT = 0.1  # share of a known depth by which a point in front of it hides it
_BEHIND = 1.5  # times the farthest depth that is filled in: what lies beyond shows nothing of this ground
_COLOR = 0.08  # difference of blurred colors between frames, in any channel, that one surface may show


class Backdrop:
    """Gathers the guessed ground of one image after the other."""

    def __init__(self, rec: Reconstruction, frames: Frames) -> None:
        assert rec.cloud is not None
        self.rec, self.frames = rec, frames
        self._known = PointGroups(rec.cloud.xyz)
        self._blurs = ArrayCache(max_bytes=0, least_entries=2 * _NEIGHBORS + 2)
        self._pieces: list[DenseCloud] = []

    def add(self, i: int, image: RestoredImage) -> None:
        """The ground in frame i of the reconstruction that neither the cloud nor an earlier frame shows."""
        camera, name = self.rec.cameras[i], self.rec.names[i]
        f = self.frames.index(name)
        unknown = self.rec.depth[name].z_depth == 0
        if not self._knows_enough(camera, ~unknown):
            return
        guessed = unknown & (image.sea < _SURFACE) & self.frames.mask(f)
        edge = max(camera.width, camera.height) / _CELLS
        row, column = _lattice(camera, max(1.0, edge / _POINTS))
        take = guessed[row, column]
        row, column = row[take], column[take]
        if not len(row):
            return
        reach = _BEHIND * float(image.ray_depth[row, column].max())
        take = ~self._shown(camera, row, column, reach)
        row, column = row[take], column[take]
        if not len(row):
            return
        pixel = torch.stack([column, row], -1).double() + 0.5
        ray = torch.nn.functional.normalize(directions(camera, pixel[None])[0], dim=-1)
        in_camera = ray * image.ray_depth[row, column, None].double()
        xyz = in_camera @ camera.cam2world[0, :3, :3].mT + camera.cam2world[0, :3, 3]
        usable = xyz.isfinite().all(-1) & (in_camera[:, 2] > 0)
        row, column, xyz = row[usable], column[usable], xyz[usable]
        believed = ~self._contradicted(i, xyz, self._blurred(i, row, column))
        row, column, xyz = row[believed], column[believed], xyz[believed]
        raw = self.frames.colors(f, row * camera.width + column)
        self._pieces.append(DenseCloud(xyz.float(), raw, image.clear[row, column]))

    def points(self) -> DenseCloud:
        """All of it."""
        none = torch.zeros(0, 3)
        pieces = [vars(piece) for piece in self._pieces] or [{"xyz": none, "raw": none, "restored": none}]
        return DenseCloud(*(torch.cat([piece[key] for piece in pieces]) for key in ("xyz", "raw", "restored")))

    def _knows_enough(self, camera: Cameras, known: Bool[Tensor, "h w"]) -> bool:
        """Return whether enough of an image has known depth: of its own (`known`), or with the cloud's points."""
        if float(known.float().mean()) >= _MEASURED:
            return True
        return float((known | (self._known.z_depth(camera) > 0)).float().mean()) >= _MEASURED

    def _contradicted(self, i: int, xyz: Float[Tensor, "n 3"], color: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """More of the neighboring frames that could see a point deny it than confirm it."""
        votes = torch.zeros(len(xyz))
        for j in range(max(0, i - _NEIGHBORS), min(len(self.rec.names), i + _NEIGHBORS + 1)):
            if j == i:
                continue
            camera = self.rec.cameras[j]
            pixels, z, visible = project_visible(camera, xyz[None])
            at = visible[0].nonzero()[:, 0]
            column, row = pixels[0, at].long().unbind(-1)
            known = self.rec.depth[self.rec.names[j]].z_depth[row, column].double()
            nearness = z[0, at] / torch.where(known > 0, known, z[0, at])
            differs = (self._blurred(j, row, column) - color[at]).abs().amax(-1) > _COLOR
            visible = (nearness < 1 + _IN_FRONT) & self.frames.mask(self.frames.index(self.rec.names[j]))[row, column]
            denied = differs | (nearness < 1 - _IN_FRONT)
            votes[at] += torch.where(visible, torch.where(denied, 1.0, -1.0), 0.0)
        return votes > 0

    def _shown(
        self, camera: Cameras, row: Int[Tensor, " n"], column: Int[Tensor, " n"], reach: float
    ) -> Bool[Tensor, " n"]:
        """Mask of the pixels at which the cloud or the ground found so far has a point closer than `reach`.

        A point of the dense cloud, which may be thinned, stands for a part of a cell; one of ground of earlier frames,
        which may have been filmed from afar, for a whole one.
        """
        center = camera.centers[0].float()
        found = torch.cat([torch.zeros(0, 3), *(piece.xyz for piece in self._pieces)])
        found = found[(found - center).square().sum(-1) < reach**2]
        edge = max(camera.width, camera.height) / _CELLS
        shown = torch.zeros(len(row), dtype=torch.bool)
        for xyz, size in ((self._known.within(center, reach), edge / _LOOKED), (found, edge)):
            shown |= _cells(camera, xyz.double(), size)[(row / size).long(), (column / size).long()]
        return shown

    def _blurred(self, i: int, row: Int[Tensor, " n"], column: Int[Tensor, " n"]) -> Float[Tensor, "n 3"]:
        """Pixels of a frame's image without what is smaller than a part of a cell."""
        sigma = max(self.frames.width, self.frames.height) / _CELLS / _LOOKED / 2
        step = max(1, int(sigma / 3))

        def load() -> tuple[np.ndarray]:
            image = self.frames.image(self.frames.index(self.rec.names[i]))
            return (blur(image, sigma)[step // 2 :: step, step // 2 :: step].numpy().copy(),)

        (values,) = self._blurs.get(i, load)
        rows, columns = values.shape[:2]
        at = (row // step).clamp(max=rows - 1).numpy(), (column // step).clamp(max=columns - 1).numpy()
        return torch.from_numpy(values[at])


def _lattice(camera: Cameras, step: float) -> tuple[Tensor, Tensor]:
    """Rows and columns of pixels about `step` apart, row by row."""
    rows = torch.arange(step / 2, camera.height, step).long()
    columns = torch.arange(step / 2, camera.width, step).long()
    row, column = torch.meshgrid(rows, columns, indexing="ij")
    return row.flatten(), column.flatten()


def _cells(camera: Cameras, xyz: Tensor, edge: float) -> Bool[Tensor, "rows columns"]:
    """Mask of the square cells of an image that hold a point."""
    pixels, _, visible = project_visible(camera, xyz[None])
    column, row = (pixels[visible] / edge).long().unbind(-1)
    cells = torch.zeros(int(camera.height / edge) + 1, int(camera.width / edge) + 1, dtype=torch.bool)
    cells[row, column] = True
    return cells
