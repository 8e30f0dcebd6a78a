"""Up in every frame of a video whose camera measured gravity."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from swimm3r.io.telemetry.gravity import up_of_images
from swimm3r.prepare.candidates import SourceImage


def with_up(images: Sequence[SourceImage], video: Path) -> list[SourceImage]:
    """The images with the direction away from the earth; as they were where the video has none."""
    ups = up_of_images(video, [image.time for image in images])
    if ups is None:
        return list(images)
    known = [bool(np.isfinite(up).all()) for up in ups]
    return [
        replace(image, up=(float(up[0]), float(up[1]), float(up[2]))) if there else image
        for image, up, there in zip(images, ups, known, strict=True)
    ]
