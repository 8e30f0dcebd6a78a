"""Scores of a held-out view over the part of its pixels that a map can know: measured, observed, or without movers."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TypeVar

from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.images import as_8_bit, blur4_psnr, psnr, sharpness
from swimm3r.evaluate.registration import displacement, psnr_affine


@dataclass(frozen=True)
class CoveredScores:
    """The scores where training frames measured what this frame shows; a map cannot know the rest.

    A moving object in front of measured ground is none of it.
    """

    share: float | NotComputed  # of the pixels
    psnr: float | NotComputed  # dB
    blur4_psnr: float | NotComputed  # dB
    psnr_affine: float | NotComputed  # dB, after the affine map of the rendering's colors that fits best
    flow_px: float | NotComputed  # median displacement between rendering and frame, `evaluate.registration`
    flow_px_p90: float | NotComputed  # its 90th percentile
    flow_share: float | NotComputed  # of the covered pixels, those with texture enough for it

    def summary(self) -> dict[str, float | NotComputed]:
        """The scores by the names of summary.json."""
        return {
            "covered": self.share,
            "psnr_covered": self.psnr,
            "blur4_psnr_covered": self.blur4_psnr,
            "psnr_affine": self.psnr_affine,
            "flow_px": self.flow_px,
            "flow_px_p90": self.flow_px_p90,
            "flow_share": self.flow_share,
        }


@dataclass(frozen=True)
class StillScores:
    """The scores where nothing moves, by the surfaces that training frames measured (`sfm.moving`)."""

    share: float | NotComputed  # of the pixels
    psnr: float | NotComputed  # dB

    def summary(self) -> dict[str, float | NotComputed]:
        """The scores by the names of summary.json."""
        return {"still": self.share, "psnr_still": self.psnr}


@dataclass(frozen=True)
class ObservedScores:
    """The scores on what some training frame saw by the map's own depth, measured or guessed."""

    share: float | NotComputed  # of the pixels
    psnr: float | NotComputed  # dB
    sharpness: float | NotComputed  # mean gradient magnitude, render : target

    def summary(self) -> dict[str, float | NotComputed]:
        """The scores by the names of summary.json."""
        return {"observed": self.share, "psnr_observed": self.psnr, "sharpness_observed": self.sharpness}


@dataclass(frozen=True)
class MotionScores:
    """The scores where a truth says that something moves, and where it says that nothing does."""

    moving: float | NotComputed  # PSNR, dB
    still: float | NotComputed  # PSNR, dB

    def summary(self) -> dict[str, float | NotComputed]:
        """The scores by the names of summary.json."""
        return {"psnr_moving": self.moving, "psnr_still": self.still}


def covered_scores(
    render: Float[Tensor, "h w 3"],
    target: Float[Tensor, "h w 3"],
    seen: Bool[Tensor, "h w"],
    covered: Bool[Tensor, "h w"],
) -> CoveredScores:
    """PSNRs and displacement over the covered pixels; both images as their 8-bit files show them."""
    counted = seen & covered
    share = float(counted.sum() / seen.sum())
    if not bool(counted.any()):
        nothing = NotComputed("no training frame saw what the test frames show")
        return CoveredScores(share, *[nothing] * 6)
    render, target = as_8_bit(render), as_8_bit(target)
    moved = displacement(render, target, counted)
    flow = [moved] * 3 if isinstance(moved, NotComputed) else [moved.median, moved.p90, moved.share]
    return CoveredScores(
        share,
        psnr(render[counted], target[counted]),
        blur4_psnr(target, counted),
        psnr_affine(render, target, counted),
        *flow,
    )


def observed_scores(
    render: Float[Tensor, "h w 3"],
    target: Float[Tensor, "h w 3"],
    seen: Bool[Tensor, "h w"],
    observed: Bool[Tensor, "h w"] | None,
) -> ObservedScores:
    """Share, PSNR and sharpness of the observed pixels; both images as their 8-bit files show them."""
    if observed is None:
        unknown = NotComputed("the map was made before it kept what training frames saw")
        return ObservedScores(unknown, unknown, unknown)
    counted = seen & observed
    share = float(counted.sum() / seen.sum())
    if not bool(counted.any()):
        nothing = NotComputed("no training frame saw what the test frames show")
        return ObservedScores(share, nothing, nothing)
    render, target = as_8_bit(render), as_8_bit(target)
    return ObservedScores(share, psnr(render[counted], target[counted]), sharpness(render, target, counted))


def still_scores(
    render: Float[Tensor, "h w 3"],
    target: Float[Tensor, "h w 3"],
    seen: Bool[Tensor, "h w"],
    quiet: Bool[Tensor, "h w"] | None,
) -> StillScores:
    """Share and PSNR of the pixels without moving objects; both images as their 8-bit files show them."""
    if quiet is None:
        unknown = NotComputed("moving objects were not looked for (--moving none)")
        return StillScores(unknown, unknown)
    share = float(quiet.sum() / seen.sum())
    if not bool(quiet.any()):
        return StillScores(share, NotComputed("moving objects cover the test frames wholly"))
    return StillScores(share, psnr(as_8_bit(render)[quiet], as_8_bit(target)[quiet]))


def motion_scores(
    render: Float[Tensor, "h w 3"],
    target: Float[Tensor, "h w 3"],
    seen: Bool[Tensor, "h w"],
    quiet: Bool[Tensor, "h w"] | None,
) -> MotionScores:
    """PSNR of the pixels that a truth's masks admit, and of the others; both images as their 8-bit files show them."""
    if quiet is None:
        unknown = NotComputed("no truth says what moves")
        return MotionScores(unknown, unknown)
    render, target = as_8_bit(render), as_8_bit(target)

    def of(where: Bool[Tensor, "h w"]) -> float | NotComputed:
        if not bool(where.any()):
            return NotComputed("no held-out frame shows any of it")
        return psnr(render[where], target[where])

    return MotionScores(of(seen & ~quiet), of(quiet))


Part = TypeVar("Part", CoveredScores, ObservedScores, StillScores, MotionScores)


def mean_part(parts: Sequence[Part]) -> Part:
    """Means over frames; those without a number, as without a covered pixel, are left out of what they have none of.

    Raises ValueError without a frame.
    """
    if not parts:
        raise ValueError("the mean score of no frames is undefined")

    def mean(values: list[float | NotComputed]) -> float | NotComputed:
        numbers = [v for v in values if not isinstance(v, NotComputed)]
        return sum(numbers) / len(numbers) if numbers else values[0]

    kind = type(parts[0])
    return kind(*(mean([getattr(part, field.name) for part in parts]) for field in fields(kind)))


def not_computed(kind: type[Part], reason: NotComputed) -> Part:
    """The scores of no frame at all."""
    return kind(*[reason] * len(fields(kind)))
