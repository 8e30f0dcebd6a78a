"""The published methods that maps are trained by: losses and schedule of each, and the one choice between them."""

from functools import partial
from typing import TYPE_CHECKING

from swimm3r.splat.settings import (
    McmcGsSettings,
    OceanSplatSettings,
    SeaSplatSettings,
    SplatSettings,
    UirSettings,
    UwbsSettings,
    WaterSplattingSettings,
)
from swimm3r.splat.shared_settings import MediumFieldSettings

if TYPE_CHECKING:
    import swimm3r.lamp
    import swimm3r.splat.training.loop

__all__ = ["recipe_parts"]


def recipe_parts(
    settings: SplatSettings, lamp: "swimm3r.lamp.Lamp | None" = None
) -> "swimm3r.splat.training.loop.RecipeParts":
    """The primitives, the water and the training that settings ask for; a lamp lights maps of Beta primitives alone."""
    from swimm3r.splat.medium.field import MediumField
    from swimm3r.splat.medium.seasplat import SceneWater
    from swimm3r.splat.medium.uir import UirField
    from swimm3r.splat.primitives.beta import BetaPrimitives
    from swimm3r.splat.primitives.gaussian import GaussianPrimitives
    from swimm3r.splat.recipes import mcmc_gs, oceansplat, seasplat, uir, uwbs, watersplatting
    from swimm3r.splat.training.loop import RecipeParts

    match settings:
        case UwbsSettings():
            field = MediumField(settings.medium, settings.dynamic, lamp)
            return RecipeParts(BetaPrimitives, field, partial(uwbs.recipe, settings))
        case McmcGsSettings():
            field = MediumField(MediumFieldSettings(model="none"))
            return RecipeParts(GaussianPrimitives, field, partial(mcmc_gs.McmcGs, settings))
        case OceanSplatSettings():  # before the settings that it extends
            field = oceansplat.OceanField(settings.medium, settings.alpha)
            return RecipeParts(GaussianPrimitives, field, partial(oceansplat.recipe, settings))
        case WaterSplattingSettings():
            field = MediumField(settings.medium)
            return RecipeParts(GaussianPrimitives, field, partial(watersplatting.WaterSplatting, settings))
        case SeaSplatSettings():
            return RecipeParts(GaussianPrimitives, SceneWater(), partial(seasplat.SeaSplat, settings))
        case UirSettings():
            field = UirField(settings.medium, settings.affine_colors)
            return RecipeParts(GaussianPrimitives, field, partial(uir.recipe, settings))
