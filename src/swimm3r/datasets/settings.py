"""Every number of the pairing of shots; torch-free, so that --help is instant."""

from dataclasses import dataclass
from typing import Annotated

from swimm3r.settings import Count, CountOrZero, NotEmpty, Positive, Settings, Share


@dataclass(frozen=True)
class PairSettings(Settings):
    """Selection of the two shots of a training pair."""

    min_overlap: Share = 0.3
    """Smallest share of each shot's depth that the other shot must see, if poses and depth are metric."""
    max_overlap: Share = 0.95
    """Largest share of each shot's depth that the other shot may see."""
    reach: Count = 40
    """Largest distance in the sequence between two shots of a pair."""
    gaps_s: Annotated[tuple[Positive, ...], NotEmpty()] = (0.5, 1.0, 2.0)
    """Seconds between the two shots, if only times are known."""
    steps: Annotated[tuple[Count, ...], NotEmpty()] = (1, 2, 4)
    """Shots between the two, if neither poses nor times are known."""
    per_shot: Count = 4
    """Largest number of later partners of a shot."""
    retrieved: CountOrZero = 0
    """Number of partners per shot beyond `reach` that the network finds similar, if poses are unknown; every shot is
    encoded once before training."""
