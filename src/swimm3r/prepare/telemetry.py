"""Measurements of a camera in every frame of its video: up, and the gains of its exposure and white balance."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from swimm3r.io.telemetry.of_images import telemetry_of_images
from swimm3r.prepare.candidates import SourceImage


def with_telemetry(images: Sequence[SourceImage], video: Path) -> list[SourceImage]:
    """The images with the measurements that their video holds."""
    found = telemetry_of_images(video, [image.time for image in images])
    ups, gains = _rows(found.up, len(images)), _rows(found.gains, len(images))
    return [replace(image, up=up, gains=gain) for image, up, gain in zip(images, ups, gains, strict=True)]


def _rows(values: Float[np.ndarray, "n 3"] | None, count: int) -> list[tuple[float, float, float] | None]:
    """A row for each image, None where it was not measured."""
    if values is None:
        return [None] * count
    return [(x, y, z) if np.isfinite((x, y, z)).all() else None for x, y, z in values.tolist()]
