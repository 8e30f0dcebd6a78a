"""The parts of a reconstruction that are trained on: those of the blocks, and the one that all take the water from."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import unproject
from swimm3r.scene.reconstruction import DenseCloud, Matches, Points, Reconstruction, Tracks
from swimm3r.scene.surface import Surface
from swimm3r.splat.blocks.plan import PlannedBlock
from swimm3r.splat.ground import Window, held_by_any
from swimm3r.splat.views import filled

_LEAST = 0.02  # of a view's pixels, from which on it is one of a block
_SAMPLED = 24  # rows of pixels that say how much of a view is of which block
_ROWS = 120  # rows of pixels that say what a view sees of a surface, cell by cell
_MOST = 256  # frames of the stretches: their images stay in memory
_STRETCHES = 4  # of a dive, whose ground stands for all of it


@dataclass(frozen=True)
class BlockViews:
    """The frames that see a block."""

    names: tuple[str, ...]
    images: float  # that the pixels on the block and its margin make up together


def views_of_blocks(rec: Reconstruction, names: tuple[str, ...], plan: Sequence[PlannedBlock]) -> list[BlockViews]:
    """The frames, of `names`, that see each block: those with a fiftieth of their pixels there, or the one with most.

    A frame without depth sees the blocks of its sparse points.
    """
    own, with_margin = torch.zeros(len(names), len(plan)), torch.zeros(len(names), len(plan))
    for i, name in enumerate(names):
        points = _looked_at(rec, name, _SAMPLED)
        if len(points):
            uv = plan[0].window.plane.coordinates(points)
            for k, block in enumerate(plan):
                own[i, k] = block.window.holds_coordinates(uv).float().mean()
                with_margin[i, k] = block.window.widened(block.margin).holds_coordinates(uv).float().mean()
    enough = (own >= _LEAST) | ((own > 0) & (own == own.amax(0)))
    return [
        BlockViews(
            tuple(name for name, is_one in zip(names, seen.tolist(), strict=True) if is_one), float(shares[seen].sum())
        )
        for seen, shares in zip(enough.mT, with_margin.mT, strict=True)
    ]


def _looked_at(rec: Reconstruction, name: str, rows: int) -> Float[Tensor, "n 3"]:
    """World points of the pixels of so many of a frame's rows, and of as dense columns."""
    i = rec.index(name)
    if name in rec.depth:
        z_depth = rec.depth[name].z_depth
        step = max(1, z_depth.shape[0] // rows)
        z = filled(z_depth[step // 2 :: step, step // 2 :: step])
        if z is not None:
            row, column = (torch.arange(step // 2, size, step) + 0.5 for size in z_depth.shape)
            pixels = torch.stack(torch.meshgrid(column, row, indexing="xy"), -1).reshape(1, -1, 2).double()
            return unproject(rec.cameras[i], pixels, z.reshape(1, -1).double())[0]
    return rec.points.xyz[rec.tracks.point[rec.tracks.frame == i]].double()


def part_of(rec: Reconstruction, names: Sequence[str], window: Window, closed: Sequence[Window] = ()) -> Reconstruction:
    """The reconstruction of these frames, with the points over a window but not over those `closed`.

    Tracks and matches are left out.
    """
    return _part(rec, names, lambda xyz: window.holds(xyz) & ~held_by_any(closed, xyz))


def stretches_of(rec: Reconstruction, names: Sequence[str], surface: Surface, images: float) -> Reconstruction:
    """Stretches spread over a dive that see as much ground as so many images, with the points of this ground.

    Stretches grow by a frame at both ends until there is as much, or all frames are in. Of more than 256 frames some
    are left out, evenly; tracks and matches are, too.
    """
    seen = torch.zeros(len(surface.area), dtype=torch.bool)
    middles = [round((k + 0.5) / _STRETCHES * len(names) - 0.5) for k in range(_STRETCHES)]
    chosen: set[int] = set()
    for reach in range(len(names)):
        ends = {i for middle in middles for i in (middle - reach, middle + reach) if 0 <= i < len(names)} - chosen
        for i in ends:
            cells = surface.cells_of(_looked_at(rec, names[i], _ROWS))
            seen[cells[cells >= 0]] = True
        chosen |= ends
        if float(surface.area[seen].sum()) >= images:
            break

    def on_it(xyz: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        cells = surface.cells_of(xyz)
        return (cells >= 0) & seen[cells]

    kept = sorted(chosen)[:: math.ceil(len(chosen) / _MOST)]
    return _part(rec, [names[i] for i in kept], on_it)


def _part(
    rec: Reconstruction, names: Sequence[str], chosen: Callable[[Float[Tensor, "n 3"]], Bool[Tensor, " n"]]
) -> Reconstruction:
    none = torch.zeros(0, dtype=torch.int64)
    flat = torch.zeros(0, 2)
    kept = chosen(rec.points.xyz)
    return replace(
        rec,
        names=tuple(names),
        cameras=rec.cameras[[rec.index(name) for name in names]],
        points=Points(rec.points.xyz[kept], rec.points.rgb[kept], rec.points.error[kept]),
        tracks=Tracks(none, none, flat),
        matches=Matches(none, none, flat, flat, torch.zeros(0)),
        cloud=_cloud_part(rec.cloud, chosen),
        backdrop=_cloud_part(rec.backdrop, chosen),
    )


def _cloud_part(
    cloud: DenseCloud | None, chosen: Callable[[Float[Tensor, "n 3"]], Bool[Tensor, " n"]]
) -> DenseCloud | None:
    if cloud is None:
        return None
    kept = chosen(cloud.xyz)
    return DenseCloud(cloud.xyz[kept], cloud.raw[kept], cloud.restored[kept])
