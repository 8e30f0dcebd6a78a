"""Every number of a port; torch-free, so that --help is instant."""

from dataclasses import dataclass
from typing import Annotated, Literal

from swimm3r.settings import Positive, Range, Settings

HousingKind = Literal["none", "flat", "dome"]

_Index = Annotated[float, Range(1, 3)]
_FLAT_DISTANCE = 0.01  # meters; action cameras have their lens right behind the glass


@dataclass(frozen=True)
class PortSettings(Settings):
    """The port of a camera housing, perpendicular to the optical axis or centered on it, and what it dives into."""

    distance: Annotated[float, Range(0, 1)] | None = None
    """Distance in meters from the lens's entrance pupil to the inner surface of the port; by default 0.01 of a flat
    port, and the radius of a dome, whose center the pupil then is."""
    thickness: Annotated[float, Range(0, 0.2)] = 0.003
    """Thickness of the port in meters."""
    radius: Annotated[float, Range(above=0, most=2)] = 0.05
    """Inner radius of a dome in meters."""
    glass: _Index = 1.49
    """Refractive index of the port: 1.49 of acrylic, 1.52 of glass, 1.77 of sapphire."""
    water: _Index = 1.333
    """Refractive index of the water: 1.333 of fresh water, 1.34 of sea water."""
    range: Positive = 1.5
    """Typical distance of the scene in meters. It gives the reconstruction of a lens behind a port its scale, unless
    that is known, and the central lens is exact there."""

    def distance_of(self, housing: HousingKind) -> float:
        """The distance from pupil to port in meters, or its default for a kind of housing."""
        if self.distance is not None:
            return self.distance
        return self.radius if housing == "dome" else _FLAT_DISTANCE
