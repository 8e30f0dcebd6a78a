"""Every number of the pairing of shots; torch-free, so that --help is instant."""

from dataclasses import dataclass
from typing import Annotated

from swimm3r.settings import Count, CountOrZero, NotEmpty, Positive, Settings, Share


@dataclass(frozen=True)
class PairSettings(Settings):
    """Which two shots of a sequence are shown together."""

    min_overlap: Share = 0.3
    """Share of the depth of each shot that the other must see, where metric poses and depth tell."""
    max_overlap: Share = 0.95
    """More alike than this a pair teaches nothing about motion."""
    reach: Count = 40
    """Shots farther apart in the sequence than this are not tried."""
    gaps_s: Annotated[tuple[Positive, ...], NotEmpty()] = (0.5, 1.0, 2.0)
    """Seconds between the two where only time tells; a diver still sees half of the scene."""
    steps: Annotated[tuple[Count, ...], NotEmpty()] = (1, 2, 4)
    """Shots between the two where not even time tells."""
    per_shot: Count = 4
    """Most partners of a shot among the later ones."""
    retrieved: CountOrZero = 0
    """Where poses do not tell: partners per shot beyond `reach` that look alike to the network; it encodes every shot
    once for it, before training."""
