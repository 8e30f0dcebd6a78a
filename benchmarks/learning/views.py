"""Shots of dives in memory, at the network's size, with the truth about every pixel; and true matches of two."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import Cameras, directions, image_directions, pixel_grid, project
from swimm3r.datasets import PairSettings, load, make_pairs, read_tree
from swimm3r.datasets.sequences import Sequence
from swimm3r.geometry import relative_poses
from swimm3r.sfm.distillation.pairs import depth_to_network
from swimm3r.sfm.distillation.two_view_losses import TrueMatches
from swimm3r.sfm.mast3r.preprocess import K_to_network, framing, to_network

_SAME = 0.03  # relative difference of depth up to which two pixels show one point


@dataclass(frozen=True)
class Shots:
    """One dive; its images share a lens."""

    name: str
    clean: Float[Tensor, "n 3 h w"]  # -1..1
    raw: Float[Tensor, "n 3 h w"] | None
    z_depth: Float[Tensor, "n h w"]  # m, 0 where unknown
    cameras: Cameras  # of the network's images
    pairs: tuple[tuple[int, int], ...]

    @cached_property
    def rays(self) -> Float[Tensor, "h w 3"]:
        """Of every pixel, z = 1."""
        return image_directions(self.cameras[0]).float()

    def points(self, i: int) -> Float[Tensor, "h w 3"]:
        """Every pixel's surface in its own camera, m."""
        return self.z_depth[i, ..., None] * self.rays

    @property
    def ray_depth(self) -> Float[Tensor, "n h w"]:
        """m, 0 where unknown."""
        return self.z_depth * self.rays.norm(dim=-1)

    def second_from_first(self, i: int, j: int) -> Float[Tensor, "4 4"]:
        """Points in camera i -> points in camera j, float64."""
        pose = self.cameras.cam2world
        return relative_poses(pose[j], pose[i])


def read_shots(root: Path, size: int, pairs: PairSettings = PairSettings()) -> list[Shots]:  # noqa: B008  frozen
    """Every sequence below a folder that knows lens, poses and depth of all its shots."""
    return [_in_memory(sequence, size, pairs) for sequence in read_tree(root).sequences]


def _in_memory(sequence: Sequence, size: int, settings: PairSettings) -> Shots:
    clean, raw, depth = [], [], []
    frame = lens = None
    for k in range(len(sequence)):
        view = load(sequence, k)
        assert view.clean is not None
        assert view.z_depth is not None
        height, width = view.clean.shape[:2]
        frame, lens = framing(width, height, size), sequence.camera(width, height)
        clean.append(to_network(view.clean, frame))
        depth.append(depth_to_network(view.z_depth, frame))
        if view.raw is not None:
            raw.append(to_network(view.raw, frame))
    assert frame is not None
    assert lens is not None
    poses = torch.stack([torch.from_numpy(sequence.cam2world[s.name]).double() for s in sequence.shots])
    cameras = Cameras(
        K_to_network(lens.K, frame).repeat(len(poses), 1, 1), lens.distortion.repeat(len(poses), 1), poses,
        frame.network_width, frame.network_height, lens.model,
    )  # fmt: skip
    found = tuple((p.i, p.j) for p in make_pairs(sequence, settings))
    return Shots(
        sequence.name, torch.stack(clean), torch.stack(raw) if raw else None, torch.stack(depth), cameras, found
    )


def true_partners(shots: Shots, i: int, j: int, xy: Float[Tensor, "m 2"]) -> tuple[Tensor, Bool[Tensor, " m"]]:
    """Positions in image j of the pixels of image i (centers at +0.5), and whether j sees the same surface there."""
    height, width = shots.z_depth.shape[1:]
    column, row = xy.long().unbind(-1)
    z = shots.z_depth[i, row, column]
    pose = shots.second_from_first(i, j)
    seen = directions(shots.cameras[i], xy.double()[None])[0] * z[:, None].double()
    camera = shots.cameras[j]
    moved = Cameras(
        camera.K, camera.distortion, torch.eye(4, dtype=torch.float64)[None], camera.width, camera.height, camera.model
    )
    there, expected = project(moved, (seen @ pose[:3, :3].mT + pose[:3, 3])[None])
    there, expected = there[0].nan_to_num(-1, -1, -1), expected[0]
    inside = (there > 0).all(-1) & (there < torch.tensor([width, height])).all(-1)
    column, row = (there[:, k].clamp(0, n - 1).long() for k, n in ((0, width), (1, height)))
    measured = shots.z_depth[j, row, column].double()
    same = (measured - expected).abs() <= _SAME * expected
    return there, inside & (z > 0) & (expected > 0) & (measured > 0) & same


def draw_matches(
    shots: Shots, i: int, j: int, count: int, wrong: float, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """`count` rows: flat pixels of both shots and whether they match; a share `wrong`, or more, are drawn anyhow."""
    height, width = shots.z_depth.shape[1:]
    grid = pixel_grid(height, width).reshape(-1, 2)
    drawn = torch.randperm(height * width, generator=generator)
    there, valid = true_partners(shots, i, j, grid[drawn])
    kept = torch.nonzero(valid)[:, 0][: round(count * (1 - wrong))]
    partner = there[kept].long()
    index1, index2 = (torch.randint(height * width, (count,), generator=generator) for _ in range(2))
    index1[: len(kept)] = drawn[kept]
    index2[: len(kept)] = partner[:, 1] * width + partner[:, 0]
    return index1, index2, torch.arange(count) < len(kept)


def stacked(rows: list[tuple[Tensor, Tensor, Tensor]]) -> TrueMatches:
    """The matches of a batch."""
    return TrueMatches(*(torch.stack(parts) for parts in zip(*rows, strict=True)))
