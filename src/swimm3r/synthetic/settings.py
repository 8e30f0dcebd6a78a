"""Every number of a synthetic dive; torch-free, so that --help is instant."""

from dataclasses import dataclass
from typing import Annotated, Literal

from swimm3r.settings import Range, Seed, Settings, Share

_Beta = Annotated[float, Range(0, 100)]
_Pixels = Annotated[int, Range(8, 8192)]


@dataclass(frozen=True)
class Coefficients(Settings):
    """A given water, per RGB channel, on pixel values as stored."""

    Binf: tuple[Share, Share, Share] = (0.09, 0.53, 0.52)
    """Veiling light of the open water, 0..1 per channel."""
    beta_D: tuple[_Beta, _Beta, _Beta] = (0.48, 0.15, 0.12)
    """Attenuation of the scene's light per channel, 1/m of ray depth."""
    beta_B: tuple[_Beta, _Beta, _Beta] = (0.36, 0.26, 0.24)
    """Build-up of backscatter per channel, 1/m of ray depth."""


@dataclass(frozen=True)
class DiveSettings(Settings):
    """A synthetic dive over a procedural seafloor."""

    frames: Annotated[int, Range(1, 10_000)] = 32
    """Number of frames of the dive."""
    width: _Pixels = 480
    """Width of the frames in pixels."""
    height: _Pixels = 320
    """Height of the frames in pixels."""
    fov: Annotated[float, Range(10, 120)] = 56.0
    """Horizontal field of view in degrees."""
    seed: Seed = 0
    """Seed of seafloor, path, water and disturbances."""
    family: Literal["cyan", "teal", "green", "warm"] | None = None
    """Family of the paper's water types to draw from, instead of `coefficients`."""
    coefficients: Coefficients = Coefficients()
    caustics: Annotated[float, Range(0, 10)] = 0.0
    """Strength of the moving light pattern; 0.5 is a bright day in 3 m of water."""
    marine_snow: Annotated[int, Range(0, 100_000)] = 0
    """Number of drifting particles in the view of one frame."""
    noise: Share = 0.004
    """Standard deviation of the sensor noise, in pixel values 0..1."""
    vignetting: Share = 0.0
    """Share of light lost in the corners of the image."""
    moving_object: bool = False
    """Let a fish swim across the view once during the dive."""
    give_masks: bool = False
    """Write the masks of the moving object beside images/, where the pipeline uses them, not only under truth/."""
