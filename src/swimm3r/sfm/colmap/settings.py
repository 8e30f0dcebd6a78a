"""Numbers of COLMAP's mapping, each with its reason; torch-free."""

from dataclasses import dataclass
from typing import Annotated, Literal

from swimm3r.errors import UsageError
from swimm3r.settings import CountOrZero, NotEmpty, PositiveShare, Range, Settings, Share


@dataclass(frozen=True)
class MappingSettings(Settings):
    """From verified matches to cameras and points (`sfm/colmap/mapping.py`)."""

    method: Literal["auto", "incremental", "global"] = "auto"
    """Mapper of a clip or a chunk: incremental, global (GLOMAP), or both and the better result (auto)."""
    chunk_frames: Annotated[int, Range(8)] = 48
    """Largest number of frames of a chunk; `auto` maps clips with more than twice as many in chunks that are joined."""
    chunk_overlap: Annotated[int, Range(2)] = 8
    """Number of frames that neighboring chunks share, less than a chunk has."""
    focal_ladder: Annotated[tuple[Annotated[float, Range(0.1, 20)], ...], NotEmpty()] = (0.75, 1.1, 0.6, 1.5)
    """Focal lengths, as multiples of the image width, tried in turn if the lens is unknown and frames are not
    registered."""
    k1: Annotated[float, Range(-1, 1)] = 0.03
    """Radial distortion that the trials of focal lengths start from."""
    enough: Share = 1.0
    """Share of registered frames at which no further focal lengths are tried."""
    retry_ratio: PositiveShare = 0.9
    """Ratio test of the second matching of frames that were not registered."""
    align_keypoints: bool = True
    """Move keypoints to where the patches of the images agree before the last adjustment."""
    navigation: bool = True
    """Use the navigation that is given (`--nav`): its positions as priors of those of the cameras, and to join parts
    that share no ground."""
    min_frames: Annotated[int, Range(2)] = 3
    """Smallest number of registered frames of a result."""
    min_share: Share = 0.2
    """Smallest share of registered frames of a result."""
    thin_points: CountOrZero = 150
    """Mean number of points per frame below which a model may be a passing animal; it is refused unless it holds
    `thin_share` of the frames."""
    thin_share: Share = 0.6
    """Share of the frames from which a model with few points is accepted."""
    opencv_gain: Share = 0.03
    """Relative decrease of the reprojection error from which camera `auto` compares lenses on frames that they were not
    fitted to, and by which one with more freedom must be better there."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.chunk_overlap >= self.chunk_frames:
            raise UsageError(
                f"chunks of {self.chunk_frames} frames cannot share {self.chunk_overlap}",
                cause="--mapping.chunk-overlap is not smaller than --mapping.chunk-frames",
                hint="a smaller overlap, such as a sixth of a chunk, or larger chunks",
            )
