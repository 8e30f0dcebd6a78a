"""The plan of a map in blocks: the ground cut into windows of equal area (`scene.surface`), with a margin around each,
and their turns.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.scene.surface import Surface
from swimm3r.splat.ground import Window, plane_of
from swimm3r.splat.settings import BlockSettings


@dataclass(frozen=True)
class PlannedBlock:
    """One block's ground, and its turn: those of one turn have no common border, and those of earlier ones are done."""

    window: Window
    margin: float  # scene units, trained with the block and then left out
    area: float  # in images, the margin's included
    turn: int = 0
    before: tuple[int, ...] = ()  # the neighbors of earlier turns
    open_area: float = 0.0  # in images, that of `before` left out


def plan_blocks(surface: Surface, median_depth: float, settings: BlockSettings) -> tuple[PlannedBlock, ...]:
    """As few blocks as hold at most the settings' area each, alike in area; one where `largest` is 0."""
    total = float(surface.area.sum())
    count = math.ceil(total / settings.largest) if settings.largest else 1
    plane = plane_of(surface.xyz)
    uv = plane.coordinates(surface.xyz)
    windows = _cut(Window(plane), uv, surface.area, count)
    return _in_turns(windows, settings.margin * median_depth, uv, surface.area)


def _in_turns(
    windows: Sequence[Window], margin: float, uv: Float[Tensor, "n 2"], area: Float[Tensor, " n"]
) -> tuple[PlannedBlock, ...]:
    """The blocks of these windows, each in the first turn that no neighbor has."""
    blocks: list[PlannedBlock] = []
    for window in windows:
        wide = window.widened(margin)
        neighbors = [k for k, other in enumerate(blocks) if wide.meets(other.window.widened(margin))]
        taken = {blocks[k].turn for k in neighbors}
        turn = next(k for k in range(len(windows)) if k not in taken)
        seen = wide.holds_coordinates(uv)
        blocks.append(PlannedBlock(window, margin, float(area[seen].sum()), turn))
    done = []
    for k, block in enumerate(blocks):
        wide = block.window.widened(margin)
        before = tuple(
            j for j, other in enumerate(blocks) if other.turn < block.turn and wide.meets(other.window) and j != k
        )
        left = wide.holds_coordinates(uv)
        for j in before:
            left = left & ~blocks[j].window.holds_coordinates(uv)
        done.append(replace(block, before=before, open_area=float(area[left].sum())))
    return tuple(done)


def _cut(window: Window, uv: Float[Tensor, "n 2"], area: Float[Tensor, " n"], count: int) -> list[Window]:
    """The window in `count` parts of equal area, always cut across the longer side of what it holds."""
    inside = window.holds_coordinates(uv)
    if count == 1 or int(inside.sum()) < 2:
        return [window]
    uv, area = uv[inside], area[inside]
    axis = int((uv.amax(0) - uv.amin(0)).argmax())
    first = count // 2
    order = uv[:, axis].argsort()
    shares = area[order].cumsum(0) / area.sum()
    place = int(torch.searchsorted(shares, first / count).clamp(max=len(order) - 2))
    at = float(uv[order[place : place + 2], axis].mean())
    before, behind = window.halves(axis, at)
    return _cut(before, uv, area, first) + _cut(behind, uv, area, count - first)
