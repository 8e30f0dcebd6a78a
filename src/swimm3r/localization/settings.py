"""Every number of localization in a map; torch-free."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from swimm3r.settings import Count, CountOrZero, LongSideOrOwn, Positive, Range, Settings, Share
from swimm3r.sfm.mast3r.settings import MatchingSettings
from swimm3r.sfm.settings import FeatureSettings, Mast3rSettings, SfmSettings


@dataclass(frozen=True)
class LocalizationSettings(Settings):
    """Localization of a query image in a map, as the paper does it after GS-CPR."""

    matcher: Literal["auto", "mast3r", "sift"] = "auto"
    """Feature matcher; auto uses MASt3R if its weights are present, otherwise SIFT."""
    weights: Path | None = None
    """MASt3R checkpoint; by default the one that found the run's poses, or that `swimm3r weights path mast3r` prints.
    """
    device: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Device that MASt3R runs on; auto uses a GPU if one is present."""
    precision: Literal["float32", "bfloat16", "float16"] = "float32"
    """Number format of MASt3R's trunk; its heads always use float32."""
    candidates: Count = 5
    """Number of reference images that the query is matched with for its coarse pose."""
    rounds: Annotated[int, Range(0, 100)] = 1
    """Number of times that the map is rendered and matched (1 in GS-CPR)."""
    max_error: Positive = 5.0
    """Largest reprojection error of an inlier, in pixels of the query."""
    min_inliers: Annotated[int, Range(4)] = 12
    """Smallest number of matches that agree on a pose."""
    accept: Literal["more_certain", "inliers"] = "more_certain"
    """Rule that replaces the coarse pose by the refined one: enough inliers, as in GS-CPR (inliers), or also a smaller
    standard error (more_certain)."""
    border: CountOrZero = 3
    """Distance in pixels from the edge of the rendering within which matches are dropped."""
    min_alpha: Share = 0.5
    """Smallest coverage of a rendered pixel whose depth is used."""
    long_side: LongSideOrOwn = 0
    """Longer side of the rendering in pixels; 0 is the size that the map was trained at."""
    features: FeatureSettings = field(default_factory=FeatureSettings)
    matching: MatchingSettings = field(default_factory=MatchingSettings)


GS_CPR = LocalizationSettings(accept="inliers")
"""The protocol as published, which the tables are taken by."""


def with_checkpoint_of(settings: LocalizationSettings, sfm: SfmSettings) -> LocalizationSettings:
    """The settings with the checkpoint that found a run's poses, unless they name their own."""
    if settings.weights is None and isinstance(sfm, Mast3rSettings):
        return replace(settings, weights=sfm.weights)
    return settings
