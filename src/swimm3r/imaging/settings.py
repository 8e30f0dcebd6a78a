"""The settings of what images show; torch-free."""

from dataclasses import dataclass
from typing import Literal

from swimm3r.settings import Settings, Share


@dataclass(frozen=True)
class AppearanceSettings(Settings):
    """Exposure and white balance of single frames (`imaging/appearance.py`)."""

    mode: Literal["auto", "on", "off"] = "auto"
    """Give every frame an affine color map of its own, the identity on average: always, never, or where the sparse
    points say that frames differ in more than their distances (auto)."""
    least_explained: Share = 0.2
    """Smallest share that frames must explain of the variation that the water leaves, with `auto`."""
    least_recorded: Share = 0.05
    """Share of that variation from which the exposure and white balance that the camera recorded are enough, with
    `auto`: but for one slope of the tone curve, nothing is fitted to them."""
    least_change: Share = 0.006
    """Smallest change of colors, in pixel values, that frames must explain, with `auto`."""
    shading: Literal["auto", "on", "off"] = "auto"
    """Give every frame gains that change smoothly over the image beside its color map, which it then has in any case:
    always, never, or where the sparse points say so (auto)."""
    least_shading: Share = 0.45
    """Smallest share that such gains must explain of the variation that water and color maps leave, with `auto`."""
