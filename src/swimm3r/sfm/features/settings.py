"""Numbers of SIFT and its matching, each with its reason; torch-free."""

from dataclasses import dataclass
from typing import Annotated

from swimm3r.settings import LongSide, PositiveShare, Range, Settings


@dataclass(frozen=True)
class FeatureSettings(Settings):
    """SIFT and its matching (`sfm/features/sift.py`)."""

    count: Annotated[int, Range(1, 1_000_000)] = 2048
    """Largest number of keypoints per frame; one with two orientations counts once."""
    peak_threshold: PositiveShare = 0.003
    """Smallest contrast of a keypoint, of 1; hazy images need less than COLMAP's 0.0067."""
    faint_threshold: PositiveShare = 0.001
    """Smallest contrast of a keypoint in frames that yield fewer than `count` with `peak_threshold`."""
    equalize: Annotated[float, Range(0, 1000)] = 0.0
    """Clip limit of the local contrast equalization (CLAHE) before detection; 0 leaves images unchanged."""
    long_side: LongSide = 1000
    """Longer side in pixels to which larger frames are reduced for detection."""
    max_ratio: PositiveShare = 0.8
    """Largest ratio of the nearest to the second nearest descriptor distance (angles) of a match."""
