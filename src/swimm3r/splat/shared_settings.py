"""The settings of what several recipes share: a field of water, and poses refined with the map; torch-free."""

from dataclasses import dataclass
from typing import Annotated, Literal

from swimm3r.settings import Count, NotNegative, Range, Rate, Settings, Share

RecipeName = Literal["uwbs-static", "uwbs-dynamic", "ubs", "watersplatting", "seasplat", "threers_gs", "mcmc_gs"]


@dataclass(frozen=True)
class MediumFieldSettings(Settings):
    """The ambient field A_phi of Eq. 10."""

    model: Literal["network", "none"] = "network"
    """none is clear water before black: Beta splatting without the underwater part (UBS)."""
    layers: Annotated[int, Range(0, 16)] = 2
    """Hidden ones."""
    hidden: Annotated[int, Range(1, 4096)] = 128  # WaterSplatting's width
    activation: Literal["relu", "sigmoid"] = "relu"
    """Of hidden layers; sigmoid as WaterSplatting has it."""
    biases: bool = True
    frequencies: Annotated[int, Range(1, 16)] = 8
    """Octaves of the clip's time that gamma(t) begins with, in dynamic maps."""
    time_features: Annotated[int, Range(1, 1024)] = 16
    """Width of gamma(t)."""
    stride: Annotated[int, Range(1, 1024)] = 8
    """Pixels between the directions at which the field is evaluated; between them its maps are interpolated."""
    prior: Annotated[float, Range(0, 100)] = 0.3
    """Beta per working unit where the reconstruction has no medium."""
    begin: Share = 0.1
    """Share of the run before which the water stays the reconstruction's: it learns so much faster than the primitives
    that it would explain their first transparency."""
    least_std: Annotated[float, Range(1e-6, 100)] = 0.05
    """The reconstruction's water is not held tighter than this: betas relative, Binf in pixel values."""


@dataclass(frozen=True)
class TrainingPoseSettings(Settings):
    """The training frames' poses, refined with the map (3R-GS's module and values)."""

    enabled: bool = True
    width: Annotated[int, Range(1, 4096)] = 64
    """Of a camera's code and of the network's hidden layers."""
    rate: Rate = 1.5e-4
    """Of Adam, for codes and network, in 20,000 steps; shorter runs step as much farther, up to `largest_rate`."""
    largest_rate: Rate = 2e-3
    epipolar: NotNegative = 2.0
    """Weight of the matches' epipolar error, pixels."""
    epipolar_end: Share = 0.15
    """Share of the run after which the matches are left out."""
    matches: Count = 4096
    """Matches per step, drawn anew each time; 3R-GS takes every twentieth of all."""
