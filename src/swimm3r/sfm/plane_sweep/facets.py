"""The pinhole views that a frame is swept as: one, or of a fisheye several side by side, turned about its own center.

One pinhole image of a fisheye's field would be many times its size, and its border a smear without texture. Facet k
looks along the frame's axis turned by an angle about its shorter side; together they cover all that the frame shows,
each with a margin. Depth of a facet is along its own axis: a frame's pixel with ray d (z = 1) has

    z_frame = z_facet / (T_k^T d)_z,    T_k the axes of the facet in those of the frame.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from swimm3r.cameras import Cameras, directions, pixel_grid, project_visible, resized
from swimm3r.imaging.undistortion import covering_pinholes
from swimm3r.scene.reconstruction import Reconstruction, Tracks

_SHARE = math.radians(25)  # half angle across a facet, at most, margins aside
_ONE = math.radians(55)  # half angle of frames up to which one view shows them well
_MARGIN = math.radians(4)  # of a facet beyond its share
_GRID = 65


@dataclass(frozen=True)
class Facets:
    """The views of c frames, those of one frame after another."""

    cameras: Cameras  # c * per_frame pinholes of one size
    turns: Float[Tensor, "k 3 3"]  # axes of each facet in those of its frame

    @property
    def per_frame(self) -> int:
        """Number of views of a frame."""
        return len(self.turns)

    def of_frame(self, i: int) -> range:
        """The views of frame i."""
        return range(i * self.per_frame, (i + 1) * self.per_frame)

    def frame_of(self, view: int) -> int:
        """The frame of a view."""
        return view // self.per_frame

    def turn_of(self, view: int) -> Float[Tensor, "3 3"] | None:
        """The axes of a view in those of its frame; None where they are the same."""
        return None if self.per_frame == 1 else self.turns[view % self.per_frame]


def facets_of(cameras: Cameras, long_side: int) -> Facets:
    """The views that cover frames, `long_side` setting their scale; one each unless the lens is a wide fisheye."""
    scale = min(1.0, long_side / max(cameras.width, cameras.height))
    work = resized(cameras, max(2, round(cameras.width * scale)), max(2, round(cameras.height * scale)))
    rays = _rays(work[0])
    angle = torch.atan(torch.linalg.vector_norm(rays[:, :2], dim=-1))
    if cameras.model != "OPENCV_FISHEYE" or float(angle.max()) <= _ONE:
        return Facets(covering_pinholes(cameras, long_side), torch.eye(3, dtype=torch.float64)[None])
    long = 0 if cameras.width >= cameras.height else 1
    across = torch.atan(rays[:, long])
    half = float(across.abs().max())
    count = math.ceil(half / _SHARE)
    share = half / count
    turns, extents = [], []
    for k in range(count):
        middle = -half + (2 * k + 1) * share
        turns.append(_turned(middle, long))
        inside = rays[(across - middle).abs() <= share + _MARGIN] @ turns[-1]
        on_plane = inside[:, :2] / inside[:, 2:]
        extents.append(torch.cat([on_plane.amin(0), on_plane.amax(0)]))
    return Facets(_pinholes(work, torch.stack(turns), torch.stack(extents)), torch.stack(turns))


def _rays(lens: Cameras) -> Float[Tensor, "n 3"]:
    """Rays spread over an image, its borders included."""
    grid = pixel_grid(_GRID, _GRID).double() - 0.5
    pixels = grid * torch.tensor([lens.width / (_GRID - 1), lens.height / (_GRID - 1)])
    rays = directions(lens, pixels.reshape(1, -1, 2))[0]
    return rays[rays.isfinite().all(-1)]


def _turned(angle: float, long: int) -> Float[Tensor, "3 3"]:
    """Axes turned about y toward x, or about x toward y."""
    turn, (c, s) = torch.eye(3, dtype=torch.float64), (math.cos(angle), math.sin(angle))
    turn[long, long], turn[long, 2], turn[2, long], turn[2, 2] = c, s, -s, c
    return turn


def _pinholes(frames: Cameras, turns: Float[Tensor, "k 3 3"], extents: Float[Tensor, "k 4"]) -> Cameras:
    """The facets' cameras: one even size, each with its own principal point; focal lengths are the frames'."""
    count, k = len(frames), len(turns)
    focal = frames.K[:, [0, 1], [0, 1]].double()
    size = ((extents[:, 2:] - extents[:, :2]).amax(0) * focal.amax(0)).tolist()
    width, height = (2 * math.ceil(side / 2 - 1e-3) for side in size)
    K = torch.zeros(count, k, 3, 3, dtype=torch.float64)
    K[..., 0, 0], K[..., 1, 1], K[..., 2, 2] = focal[:, None, 0], focal[:, None, 1], 1
    middle = (extents[:, :2] + extents[:, 2:]) / 2
    K[..., :2, 2] = torch.tensor([width / 2, height / 2]) - middle * focal[:, None]
    pose = frames.cam2world.double()[:, None].repeat(1, k, 1, 1)
    pose[..., :3, :3] = pose[..., :3, :3] @ turns
    flat = torch.zeros(count * k, 0, dtype=torch.float64)
    return Cameras(K.flatten(0, 1), flat, pose.flatten(0, 1), width, height)


def in_facets(rec: Reconstruction, facets: Facets) -> Reconstruction:
    """The reconstruction as if every facet were a frame: a frame's points belong to the facets that show them."""
    if facets.per_frame == 1:
        return rec
    names = tuple(f"{name}.{k}" for name in rec.names for k in range(facets.per_frame))
    rows, views = _shown(rec, facets)
    tracks = Tracks(rec.tracks.point[rows], views, rec.tracks.xy[rows])
    return replace(rec, names=names, cameras=facets.cameras, tracks=tracks)


def _shown(rec: Reconstruction, facets: Facets) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    """Rows of the tracks, and the views that show their points."""
    rows, views = [], []
    for i in range(len(rec.names)):
        mine = torch.nonzero(rec.tracks.frame == i)[:, 0]
        points = rec.points.xyz[rec.tracks.point[mine]].double()
        for view in facets.of_frame(i):
            _, _, shown = project_visible(facets.cameras[view], points[None])
            rows.append(mine[shown[0]])
            views.append(torch.full_like(rows[-1], view))
    return torch.cat(rows), torch.cat(views)


def merged(
    q: list[Float[Tensor, "h w"]],
    confidence: list[Float[Tensor, "h w"]],
    rays: Float[Tensor, "h w 3"],
    facets: Facets,
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Inverse depth and confidence of a frame of those of its facets on the frame's grid; 0 = unknown.

    A pixel has the depth of the facet whose axis is nearest to its ray, among those that know it.
    """
    if facets.per_frame == 1:
        return q[0], confidence[0]
    along = torch.einsum("hwi,ki->khw", rays.double(), facets.turns[..., 2])
    known = torch.stack(q) > 0
    best = torch.where(known, along, -torch.inf).argmax(0, keepdim=True)
    depths = torch.stack(q) * along.to(q[0])
    return depths.gather(0, best)[0], torch.stack(confidence).gather(0, best)[0]
