"""Scores of restored images on disk that need no reference: of the physical colors, which is what rows compare.

A white balance for display raises UIQM and UCIQE by itself, whoever found the water. The scores are therefore taken of
the images before it; those of the images as shown stand beside them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from swimm3r.evaluate import NotComputed, summary_entries
from swimm3r.evaluate.underwater import URANKER, uciqe, uiqm
from swimm3r.io import images
from swimm3r.progress import Progress, silent
from swimm3r.sfm.medium.side_by_side import in_order


@dataclass(frozen=True)
class NoReferenceScores:
    """Means over images of native size."""

    uiqm: float | NotComputed  # FUnIE-GAN variant
    uciqe: float | NotComputed  # CIELAB's own units
    urank: float | NotComputed = URANKER


def no_reference_scores(paths: Sequence[Path], progress: Progress = silent) -> NoReferenceScores:
    """The scores of image files of 8 or 16 bits, those that are not there left out."""
    there = [path for path in paths if path.is_file()]
    if not there:
        nothing = NotComputed("no frame was restored" if not paths else f"there is no image in {paths[0].parent}")
        return NoReferenceScores(nothing, nothing, nothing)

    def scored(k: int) -> tuple[float, float]:
        stored = images.read_rgb(there[k])
        rgb = torch.from_numpy(stored.astype(np.float32) / np.iinfo(stored.dtype).max)
        return uiqm(rgb).uiqm, uciqe(rgb)

    scores = []
    for done, of_image in enumerate(in_order(scored, range(len(there)))):
        progress("scoring restored images", done, len(there))
        scores.append(of_image)
    progress("scoring restored images", len(there), len(there))
    mean = torch.tensor(scores).mean(0).tolist()
    return NoReferenceScores(mean[0], mean[1])


def restored_section(physical: Sequence[Path], shown: Sequence[Path], progress: Progress = silent) -> dict[str, object]:
    """An entry of "restored" in summary.json: the scores before the white balance, and as "shown" those after it."""
    variants = {"uiqm_variant": "FUnIE-GAN, native size", "uciqe_variant": "CIELAB, own units"}
    return {
        **summary_entries(vars(no_reference_scores(physical, progress))),
        **variants,
        "colors": "physical: before the white balance of the shown images",
        "shown": summary_entries(vars(no_reference_scores(shown, progress))),
    }
