"""The training frames' poses, refined together with the map (docs/derivations/compared-methods.md#3r-gs).

    cam2world_i' = cam2world_i [R(w_i) | spread v_i],   (v_i, w_i) = MLP(code_i)

with codes and last layer zero at first, w added to the 6D form of the identity, and the root mean square distance of
the cameras from their middle for `spread`. Early on the matches between two frames pull, too, by their epipolar error

    L_epi = sum_m c_m sqrt(d_i^2 + d_j^2) / sum_m c_m

d being the distances of a match's points from each other's epipolar lines in training pixels, c its confidence.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from swimm3r.cameras import Cameras
from swimm3r.errors import InputError
from swimm3r.geometry import (
    Similarity,
    best_similarity,
    fundamental_from_poses,
    pose_from,
    symmetric_epipolar_error,
)
from swimm3r.imaging.undistortion import undistorted_matches
from swimm3r.io.trajectory import write_tum
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.splat.pose_mlp import PoseMlp, moved

_NO_BASELINE = 1e-6  # of the spread: cameras nearer than this have no epipolar lines


def spread_of(cam2world: Float[Tensor, "c 4 4"]) -> float:
    """Root mean square distance of the cameras from their middle."""
    centers = cam2world[:, :3, 3]
    return float((centers - centers.mean(0)).square().sum(-1).mean().sqrt())


@dataclass(frozen=True)
class EpipolarMatches:
    """Two-view matches among the training views, as the training images show them."""

    i: Int[Tensor, " m"]  # index of a view
    j: Int[Tensor, " m"]
    xy_i: Float[Tensor, "m 2"]  # pixels of the view's pinhole canvas
    xy_j: Float[Tensor, "m 2"]
    confidence: Float[Tensor, " m"]

    def some(self, count: int, rng: torch.Generator) -> "EpipolarMatches":
        """About `count` of them, drawn with replacement; all where there are no more."""
        if len(self.i) <= count:
            return self
        rows = torch.randint(len(self.i), (count,), generator=rng)
        return EpipolarMatches(*(values[rows] for values in vars(self).values()))


@dataclass(frozen=True)
class RefinedPoses:
    """Poses of the training frames at the end of the training."""

    names: tuple[str, ...]
    cam2world: Float[Tensor, "c 4 4"]  # float64, scene units


@dataclass(frozen=True)
class TrainingPoses:
    """The training views' cameras as structure from motion placed them, and what the matches say about them."""

    names: tuple[str, ...]
    cameras: Cameras  # pinhole canvases, working units
    scale: float  # working units per scene unit
    spread: float  # working units
    matches: EpipolarMatches

    def __len__(self) -> int:
        return len(self.names)

    def moved(self, codes: PoseMlp, which: Int[Tensor, " k"] | None = None) -> Float[Tensor, "k 4 4"]:
        """The poses of some views, of all by default, as refined so far, working units."""
        which = torch.arange(len(self)) if which is None else which
        return moved(self.cameras.cam2world[which], codes(which), self.spread)

    def epipolar_error(self, codes: PoseMlp, matches: EpipolarMatches) -> Float[Tensor, ""]:
        """L_epi of some matches under the refined poses, pixels."""
        return epipolar_loss(matches, self.moved(codes), self.cameras.K, self.spread)

    def refined(self, codes: PoseMlp) -> RefinedPoses:
        """All poses, in scene units."""
        with torch.no_grad():
            poses = self.moved(codes)
        return RefinedPoses(self.names, pose_from(poses[:, :3, :3], poses[:, :3, 3] / self.scale))


def training_poses_of(rec: Reconstruction, names: tuple[str, ...], cameras: Cameras, scale: float) -> TrainingPoses:
    """The stations of the views `names` with their pinhole `cameras`, working units."""
    matches = epipolar_matches(rec, names, cameras)
    return TrainingPoses(names, cameras, scale, spread_of(cameras.cam2world), matches)


def as_mapped(rec: Reconstruction, poses: RefinedPoses | None) -> Reconstruction:
    """The reconstruction with its cameras where the map's training left them; as it is where they were held."""
    if poses is None:
        return rec
    if unknown := set(poses.names) - set(rec.names):
        raise InputError(
            f"the map was trained on {min(unknown)}, which the reconstruction does not hold",
            cause="map and reconstruction are of different runs, or one of them was edited",
            hint="remove RUN/splat; the swimm3r command that trained the map trains it again",
        )
    cam2world = rec.cameras.cam2world.clone()
    cam2world[[rec.index(name) for name in poses.names]] = poses.cam2world.to(cam2world)
    return replace(rec, cameras=replace(rec.cameras, cam2world=cam2world))


def axes_of_map(rec: Reconstruction, poses: RefinedPoses | None) -> Similarity | None:
    """The similarity from the reconstruction's axes to those of a map, whose training cameras may have moved together.

    None where they were held, or where they do not determine it.
    """
    if poses is None:
        return None
    before = rec.cameras.cam2world[[rec.index(name) for name in poses.names]].double()
    return best_similarity(before, poses.cam2world.to(before))


def write_refined(folder: Path, rec: Reconstruction, frames: Frames, poses: RefinedPoses) -> None:
    """Write the refined poses with the frames' own lenses: cameras.json and trajectory.tum."""
    times = frames.times_of(poses.names)
    write_tum(folder / "trajectory.tum", times, poses.cam2world.numpy())
    lenses = rec.cameras[[rec.index(name) for name in poses.names]]
    units = "metres" if rec.metric else "scene units"
    replace(lenses, cam2world=poses.cam2world).save(folder / "cameras.json", poses.names, times, units)


def epipolar_matches(rec: Reconstruction, names: tuple[str, ...], canvases: Cameras) -> EpipolarMatches:
    """The reconstruction's matches between the frames `names`, whose pinhole canvases are given; distortion undone."""
    m = rec.matches
    view_of = torch.full((len(rec.names),), -1)
    view_of[[rec.index(name) for name in names]] = torch.arange(len(names))
    both = (view_of[m.i] >= 0) & (view_of[m.j] >= 0)
    frame = torch.cat([m.i[both], m.j[both]])
    xy = torch.cat([m.xy_i[both], m.xy_j[both]]).double()
    view = view_of[frame]
    first, second = undistorted_matches(rec.cameras, frame, xy, canvases.K[view_of]).chunk(2)
    known = first.isfinite().all(-1) & second.isfinite().all(-1)
    return EpipolarMatches(
        view[: len(view) // 2][known], view[len(view) // 2 :][known], first[known], second[known],
        m.confidence[both][known].double(),
    )  # fmt: skip


def epipolar_loss(
    matches: EpipolarMatches, cam2world: Float[Tensor, "c 4 4"], K: Float[Tensor, "c 3 3"], spread: float
) -> Float[Tensor, ""]:
    """L_epi of matches under poses, pixels; 0 where no match has a baseline."""
    m, poses = matches, cam2world.double()
    centers = poses[:, :3, 3].detach()
    told = torch.linalg.vector_norm(centers[m.i] - centers[m.j], dim=-1) > _NO_BASELINE * spread
    if not bool(told.any()):
        return poses.new_zeros(())
    i, j = m.i[told], m.j[told]
    pairs, place = torch.unique(i * len(poses) + j, return_inverse=True)
    i, j = pairs // len(poses), pairs % len(poses)
    F = fundamental_from_poses(poses[i], poses[j], K[i].double(), K[j].double())
    error = symmetric_epipolar_error(F[place], m.xy_i[told], m.xy_j[told], "root_sum_square")
    weight = m.confidence[told]
    return (error * weight).sum() / weight.sum()
