"""Every number of localization in a map; torch-free."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from swimm3r.settings import Count, CountOrZero, LongSideOrOwn, Positive, Range, Settings, Share
from swimm3r.sfm.mast3r.settings import MatchingSettings
from swimm3r.sfm.settings import FeatureSettings, Mast3rSettings, SfmSettings


@dataclass(frozen=True)
class LocalizationSettings(Settings):
    """A query image placed in a map, as the paper does it after GS-CPR."""

    matcher: Literal["auto", "mast3r", "sift"] = "auto"
    """What finds matches; auto takes MASt3R where its weights are on this computer."""
    weights: Path | None = None
    """MASt3R's checkpoint; else the one that found the run's poses, or that `swimm3r weights path mast3r` prints."""
    device: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Where MASt3R runs."""
    precision: Literal["float32", "bfloat16", "float16"] = "float32"
    """Of MASt3R's trunk; its heads are always float32."""
    candidates: Count = 5
    """Reference images that the query is matched with for its coarse pose."""
    rounds: Annotated[int, Range(0, 100)] = 1
    """Times that the map is rendered and matched; GS-CPR does it once."""
    max_error: Positive = 5.0
    """Reprojection error of an inlier, pixels of the query."""
    min_inliers: Annotated[int, Range(4)] = 12
    """Matches that agree on a pose before it is believed."""
    accept: Literal["more_certain", "inliers"] = "more_certain"
    """When the refined pose replaces the coarse one: inliers, as in GS-CPR, from min_inliers on; more_certain also
    requires a smaller standard error, by the residuals and the geometry of each pose's own inliers."""
    border: CountOrZero = 3
    """Matches this near to the border of the rendering do not count, pixels."""
    min_alpha: Share = 0.5
    """Coverage of the rendering below which a pixel has no depth to trust."""
    long_side: LongSideOrOwn = 0
    """Longer side of the rendering, pixels; 0 is the size that the map was trained at."""
    features: FeatureSettings = field(default_factory=FeatureSettings)
    matching: MatchingSettings = field(default_factory=MatchingSettings)


GS_CPR = LocalizationSettings(accept="inliers")
"""The protocol as published, which the tables are taken by."""


def with_checkpoint_of(settings: LocalizationSettings, sfm: SfmSettings) -> LocalizationSettings:
    """The settings with the checkpoint that found a run's poses, unless they name their own."""
    if settings.weights is None and isinstance(sfm, Mast3rSettings):
        return replace(settings, weights=sfm.weights)
    return settings
