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
    """veiling light, 0..1"""
    beta_D: tuple[_Beta, _Beta, _Beta] = (0.48, 0.15, 0.12)
    """attenuation of the scene's light, 1/m of ray depth"""
    beta_B: tuple[_Beta, _Beta, _Beta] = (0.36, 0.26, 0.24)
    """build-up of backscatter, 1/m of ray depth"""


@dataclass(frozen=True)
class DiveSettings(Settings):
    """A synthetic dive over a procedural seafloor."""

    frames: Annotated[int, Range(1, 10_000)] = 32
    width: _Pixels = 480
    height: _Pixels = 320
    fov: Annotated[float, Range(10, 120)] = 56.0
    """horizontal field of view, degrees"""
    seed: Seed = 0
    """decides seafloor, path, water and disturbances"""
    family: Literal["cyan", "teal", "green", "warm"] | None = None
    """draw the water from one of the paper's families instead of using `coefficients`"""
    coefficients: Coefficients = Coefficients()
    caustics: Annotated[float, Range(0, 10)] = 0.0
    """strength of the moving light pattern; 0.5 is a bright day in 3 m of water"""
    marine_snow: Annotated[int, Range(0, 100_000)] = 0
    """drifting particles in the view of one frame"""
    noise: Share = 0.004
    """standard deviation of the sensor's noise, pixel values 0..1"""
    vignetting: Share = 0.0
    """light lost in the corners, 0..1"""
    moving_object: bool = False
    """a fish swims across, once during the dive"""
    give_masks: bool = False
    """put the moving object's masks beside images/ for the pipeline to use, not only under truth/"""
