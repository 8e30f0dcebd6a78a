"""Arrays in, numbers out: every score of the paper, whoever made the arrays.

A score that cannot be had is a `NotComputed` with the reason in words, never a number standing in for one.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class NotComputed:
    """The reason for a missing score."""

    reason: str


def summary_entries(scores: Mapping[str, object]) -> dict[str, object]:
    """The scores as `summary.json` keeps them: a missing one is null, with `<key>_reason` beside it.

    So is one that JSON cannot hold, as the infinite PSNR of equal images.
    """
    entries: dict[str, object] = {}
    for key, score in scores.items():
        if isinstance(score, NotComputed):
            entries |= {key: None, f"{key}_reason": score.reason}
        elif isinstance(score, float) and not math.isfinite(score):
            entries |= {key: None, f"{key}_reason": f"the value is {score}"}
        else:
            entries[key] = score
    return entries
