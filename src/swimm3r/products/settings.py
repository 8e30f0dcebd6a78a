"""Settings of map products; torch-free."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from swimm3r.settings import Count, Positive, Range, Settings


@dataclass(frozen=True)
class ProductSettings(Settings):
    """Maps of a run from above, habitat figures, mesh and cloud."""

    gsd: Positive | None = None
    """Side of a map cell in meters (units of the run where its scale is unknown); by default that of a frame's pixel
    on the ground."""
    min_views: Count = 1
    """Least number of depth maps that show a cell; cells with fewer stay holes."""
    areas: Path | None = None
    """GeoJSON file with polygons to give habitat figures for, and lines to take profiles along."""
    habitat_cell: Positive | None = None
    """Side of the squares that habitat figures are given for, in the unit of gsd; 1 m, or 256 cells of a run without
    scale, by default."""
    habitat_resolution: Positive | None = None
    """Distance of the heights that habitat figures are computed from, in the unit of gsd; 1 cm, or 5 cells where that
    is more, by default."""
    mesh: bool = True
    """Make a textured mesh."""
    mesh_spacing: Positive | None = None
    """Side of the mesh's smallest triangles, in the unit of gsd; 4 cells by default."""
    cloud: bool = True
    """Write the dense cloud with normals as PLY and LAZ."""
    tile: Annotated[int, Range(64, 8192)] = 1024
    """Side in cells of the tiles that maps are made in; memory grows with it."""
