"""Scores of the small student: matches, depth and poses beside the teacher's, and its water beside Sea-Thru's.

    python benchmarks/learning/score.py DIVES/test OUT/teacher.safetensors OUT/student/adapter.safetensors
        [--real CLIP ...] [--flsea FOLDER] [--sea-thru]

On held-back dives everything is compared with the truth; a row is one network on one kind of image.

    recall     share of the true matches of a grid of pixels whose nearest descriptor is within 1/32 of the width
    AbsRel     of view 1's ray depth, medians made equal
    rotation, translation    degrees, medians: the second camera from its pointmap (PnP) against the true pose
    T_D, B     mean absolute errors over pixels and channels at true ray depth; `near`: of the lower half of each
               image, all that either method then sees, where the depth range is short. The head reads one image
               at a time, and `dive` is what `swimm3r sfm` makes of all its readings; Sea-Thru is given one image,
               or the whole dive at true poses

On real clips with a COLMAP model, poses are compared with the model's; on FLSea's samples, depth with theirs.
"""

import argparse
import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from views import Shots, read_shots, true_partners

from swimm3r.cameras import Cameras, cameras_of, pixel_grid
from swimm3r.datasets import PairSettings
from swimm3r.evaluate.underwater import view_water_errors, water_scores_from_errors
from swimm3r.geometry import relative_poses, rotation_angle
from swimm3r.io import images
from swimm3r.io.colmap.model import read_model
from swimm3r.io.depth import read_depth
from swimm3r.medium import Medium, MediumFit
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import DepthMap, DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.sfm.colmap.absolute_pose import absolute_pose
from swimm3r.sfm.distillation.pairs import depth_to_network
from swimm3r.sfm.distillation.validation import absolute_relative
from swimm3r.sfm.mast3r import checkpoint
from swimm3r.sfm.mast3r.matching import nearest
from swimm3r.sfm.mast3r.network import Encoded, Mast3r
from swimm3r.sfm.mast3r.preprocess import K_to_network, framing, to_network
from swimm3r.sfm.medium.from_head import FrameReading, summed_up
from swimm3r.sfm.medium.seathru import estimate_medium
from swimm3r.sfm.medium.settings import SeathruSettings
from swimm3r.sfm.student import adapter_file
from swimm3r.sfm.student.physics_head import PhysicsHead, ray_depth_of

_GRID = 4  # pixels between the seeds of the recall
_TOLERANCE = 1 / 32  # of the image's width
_LOST = 180.0
_PARTS = {False: "all", True: "near"}
_COEFFICIENTS = ("Binf", "beta_D", "beta_B")
_ALONE = 8  # every so manieth frame is given to Sea-Thru alone
_APART = 3  # every so manieth pixel tells about the dive's water


WaterRows = dict[str, np.ndarray]  # what was looked at -> errors of T_D and B


@dataclass(frozen=True)
class Looked:
    """The outputs of a network for two views."""

    points: tuple[Tensor, Tensor]  # [h, w, 3] of view 1 and 2 in camera 1
    descriptors: tuple[Tensor, Tensor]  # [h, w, d]


@torch.no_grad()
def look(network: Mast3r, inputs: Tensor) -> Looked:
    """A pair [2, 3, h, w] in one direction."""
    both = network.encode(inputs)
    one, two = (Encoded(both.tokens[k : k + 1], both.positions[k : k + 1], both.height, both.width) for k in (0, 1))
    views = network.decode(one, two)
    points = [network.pointmap(view, k).points[0] for k, view in enumerate(views, 1)]
    described = [network.descriptors(view, k).descriptors[0] for k, view in enumerate(views, 1)]
    return Looked((points[0], points[1]), (described[0], described[1]))


def recall(said: Looked, shots: Shots, i: int, j: int) -> float:
    """The share of true matches that the nearest descriptor finds."""
    height, width = shots.z_depth.shape[1:]
    seeds = pixel_grid(height, width)[_GRID // 2 :: _GRID, _GRID // 2 :: _GRID].reshape(-1, 2)
    there, valid = true_partners(shots, i, j, seeds)
    seeds, there = seeds[valid], there[valid]
    if len(seeds) == 0:
        return float("nan")
    column, row = seeds.long().unbind(-1)
    found = nearest(said.descriptors[0][row, column], said.descriptors[1].flatten(0, 1))
    xy = torch.stack([found % width, found // width], -1) + 0.5
    return float(((xy - there).norm(dim=-1) < _TOLERANCE * width).double().mean())


def pose_error(said: Looked, cameras: Cameras, second_from_first: Tensor) -> tuple[float, float]:
    """Degrees of rotation and of the direction of motion, of the second camera by PnP on its own pointmap."""
    height, width = said.points[1].shape[:2]
    pixels = pixel_grid(height, width)[1::2, 1::2].reshape(-1, 2)
    found = absolute_pose(pixels, said.points[1][1::2, 1::2].reshape(-1, 3), cameras, max_error=0.02 * width)
    if found is None:
        return _LOST, _LOST
    pose = torch.linalg.inv(found[0])
    moved, true = pose[:3, 3], second_from_first[:3, 3]
    angle = torch.atan2(torch.linalg.cross(moved, true).norm(), torch.dot(moved, true))
    turned = rotation_angle(pose[:3, :3] @ second_from_first[:3, :3].mT)
    return float(turned.rad2deg()), float(angle.rad2deg())


def geometry_row(
    network: Mast3r, dives: list[Shots], inputs: Callable[[Shots], Tensor], pairs: int
) -> dict[str, float]:
    """Mean recall and AbsRel, median pose errors over evenly chosen pairs of the dives."""
    rows = []
    for shots in dives:
        chosen = np.linspace(0, len(shots.pairs) - 1, min(pairs, len(shots.pairs))).round().astype(int)
        for i, j in (shots.pairs[k] for k in chosen):
            said = look(network, inputs(shots)[[i, j]])
            known = shots.z_depth[i] > 0
            depth = absolute_relative(ray_depth_of(said.points[0])[known], shots.ray_depth[i][known])
            rows.append(
                (recall(said, shots, i, j), depth, *pose_error(said, shots.cameras[0], shots.second_from_first(i, j)))
            )
    values = np.array(rows)
    means, medians = np.nanmean(values, 0), np.median(values, 0)
    return {
        "recall": means[0], "AbsRel": means[1], "rotation": medians[2], "translation": medians[3], "pairs": len(rows)
    }  # fmt: skip


@torch.no_grad()
def head_water(
    network: Mast3r, head: PhysicsHead, raw: Tensor, ray_depth: Tensor, near: bool
) -> list[tuple[Tensor, Medium]]:
    """Per frame its true ray depth and the head's medium there; `near`: of the lower halves, which are all it sees."""
    half = raw.shape[2] // 32 * 16 if near else 0
    raw, ray_depth = raw[:, :, half:], ray_depth[:, half:]
    medium = head(network.encode(raw)).at(ray_depth)
    return [(z, Medium(*(getattr(medium, n)[k] for n in _COEFFICIENTS))) for k, z in enumerate(ray_depth)]


def sea_thru(shots: Shots, folder: Path, near: bool, chosen: Sequence[int]) -> tuple[MediumFit, Tensor]:
    """Sea-Thru's water of some frames of a dive at true poses and depth, and their ray depth."""
    assert shots.raw is not None
    half = shots.raw.shape[2] // 2 if near else 0
    height, width = shots.raw.shape[2] - half, shots.raw.shape[3]
    K = shots.cameras.K.clone()
    K[:, 1, 2] -= half
    cameras = replace(shots.cameras, K=K, height=height)[list(chosen)]
    depth, frames = DepthMaps(folder / "z_depth"), []
    for k in chosen:
        path = folder / "images" / f"{k:04d}.png"
        images.write_rgb(path, ((shots.raw[k, :, half:] + 1) / 2).permute(1, 2, 0).numpy())
        z = shots.z_depth[k, half:].contiguous()
        depth.write(path.name, DepthMap(z, (z > 0).float()))
        frames.append(Frame(path.name, path, k / 5, 1.0, "train"))
    none, index = torch.zeros(0), torch.zeros(0, dtype=torch.int64)
    rec = Reconstruction(
        names=tuple(f.name for f in frames),
        cameras=cameras,
        points=Points(none.reshape(0, 3), none.reshape(0, 3), none),
        tracks=Tracks(index, index, none.reshape(0, 2)),
        matches=Matches(index, index, none.reshape(0, 2), none.reshape(0, 2), none),
        depth=depth,
        backend="truth",
    )
    fit = estimate_medium(rec, Frames(tuple(frames), width, height, True), SeathruSettings(), "srgb")
    return fit, shots.ray_depth[list(chosen), half:]


def water_errors(views: list[tuple[Tensor, Medium]], true: Medium) -> tuple[float, float]:
    """Mean absolute errors of T_D and B over pixels and channels."""
    identifiable = {name: torch.zeros(3, dtype=torch.bool) for name in _COEFFICIENTS}
    errors = [view_water_errors(ray_depth, medium, true) for ray_depth, medium in views]
    found = water_scores_from_errors(errors, true, identifiable, true)
    return float(np.mean(found.T_D_abs)), float(np.mean(found.B_abs))


def of_dive(views: list[tuple[Tensor, Medium]]) -> list[tuple[Tensor, Medium]]:
    """The same views with the one water that a reconstruction takes for their dive."""
    readings = [
        FrameReading(m.Binf[0, 0], m.beta_B[0, 0], z[z > 0][::_APART], m.beta_D[z > 0][::_APART]) for z, m in views
    ]
    fit = summed_up(readings, SeathruSettings())
    return [(z, fit.at(z)) for z, _ in views]


def head_rows(network: Mast3r, head: PhysicsHead, dives: list[Shots], truth: list[Medium]) -> WaterRows:
    """Errors of the head, which sees one image, whole or its lower half, and of each dive as a whole."""
    rows: dict[str, list[tuple[float, float]]] = {}
    for near, where in _PARTS.items():
        for shots, true in zip(dives, truth, strict=True):
            assert shots.raw is not None
            views = head_water(network, head, shots.raw, shots.ray_depth, near)
            rows.setdefault(f"one image, {where}", []).append(water_errors(views, true))
            rows.setdefault(f"dive, {where}", []).append(water_errors(of_dive(views), true))
    return {name: np.mean(errors, 0) for name, errors in rows.items()}


def sea_thru_rows(dives: list[Shots], truth: list[Medium]) -> WaterRows:
    """Errors of Sea-Thru, from whole dives and from single images."""
    rows: dict[str, list[tuple[float, float]]] = {}
    for shots, true in zip(dives, truth, strict=True):
        count = len(shots.z_depth)
        given = {"dive": [range(count)], "one image": [[k] for k in range(0, count, _ALONE)]}
        for near, where in _PARTS.items():
            for what, choices in given.items():
                for chosen in choices:
                    with tempfile.TemporaryDirectory() as folder:
                        fit, depths = sea_thru(shots, Path(folder), near, chosen)
                    errors = water_errors([(z, fit.at(z)) for z in depths], true)
                    rows.setdefault(f"{what}, {where}", []).append(errors)
    return {name: np.mean(errors, 0) for name, errors in rows.items()}


def real_row(network: Mast3r, clip: Path, size: int, step: int = 3) -> dict[str, float]:
    """Pose errors against the clip's COLMAP model, medians over pairs `step` frames apart."""
    model = read_model(clip)
    cameras, frame = cameras_of(model), framing(model.width, model.height, size)
    lens = replace(
        cameras[0], K=K_to_network(cameras.K[:1], frame), width=frame.network_width, height=frame.network_height
    )
    order = sorted(range(len(model.names)), key=lambda k: model.names[k])
    rows = []
    for a, b in zip(order[::step], order[step::step], strict=False):
        inputs = []
        for k in (a, b):
            image = images.read_rgb(clip / "images" / model.names[k])
            inputs.append(to_network(torch.from_numpy(image).float() / 255, frame))
        pose = relative_poses(cameras.cam2world[b], cameras.cam2world[a])
        rows.append(pose_error(look(network, torch.stack(inputs)), lens, pose))
    rotation, translation = np.median(np.array(rows), 0)
    return {"rotation": rotation, "translation": translation, "pairs": len(rows)}


def flsea_row(network: Mast3r, folder: Path, size: int) -> dict[str, float]:
    """AbsRel of single FLSea images, each paired with itself; their z depth stands for ray depth."""
    errors = []
    for path in sorted((folder / "rgb").glob("*.tiff")) + sorted((folder / "rgb").glob("*.tif")):
        image = torch.from_numpy(images.read_rgb(path)).float() / 255
        number = "".join(c for c in path.stem if c.isdigit())
        depth = torch.from_numpy(read_depth(next((folder / "depth").glob(f"*{number}*"))))
        frame = framing(image.shape[1], image.shape[0], size)
        z = depth_to_network(depth.float(), frame)
        seen = to_network(image, frame)
        found = ray_depth_of(look(network, torch.stack([seen, seen])).points[0])
        errors.append(absolute_relative(found[z > 0], z[z > 0]))
    return {"AbsRel": float(np.mean(errors)), "images": len(errors)}


def read_truth(folder: Path, dives: list[Shots]) -> list[Medium]:
    """The true water of each dive."""
    stored = [json.loads((folder / shots.name / "truth" / "medium.json").read_text()) for shots in dives]
    return [Medium(*(torch.tensor(s[name]) for name in _COEFFICIENTS)) for s in stored]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dives", type=Path)
    parser.add_argument("teacher", type=Path)
    parser.add_argument("adapters", type=Path, nargs="*")
    parser.add_argument("--real", type=Path, nargs="*", default=[])
    parser.add_argument("--flsea", type=Path)
    parser.add_argument("--sea-thru", action="store_true", help="fit Sea-Thru, too; some seconds per dive")
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--pairs", type=int, default=8, help="per dive")
    args = parser.parse_args()
    dives = read_shots(args.dives, args.size, PairSettings(min_overlap=0.4))
    truth = read_truth(args.dives, dives)
    teacher = checkpoint.load(args.teacher)

    def show(row: str, values: dict[str, float]) -> None:
        print(row, *(f"{name} {value:.3f}" for name, value in values.items()), sep="  ", flush=True)

    def beyond_dives(row: str, network: Mast3r) -> None:
        for clip in args.real:
            show(f"{row}, {clip.name}", real_row(network, clip, args.size))
        if args.flsea:
            show(f"{row}, {args.flsea.name}", flsea_row(network, args.flsea, args.size))

    def show_water(row: str, found: WaterRows) -> None:
        for name, (T_D, B) in found.items():
            show(f"{row}, {name}", {"T_D": T_D, "B": B})

    show("teacher, clear", geometry_row(teacher, dives, lambda s: s.clean, args.pairs))
    show("teacher, raw", geometry_row(teacher, dives, _raw, args.pairs))
    beyond_dives("teacher", teacher)
    for adapter in args.adapters:
        network = checkpoint.load(args.teacher)
        student = adapter_file.load(adapter, network)
        show(f"{adapter.parent.name}, raw", geometry_row(network, dives, _raw, args.pairs))
        beyond_dives(adapter.parent.name, network)
        if student.head is not None:
            show_water(f"{adapter.parent.name}, head", head_rows(network, student.head, dives, truth))
    if args.sea_thru:
        show_water("Sea-Thru", sea_thru_rows(dives, truth))


def _raw(shots: Shots) -> Tensor:
    assert shots.raw is not None
    return shots.raw


if __name__ == "__main__":
    main()
