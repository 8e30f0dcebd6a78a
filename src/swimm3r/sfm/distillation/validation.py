"""Is the student getting better? Depth, pose and restoration on pairs it is not trained on, as they were taken.

    depth_absrel       mean |s d - d*| / d* of view 1, ray depths, s = median d* / median d
    rotation_deg       of the essential matrix through the descriptors' matches against the true pose, median;
    translation_deg    the same for the direction of motion; a pair without a pose counts 180
    restored_psnr      of the clear image by the head's water at true ray depth, dB over the pixels of known depth
    raw_psnr           of the image as taken: what restoration starts from
    loss               L_SfM
    water_error        of the head's coefficients in water that the augmentation draws, and so is known: the 68th
                       percentile of |estimate / truth - 1| over frames, one standard error, per coefficient and channel

None where the pairs do not know the truth.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import directions
from swimm3r.evaluate.images import psnr
from swimm3r.geometry import rotation_angle
from swimm3r.medium import remove_water
from swimm3r.sfm.distillation.pairs import PairData, PairItem, TwoViews
from swimm3r.sfm.mast3r.matching import DescriptorMap, PixelMatches, drop_border, match_pass
from swimm3r.sfm.mast3r.network import Descriptors, Encoded
from swimm3r.sfm.mast3r.settings import MatchingSettings
from swimm3r.sfm.student.physics_head import ray_depth_of
from swimm3r.sfm.student.student import Student

_MIN_MATCHES = 8
_LOST = 180.0  # degrees
_BEST_PSNR = 100.0  # dB; equal images have an infinite one, which no mean survives
_ONE_STD = 0.683  # share of a normal distribution within one standard deviation
_COEFFICIENTS = ("Binf", "beta_D", "beta_B")


@dataclass(frozen=True)
class _PoseError:
    rotation_deg: float
    translation_deg: float


def score(student: Student, data: PairData) -> dict[str, Any]:
    """The scores of a validation set; call it with gradients off."""
    found: dict[str, list[float]] = {
        name: [] for name in ("depth_absrel", "rotation_deg", "translation_deg", "restored_psnr", "raw_psnr", "loss")
    }
    for index in range(len(data)):
        item = data.item(index, 0.0, torch.Generator().manual_seed(index))
        for name, value in _score_pair(student, item, data.two_views(index)).items():
            found[name].append(value)
    median = ("rotation_deg", "translation_deg")
    scores = {n: (float(np.median(v) if n in median else np.mean(v)) if v else None) for n, v in found.items()}
    return {**scores, "water_error": water_error(student, data)}


def water_error(student: Student, data: PairData) -> dict[str, list[float]] | None:
    """Relative standard error of every coefficient of the head's water, R G B, where the augmentation draws water.

    None without a head, and for a set none of whose pairs has both a clear image and depth.
    """
    if student.head is None:
        return None
    device = student.network.decoder_embed.weight.device
    ratios = []  # [coefficient, channel] per frame
    for index in range(len(data)):
        item = data.item(index, 1.0, torch.Generator().manual_seed(index))
        medium = student.water(student.network.encode(item.raw.to(device))).at(item.ray_depth.to(device))
        for view in range(2):
            known, sampled_medium = item.valid[view], item.sampled_medium[view]
            if bool(known.any()) and bool(sampled_medium.isfinite().all()):
                read = [getattr(medium, name)[view].cpu()[known].median(0).values for name in _COEFFICIENTS]
                ratios.append(torch.stack(read) / sampled_medium.clamp(min=1e-6) - 1)
    if not ratios:
        return None
    error = torch.stack(ratios).double().abs().quantile(_ONE_STD, dim=0)
    return dict(zip(_COEFFICIENTS, error.tolist(), strict=True))


def _score_pair(student: Student, item: PairItem, truth: TwoViews | None) -> dict[str, float]:
    network = student.network
    device = network.decoder_embed.weight.device
    on_device = {name: getattr(item, name)[None].to(device) for name in PairItem.__annotations__}
    scores = {"loss": float(student.total(student(**on_device)))}
    both = network.encode(on_device["raw"][0])
    one, two = (Encoded(both.tokens[k : k + 1], both.positions[k : k + 1], both.height, both.width) for k in (0, 1))
    view1, view2 = network.decode(one, two)
    known = item.valid[0]
    if bool(known.any()):
        depth = ray_depth_of(network.pointmap(view1, 1).points[0]).cpu()
        scores["depth_absrel"] = absolute_relative(depth[known], item.ray_depth[0][known])
    if student.head is not None and bool(item.valid.any()):
        medium = student.water(both).at(on_device["ray_depth"][0])
        I, J = (((on_device[n][0] + 1) / 2).permute(0, 2, 3, 1) for n in ("raw", "clean"))
        restored = remove_water(I, on_device["ray_depth"][0], medium, student.objective.min_transmittance).clamp(0, 1)
        seen = on_device["valid"][0]
        scores |= {
            "restored_psnr": min(_BEST_PSNR, psnr(restored[seen], J[seen])),
            "raw_psnr": min(_BEST_PSNR, psnr(I[seen], J[seen])),
        }
    if truth is not None:
        matches = _matches(network.descriptors(view1, 1), network.descriptors(view2, 2))
        error = pose_error(matches, truth)
        scores |= {"rotation_deg": error.rotation_deg, "translation_deg": error.translation_deg}
    return scores


def absolute_relative(depth: Float[Tensor, " n"], truth: Float[Tensor, " n"]) -> float:
    """Mean relative error of depths after their medians were made equal."""
    scale = truth.median() / depth.median().clamp(min=1e-9)
    return float(((scale * depth - truth).abs() / truth).mean())


def pose_error(matches: PixelMatches, truth: TwoViews) -> _PoseError:
    """Error of the relative pose that explains the matches."""
    import cv2

    if len(matches.xy1) < _MIN_MATCHES:
        return _PoseError(_LOST, _LOST)
    rays = [_normalized(xy, truth) for xy in (matches.xy1, matches.xy2)]
    threshold = 1.0 / float(truth.camera.K[0, 0, 0])  # one pixel
    cv2.setRNGSeed(0)
    E, inliers = cv2.findEssentialMat(rays[0], rays[1], np.eye(3), cv2.RANSAC, 0.999, threshold)
    if E is None or E.shape != (3, 3):
        return _PoseError(_LOST, _LOST)
    _, R, t, _ = cv2.recoverPose(E, rays[0], rays[1], np.eye(3), mask=inliers)
    pose = truth.second_from_first
    turned = rotation_angle(torch.from_numpy(R) @ pose[:3, :3].mT)
    moved = torch.from_numpy(t[:, 0])
    angle = torch.atan2(torch.linalg.cross(moved, pose[:3, 3]).norm(), torch.dot(moved, pose[:3, 3]))
    return _PoseError(math.degrees(turned), math.degrees(angle))


def _normalized(xy: Tensor, truth: TwoViews) -> np.ndarray:
    """Pixels, whole numbers, as points of the undistorted plane z = 1."""
    return np.ascontiguousarray(directions(truth.camera, (xy.double() + 0.5)[None])[0, :, :2].numpy())


def _matches(one: Descriptors, two: Descriptors) -> PixelMatches:
    settings = MatchingSettings()
    maps = [DescriptorMap(d.descriptors[0].cpu(), d.confidence[0].cpu()) for d in (one, two)]
    found = match_pass(maps[0], maps[1], settings.subsample)
    sizes = [m.confidence.shape for m in maps]
    return drop_border(found, sizes[0], sizes[1], settings.border)
