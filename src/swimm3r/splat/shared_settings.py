"""The settings of what several recipes share: a field of water, and poses refined with the map; torch-free."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from swimm3r.imaging.settings import AppearanceSettings
from swimm3r.settings import Cadence, Count, LongSideOrOwn, NotNegative, Positive, Range, Rate, Seed, Settings, Share

DILATION = 0.3
"""Variance, pixels^2, that 3DGS and UBS add to every primitive on the image plane."""


@dataclass(frozen=True)
class MediumFieldSettings(Settings):
    """The ambient field A_phi of Eq. 10."""

    model: Literal["network", "none"] = "network"
    """Model of the medium: a network of the viewing direction (Eq. 10), or none, for Beta splatting without water
    (UBS)."""
    layers: Annotated[int, Range(0, 16)] = 2
    """Number of hidden layers of the medium field."""
    hidden: Annotated[int, Range(1, 4096)] = 128  # WaterSplatting's width
    """Width of the hidden layers of the medium field."""
    activation: Literal["relu", "sigmoid"] = "relu"
    """Activation of the hidden layers (sigmoid in WaterSplatting)."""
    biases: bool = True
    """Use biases in the layers of the medium field."""
    frequencies: Annotated[int, Range(1, 16)] = 8
    """Number of octaves of the clip's time at the input of gamma(t), in dynamic maps."""
    time_features: Annotated[int, Range(1, 1024)] = 16
    """Number of outputs of the time embedding gamma(t)."""
    stride: Annotated[int, Range(1, 1024)] = 8
    """Pixels between the directions at which the field is evaluated; values between them are interpolated."""
    prior: Annotated[float, Range(0, 100)] = 0.3
    """Initial beta per working unit, if the reconstruction has no medium."""
    begin: Share = 0.1
    """Share of the run before which the medium stays that of the reconstruction."""
    least_std: Annotated[float, Range(1e-6, 100)] = 0.05
    """Smallest standard deviation of the prior from the reconstruction's medium: relative for betas, in pixel values
    for Binf."""


@dataclass(frozen=True)
class TrainingPoseSettings(Settings):
    """Refinement of the training poses along with the map (3R-GS's module and values)."""

    enabled: bool = True
    """Refine the training poses along with the map."""
    width: Annotated[int, Range(1, 4096)] = 64
    """Width of a camera's code and of the network's hidden layers."""
    rate: Rate = 1.5e-4
    """Learning rate of Adam for codes and network over 20,000 steps; shorter runs use a larger one, up to
    `largest_rate`."""
    largest_rate: Rate = 2e-3
    """Largest learning rate that short runs use for codes and network."""
    epipolar: NotNegative = 2.0
    """Weight of the matches' epipolar error in pixels."""
    epipolar_end: Share = 0.15
    """Share of the run after which the epipolar error is left out."""
    matches: Count = 4096
    """Number of matches per step, drawn anew in each."""


@dataclass(frozen=True)
class MapAppearanceSettings(AppearanceSettings):
    """Exposure and white balance of single frames in training (`splat/appearance.py`)."""

    refits: Annotated[int, Range(0, 100)] = 3
    """Number of times that the maps are fitted again during training, evenly spaced over its second part."""


@dataclass(frozen=True)
class MapSettings(Settings):
    """Settings that all recipes share: length and image size of a training, and its record."""

    iterations: Count = 20_000
    """Number of training steps, one image each."""
    long_side: LongSideOrOwn = 1600
    """Longer side of the training images in pixels; images are never enlarged."""
    working_depth: Annotated[float, Range(1e-3, 1e6)] = 3.0
    """Median depth, in working units, that a scene without metric scale is scaled to for training."""
    full_area: Positive = 12.0
    """Ground that `initial.primitives` and `densify.cap_max` are for, in the area that one image shows at the median
    depth. More ground has primitives in proportion, up to that of a block (`blocks.largest`)."""
    poses: TrainingPoseSettings = field(default_factory=TrainingPoseSettings)
    appearance: MapAppearanceSettings = field(default_factory=MapAppearanceSettings)
    seed: Seed = 0
    """Seed of the random number generator."""
    log_every: Cadence = 0.005
    """Share of the run between two rows of metrics.jsonl."""
    checkpoint_every: Cadence = 0.1
    """Share of the run between two checkpoints that an interrupted training resumes from."""


@dataclass(frozen=True)
class RefineSettings(Settings):
    """Rounds of densification (`splat/densify/schedule.py`)."""

    refine_start: Share = 0.025  # 500 of 20,000
    """Share of the run before the first densification round."""
    refine_stop: Share = 0.5  # 10,000 of 20,000
    """Share of the run after which densification ends."""
    refine_every: Cadence = 0.005  # 100 of 20,000
    """Share of the run between two densification rounds."""
    min_refine_every: Count = 20
    """Fewest steps between two densification rounds, whatever `refine_every` says; growth is scaled to make up for it.
    """
