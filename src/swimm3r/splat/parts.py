"""The parts of a map by recipe: its kind of primitives and its water."""

from dataclasses import dataclass

from swimm3r.splat.medium.field import MediumField
from swimm3r.splat.medium.seasplat import SceneWater
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.primitives.gaussian import GaussianPrimitives
from swimm3r.splat.primitives.kinds import Primitives
from swimm3r.splat.settings import McmcGsSettings, SeaSplatSettings, SplatSettings, UwbsSettings, WaterSplattingSettings
from swimm3r.splat.shared_settings import MediumFieldSettings

Water = MediumField | SceneWater
"""Water between the primitives and the camera, or one layer over the finished image."""


@dataclass(frozen=True)
class Parts:
    """The kind of primitives, and a water whose values are still to come."""

    primitives: type[Primitives]
    field: Water


def parts_of(settings: SplatSettings) -> Parts:
    """The parts of the maps of a recipe."""
    match settings:
        case UwbsSettings():
            return Parts(BetaPrimitives, MediumField(settings.medium, settings.dynamic))
        case McmcGsSettings():
            return Parts(GaussianPrimitives, MediumField(MediumFieldSettings(model="none")))
        case WaterSplattingSettings():
            return Parts(GaussianPrimitives, MediumField(settings.medium))
        case SeaSplatSettings():
            return Parts(GaussianPrimitives, SceneWater())
