"""The white balance of a dive, one for every image, cloud and map that people look at.

    shown = clip(gains * clear, 0, 1)    on pixel values as stored

The gains hold a common one, too, by which bright surfaces stay below white (`sfm.medium.restore.within_white`).
white_balance.json in RUN/sfm holds it. Scores and physics use the colors before it.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.damage import Remedy
from swimm3r.io.files.json_file import read_json

WHITE_BALANCE = "white_balance.json"
BRIGHTEST = 2.0
"""Times white: clear colors up to it are told apart, as the common gain of a balance is 0.5 at least."""

_MOST = 10.0  # gain; no balance of this package comes near it


@dataclass(frozen=True)
class WhiteBalance:
    """Gains of red, green and blue. Raises ValueError where they are no gains."""

    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)
    source: Literal["restored", "filmed"] = "restored"
    """Colors that are shown: the clear ones, or, where the daylight lost in the water is a guess, those filmed."""

    def __post_init__(self) -> None:
        if not all(0 < gain <= _MOST for gain in self.gains):
            raise ValueError(f"gains are above 0 and at most {_MOST:g}, got {list(self.gains)}")

    @property
    def factors(self) -> Float[Tensor, "3"]:
        """The gains as a tensor."""
        return torch.tensor(self.gains)

    def shown(
        self, clear: Float[Tensor, "*pixels 3"], filmed: Float[Tensor, "*pixels 3"]
    ) -> Float[Tensor, "*pixels 3"]:
        """Colors of surfaces as people see them."""
        return filmed if self.source == "filmed" else (clear * self.factors).clamp(0, 1)

    def save(self, path: Path) -> None:
        """Write a white_balance.json, whole or not at all."""
        write_text(path, json.dumps(asdict(self), indent=2) + "\n")


UNBALANCED = WhiteBalance()


def read_white_balance(path: Path, remedy: Remedy) -> WhiteBalance:
    """Read what `WhiteBalance.save` wrote. Raises the remedy's error, which names the file and the fault."""
    return read_json(path, WhiteBalance, remedy)
