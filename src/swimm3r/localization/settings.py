"""Every number of localisation in a map; torch-free."""

from dataclasses import dataclass, field
from typing import Literal

from swimm3r.sfm.mast3r.settings import MatchingSettings
from swimm3r.sfm.settings import FeatureSettings


@dataclass(frozen=True)
class LocalizationSettings:
    """A query picture placed in a map, as the paper does it after GS-CPR."""

    matcher: Literal["auto", "mast3r", "sift"] = "auto"
    """What finds matches; auto takes MASt3R where its weights are on this computer."""
    candidates: int = 5
    """Reference pictures that the query is matched with for its coarse pose."""
    rounds: int = 1
    """Times that the map is rendered and matched; GS-CPR does it once."""
    max_error: float = 5.0
    """Reprojection error of an inlier, pixels of the query."""
    min_inliers: int = 12
    """Matches that agree on a pose before it is believed."""
    border: int = 3
    """Matches this near to the border of the rendering do not count, pixels."""
    min_alpha: float = 0.5
    """Coverage of the rendering below which a pixel has no depth to trust."""
    long_side: int = 0
    """Longer side of the rendering, pixels; 0 is the size that the map was trained at."""
    features: FeatureSettings = field(default_factory=FeatureSettings)
    matching: MatchingSettings = field(default_factory=MatchingSettings)
