"""Every number of localization in a map; torch-free."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from swimm3r.settings import (
    Count,
    CountOrZero,
    LongSide,
    LongSideOrOwn,
    Positive,
    PositiveShare,
    Range,
    Settings,
    Share,
)
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.mast3r.settings import MatchingSettings
from swimm3r.sfm.settings import Mast3rSettings, SfmSettings


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


@dataclass(frozen=True)
class TrackingSettings(Settings):
    """Localization of a stream of images: when a pose is one, and where the next is searched for."""

    keypoints: Annotated[int, Range(50, 100_000)] = 1000
    """Largest number of keypoints per image."""
    image_side: LongSide = 640
    """Longer side in pixels to which larger images are reduced for detection."""
    map_frames: Count = 4
    """Number of map frames whose landmarks are matched with an image."""
    radius: PositiveShare = 0.05
    """Distance between the predicted and the found pixel of a landmark, at most, as a share of the longer side."""
    agreement: Positive = 4.0
    """Largest reprojection error of an inlier, in pixels of the reduced image."""
    least_inliers: Annotated[int, Range(6)] = 20
    """Smallest number of landmarks that agree on a pose."""
    least_share: Share = 0.5
    """Smallest share of the matches that agree on a pose."""
    least_seen: Share = 0.04
    """Smallest share of the landmarks in view, or of the keypoints where they are fewer, that agree on a pose."""
    most_turn_error: Positive = 1.0
    """Largest standard error of a pose's direction, in degrees."""
    most_shift_error: Positive = 0.03
    """Largest standard error of a camera's place, as a share of the map's median distance from its cameras."""
    most_speed: Positive = 1.0
    """Largest speed of the camera, in median distances of the map per second."""
    most_turn_rate: Positive = 120.0
    """Largest turn rate of the camera, in degrees per second."""


@dataclass(frozen=True)
class StreamSettings(Settings):
    """The images of a stream: those of a folder, a video or a bag."""

    fps: Annotated[float, Range(0, 1000)] = 0.0
    """Images per second that are localized; 0 takes every image."""
    follow: bool = False
    """Wait for further images of a folder that is being written, until Ctrl-C."""
    idle: Annotated[float, Range(0, 1e6)] = 0.0
    """Seconds without a new image after which a followed folder is finished; 0 waits for ever."""
    latest: bool = False
    """Skip images of a followed folder while a newer one is there."""
    topic: str | None = None
    """Topic of images of a ROS bag that holds several cameras; `swimm3r topics BAG` lists them."""
    stamps: Literal["header", "received"] = "header"
    """Times of a bag's images: those of their headers, or those at which they were recorded."""


GS_CPR = LocalizationSettings(accept="inliers")
"""The protocol as published, which the tables are taken by."""


def with_checkpoint_of(settings: LocalizationSettings, sfm: SfmSettings) -> LocalizationSettings:
    """The settings with the checkpoint that found a run's poses, unless they name their own."""
    if settings.weights is None and isinstance(sfm, Mast3rSettings):
        return replace(settings, weights=sfm.weights)
    return settings
