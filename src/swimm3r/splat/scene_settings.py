"""The settings of what several recipes share: a field of water, and poses refined with the map; torch-free."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class MediumFieldSettings:
    """The ambient field A_phi of Eq. ambient_medium."""

    model: Literal["network", "none"] = "network"
    """none is clear water before black: Beta splatting without the underwater part (UBS)."""
    layers: int = 2
    """Hidden ones."""
    hidden: int = 128  # WaterSplatting's width
    activation: Literal["relu", "sigmoid"] = "relu"
    """Of hidden layers; sigmoid as WaterSplatting has it."""
    biases: bool = True
    frequencies: int = 8
    """Octaves of the clip's time that gamma(t) begins with, in dynamic maps."""
    time_features: int = 16
    """Width of gamma(t)."""
    stride: int = 8
    """Pixels between the directions at which the field is evaluated; between them its maps are interpolated."""
    prior: float = 0.3
    """Beta per working unit where the reconstruction has no medium."""
    begin: float = 0.1
    """Share of the run before which the water stays the reconstruction's: it learns so much faster than the primitives
    that it would explain their first transparency."""
    least_std: float = 0.05
    """The reconstruction's water is not held tighter than this: betas relative, Binf in pixel values."""


@dataclass(frozen=True)
class TrainingPoseSettings:
    """The training frames' poses, refined with the map (3R-GS's module and values)."""

    enabled: bool = True
    width: int = 64
    """Of a camera's code and of the network's hidden layers."""
    rate: float = 1.5e-4
    """Of Adam, for codes and network, in 20,000 steps; shorter runs step as much farther, up to `largest_rate`."""
    largest_rate: float = 2e-3
    epipolar: float = 2.0
    """Weight of the matches' epipolar error, pixels."""
    epipolar_end: float = 0.15
    """Share of the run after which the matches are left out."""
    matches: int = 4096
    """Matches per step, drawn anew each time; 3R-GS takes every twentieth of all."""
