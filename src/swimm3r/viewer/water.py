"""The scene put into more, less or other water than it was filmed in, by the image formation model (Eqs. 2-4).

    I = J exp(-a beta_D z) + Binf (1 - exp(-a beta_B z))

a is the amount of water: 0 none, 1 as it is, 2 water that is twice as dense. z is ray depth. A map composites water and
surfaces along each ray, so its own image differs a little from the model's; that difference fades with the amount, and
an amount of 1 of a dive's own water is exactly the map's image.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from jaxtyping import Float
from torch import Tensor

from swimm3r.errors import InputError
from swimm3r.io.medium_json import load_medium
from swimm3r.medium import (
    Encoding,
    Medium,
    MediumFit,
    add_water,
    backscatter,
    linear_from_srgb,
    srgb_from_linear,
)
from swimm3r.scene.run_folder import open_run
from swimm3r.splat.map_file import load_map
from swimm3r.splat.rendering import RenderOutput, mean_water
from swimm3r.viewer.viewed_run import open_viewed_run
from swimm3r.water_types import FAMILIES, JerlovType, jerlov, typical


@dataclass(frozen=True, eq=False)
class OtherWater:
    """A water that the scene was not filmed in."""

    name: str
    medium: Medium  # of one scene, [3], per working unit of ray depth: metres where that is known
    encoding: Encoding


def known_waters(runs: Sequence[Path] = ()) -> list[OtherWater]:
    """The water types, and before them the water of other runs. Raises InputError where a run has none."""
    types = [OtherWater(f"Jerlov {kind}", jerlov(kind), "linear") for kind in get_args(JerlovType)]
    families = [OtherWater(f"typical {name} water", typical(name), "srgb") for name in FAMILIES]
    return [*(water_of_run(run) for run in runs), *types, *families]


def water_of_run(folder: Path) -> OtherWater:
    """The water of another dive: its map's in the view that notebooks show, else that of its medium.json.

    Raises InputError where the run is not finished that far, or found no water.
    """
    record = open_run(folder, "sfm")
    run = open_viewed_run(folder, "cpu")
    name = f"water of {folder.resolve().name}"
    if record.is_finished("splat"):
        scene = load_map(folder / "splat" / "map.safetensors")
        if scene.has_water and scene.viewpoint is not None:
            medium = mean_water(scene, scene.viewpoint, sum(scene.span) / 2)
            return OtherWater(name, per_working_unit(medium, run.scale), "srgb")
    if run.rec.medium is None:
        raise InputError(
            f"the run in {folder} knows no water",
            cause="its frames did not tell the water from the scene, or its map was trained without",
            hint="another run for --water",
        )
    found = load_medium(folder / "sfm" / "medium.json")
    medium, encoding = (found.constant(), found.encoding) if isinstance(found, MediumFit) else (found, "srgb")
    return OtherWater(name, per_working_unit(medium, run.scale), encoding)


def per_working_unit(medium: Medium, scale: float) -> Medium:
    """A medium per scene unit as one per working unit, `scale` of which are a scene unit."""
    return Medium(medium.Binf, medium.beta_D / scale, medium.beta_B / scale)


def with_amount(out: RenderOutput, ray_depth: Float[Tensor, "h w"], amount: float) -> Float[Tensor, "h w 3"]:
    """A view of a map with this much of its own water; open water, where nothing is, keeps its color."""
    if amount == 1:
        return out.rgb
    modeled = add_water(out.clear, ray_depth, denser(out.medium, amount))
    as_filmed = add_water(out.clear, ray_depth, out.medium)
    surface = modeled + min(amount, 1.0) * (out.rgb - as_filmed)
    covered = out.alpha.clamp(0, 1)[..., None]
    return covered * surface + (1 - covered) * out.rgb


def in_water(
    out: RenderOutput, ray_depth: Float[Tensor, "h w"], water: OtherWater, scale: float, amount: float = 1.0
) -> Float[Tensor, "h w 3"]:
    """A view of a map in other water; where nothing is, its veiling light. `scale`: working units per scene unit."""
    linear = water.encoding == "linear"
    J = linear_from_srgb(out.clear) if linear else out.clear
    medium = denser(water.medium, amount)
    surface = add_water(J, ray_depth * scale, medium)
    covered = out.alpha.clamp(0, 1)[..., None]
    mixed = covered * surface + (1 - covered) * medium.Binf
    return srgb_from_linear(mixed) if linear else mixed


def light_of_water(
    out: RenderOutput, ray_depth: Float[Tensor, "h w"], water: OtherWater | None, scale: float, amount: float
) -> Float[Tensor, "h w 3"]:
    """The light of the water alone: the map's own, or by the model where amount or water are others."""
    if water is None and amount == 1:
        assert out.backscatter is not None
        return out.backscatter
    own = water is None
    medium = denser(out.medium if own else water.medium, amount)
    veil = backscatter(ray_depth if own else ray_depth * scale, medium)
    covered = out.alpha.clamp(0, 1)[..., None]
    mixed = covered * veil + (1 - covered) * medium.Binf
    return srgb_from_linear(mixed) if not own and water.encoding == "linear" else mixed


def denser(medium: Medium, amount: float) -> Medium:
    """Water with `amount` times the particles and pigments: both coefficients grow, the veiling light stays."""
    return Medium(medium.Binf, medium.beta_D * amount, medium.beta_B * amount)
