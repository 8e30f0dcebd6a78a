"""Every number of a synthetic dive; torch-free, so that --help is instant."""

from dataclasses import dataclass
from typing import Literal

from swimm3r.errors import UsageError


def _require(holds: bool, expected: str) -> None:
    if not holds:
        raise UsageError(expected, cause="a setting of the synthetic dive is out of range", hint="see `--help`")


@dataclass(frozen=True)
class Coefficients:
    """A given water, per RGB channel, on pixel values as stored."""

    Binf: tuple[float, float, float] = (0.09, 0.53, 0.52)
    """veiling light, 0..1"""
    beta_D: tuple[float, float, float] = (0.48, 0.15, 0.12)
    """attenuation of the scene's light, 1/m of ray depth"""
    beta_B: tuple[float, float, float] = (0.36, 0.26, 0.24)
    """build-up of backscatter, 1/m of ray depth"""

    def __post_init__(self) -> None:
        _require(all(0 <= v <= 1 for v in self.Binf), f"Binf lies in 0..1, got {self.Binf}")
        for name in ("beta_D", "beta_B"):
            _require(min(getattr(self, name)) >= 0, f"{name} is not negative, got {getattr(self, name)}")


@dataclass(frozen=True)
class DiveSettings:
    """A synthetic dive over a procedural seafloor."""

    frames: int = 32
    width: int = 480
    height: int = 320
    fov: float = 56.0
    """horizontal field of view, degrees"""
    seed: int = 0
    """decides seafloor, path, water and disturbances"""
    family: Literal["cyan", "teal", "green", "warm"] | None = None
    """draw the water from one of the paper's families instead of using `coefficients`"""
    coefficients: Coefficients = Coefficients()
    caustics: float = 0.0
    """strength of the moving light pattern; 0.5 is a bright day in 3 m of water"""
    marine_snow: int = 0
    """drifting particles in the view of one frame"""
    noise: float = 0.004
    """standard deviation of the sensor's noise, pixel values 0..1"""
    vignetting: float = 0.0
    """light lost in the corners, 0..1"""
    moving_object: bool = False
    """a fish swims across, once during the dive"""
    give_masks: bool = False
    """put the moving object's masks beside images/ for the pipeline to use, not only under truth/"""

    def __post_init__(self) -> None:
        _require(self.frames >= 1, f"a dive has at least 1 frame, got {self.frames}")
        _require(
            min(self.width, self.height) >= 8, f"pictures have 8 x 8 pixels or more, got {self.width} x {self.height}"
        )
        _require(10 <= self.fov <= 120, f"the field of view lies in 10..120 degrees, got {self.fov}")
        _require(self.seed >= 0, f"a seed is not negative, got {self.seed}")
        for name in ("caustics", "marine_snow", "noise"):
            _require(getattr(self, name) >= 0, f"{name} is not negative, got {getattr(self, name)}")
        _require(0 <= self.vignetting <= 1, f"vignetting lies in 0..1, got {self.vignetting}")
