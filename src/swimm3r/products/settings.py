"""Settings of map products; torch-free."""

from dataclasses import dataclass
from typing import Annotated

from swimm3r.settings import Count, Positive, Range, Settings


@dataclass(frozen=True)
class ProductSettings(Settings):
    """Maps of a run from above."""

    gsd: Positive | None = None
    """Side of a map cell in meters (units of the run where its scale is unknown); by default that of a frame's pixel
    on the ground."""
    min_views: Count = 1
    """Least number of depth maps that show a cell; cells with fewer stay holes."""
    tile: Annotated[int, Range(64, 8192)] = 1024
    """Side in cells of the tiles that maps are made in; memory grows with it."""
