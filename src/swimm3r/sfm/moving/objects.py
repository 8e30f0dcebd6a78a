"""Moving objects as far as they reach: from the pixels that surely show them, along colors that things that move have.

Other frames decide on a pixel only if they measured what lies behind it, and an object that moves with the camera, as
a gripper or a net does, hides much of that in all of them. Two mixtures of Gaussians tell colors apart, one of the
pixels of all frames that surely move and one of those that surely show what others measured. By them, and by how many
of these pixels move, a graph cut assigns those that nothing decides (GrabCut; Rother et al. 2004, with models that all
frames share). Regions are objects where 2 % of their pixels surely move, or where objects of the frames before and
after cover 30 % of them in the image.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from swimm3r.sfm.moving.occluders import Evidence

_PER_FRAME = 4000  # colors of either kind that a frame contributes, at most
_COLORS = 20_000  # of either kind that the mixtures are fitted to, at most
_SURE = 0.02  # share of a region that surely moves, from which all of it is an object
_STAYS = 0.3  # share of an object that lies where those of the frames before and after do, if it moves with the camera
_SPECK = 0.001  # of the image; smaller objects are noise
_GAUSSIANS, _MODEL = 5, 65  # of a mixture of cv2.grabCut, and its numbers: weights, means and covariances
_HIDING = 25.0  # times as often pixels move on which nothing decides as others do, up to as often as not


@dataclass(frozen=True)
class ColorSamples:
    """Colors of pixels that surely move, and of pixels that surely do not."""

    moving: UInt8[np.ndarray, "n 3"]
    still: UInt8[np.ndarray, "m 3"]
    counts: tuple[int, int]  # of all such pixels, of which the colors are a part


@dataclass(frozen=True)
class ColorModels:
    """Mixtures of Gaussians of these colors, as cv2.grabCut holds them.

    Weights of `moving` add up to 1, those of `still` to the odds against moving where nothing decides.
    """

    moving: Float[np.ndarray, "1 65"]
    still: Float[np.ndarray, "1 65"]


def color_samples(rgb: Float[np.ndarray, "h w 3"], evidence: Evidence) -> ColorSamples:
    """Colors of a frame on which other frames decide."""
    colors = _eight_bits(rgb)
    moving, still = (_few(colors[of], _PER_FRAME) for of in (evidence.moving, evidence.still))
    return ColorSamples(moving, still, (int(evidence.moving.sum()), int(evidence.still.sum())))


def color_models(samples: Iterable[ColorSamples]) -> ColorModels | None:
    """The mixtures of several frames' colors; None where there are none of either kind."""
    import cv2

    frames = list(samples)
    moving_count, still_count = np.sum([few.counts for few in frames], axis=0, dtype=float) if frames else (0, 0)
    if not moving_count or not still_count:
        return None
    moving = _few(np.concatenate([few.moving for few in frames]), _COLORS)
    still = _few(np.concatenate([few.still for few in frames]), _COLORS)
    row = np.concatenate([moving, still])[None]
    label = np.repeat(np.array([[cv2.GC_FGD, cv2.GC_BGD]], np.uint8), [len(moving), len(still)], axis=1)
    models = ColorModels(moving=np.zeros((1, _MODEL)), still=np.zeros((1, _MODEL)))
    cv2.setRNGSeed(0)
    cv2.grabCut(row, label, (0, 0, 0, 0), models.still, models.moving, 1, cv2.GC_INIT_WITH_MASK)
    models.still[:, :_GAUSSIANS] *= max(1.0, still_count / moving_count / _HIDING)
    return models


def objects(
    rgb: Float[np.ndarray, "h w 3"],
    evidence: Evidence,
    models: ColorModels | None,
    neighbors: Bool[np.ndarray, "h w"] | None = None,
) -> Bool[np.ndarray, "h w"]:
    """The pixels of the objects in a frame; without models, only those around pixels that surely move.

    An object has pixels that surely move, or lies where objects of the frames before and after are in their images
    (`neighbors`): what moves with the camera stays there. Pixels beside it mix its color with that of the ground, and
    are its own unless they surely show the ground.
    """
    import cv2

    if not evidence.moving.any() and (neighbors is None or not neighbors.any()):
        return evidence.moving
    region = evidence.moving.astype(np.uint8)
    if models is not None:
        label = np.where(evidence.still, cv2.GC_BGD, cv2.GC_PR_FGD).astype(np.uint8)
        label[evidence.moving] = cv2.GC_FGD
        still, moving = models.still.copy(), models.moving.copy()
        cv2.grabCut(_eight_bits(rgb), label, (0, 0, 0, 0), still, moving, 1, cv2.GC_EVAL_FREEZE_MODEL)
        region = ((label == cv2.GC_FGD) | (label == cv2.GC_PR_FGD)).astype(np.uint8)
    region = cv2.morphologyEx(region, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    count, labels = cv2.connectedComponents(region)
    part_of = labels.astype(np.int64)
    size = np.bincount(part_of.reshape(-1), minlength=count)
    sure = np.bincount(part_of[evidence.moving], minlength=count)
    whole = (sure > 0) & (sure >= _SURE * size)
    if neighbors is not None:
        whole |= np.bincount(part_of[neighbors], minlength=count) >= _STAYS * size
    kept = np.where(whole, size, sure) >= _SPECK * region.size
    kept[0] = False
    found = kept[part_of] & (whole[part_of] | evidence.moving)
    beside = cv2.dilate(found.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return found | (beside & ~evidence.still)


def _few(values: UInt8[np.ndarray, "n 3"], most: int) -> UInt8[np.ndarray, "m 3"]:
    """At most so many of the rows, evenly spread."""
    if len(values) <= most:
        return values
    return values[np.linspace(0, len(values) - 1, most).astype(int)]


def _eight_bits(rgb: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return np.ascontiguousarray((rgb.clip(0, 1) * 255).round().astype(np.uint8))
