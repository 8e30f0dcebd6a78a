"""Settings of repeat visits; torch-free."""

from dataclasses import dataclass
from typing import Annotated

from swimm3r.scale.settings import MarkerFamily
from swimm3r.settings import Count, Positive, Range, Settings


@dataclass(frozen=True)
class VisitSettings(Settings):
    """Several dives of one site in one frame, and the changes between them."""

    gsd: Positive | None = None
    """Side of a map cell in the unit of the first run; by default two pixels on the ground."""
    threshold: Annotated[float, Range(1, 20)] = 3.0
    """Standard deviations from which a change is significant."""
    min_area: Positive | None = None
    """Least area of a changed place, in the square of gsd's unit; 40 cells by default."""
    min_height: Annotated[float, Range(0, 1e6)] = 0.0
    """Least change of height that is reported, in the unit of gsd, in addition to the threshold."""
    min_color: Annotated[float, Range(0, 200)] = 6.0
    """Least change of the clear color that is reported, as a CIELAB difference, in addition to the threshold."""
    candidates: Count = 8
    """Number of the most similar frames of the other visit that a frame is matched with."""
    markers: MarkerFamily | None = None
    """Family of coded markers that stay on the site: the same ones at two visits are points that both share."""
    matched_frames: Annotated[int, Range(2)] = 400
    """Largest number of frames of a visit that are matched with another one, spread evenly."""
