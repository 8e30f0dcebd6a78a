"""Maps and training states on disk, as safetensors: tensors under their names, everything else in the header.

map.safetensors (`schema` 2) holds the primitives as stored (before activation), the water, and in its header
the recipe, its settings, the metric flag, the working unit and when the clip begins and ends; also the training
frames' poses where they were refined. A checkpoint adds the optimizer's moments and the step.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from torch import Tensor

from swimm3r.cameras import check_poses
from swimm3r.io.files.damage import Remedy, guard
from swimm3r.io.files.safe_names import check_names
from swimm3r.io.files.tensor_file import read_tensors, write_tensors
from swimm3r.settings_document import from_document, to_document
from swimm3r.splat.primitives.kinds import primitives_from
from swimm3r.splat.recipes import recipe_parts
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import RECIPES, RecipeName, settings_of
from swimm3r.splat.training_poses import RefinedPoses

SCHEMA = 2  # 1: Swimm3R 0.1, whose settings have other names


@dataclass(frozen=True)
class _MapHeader:
    recipe: str
    settings: dict[str, Any]
    metric: bool
    length: float
    span: tuple[float, float] = (0.0, 1.0)  # static maps of earlier versions have none
    frames: tuple[str, ...] | None = None  # whose poses were refined

    def __post_init__(self) -> None:
        if self.recipe not in RECIPES:
            raise ValueError(f"its recipe is {self.recipe!r}, and known are {', '.join(RECIPES)}")
        if self.length <= 0:
            raise ValueError(f"its working unit is {self.length:g}")
        if self.span[0] > self.span[1]:
            raise ValueError(f"its clip ends before it begins: {list(self.span)}")
        check_names(self.frames or ())


def save_map(path: Path, scene: SplatMap) -> None:
    """Write a map, whole or not at all."""
    tensors = {f"primitives.{name}": values for name, values in scene.primitives._asdict().items()}
    tensors |= {f"field.{name}": values for name, values in scene.field.state_dict().items()}
    about = {
        "schema": SCHEMA,
        "recipe": scene.settings.recipe,
        "settings": to_document(scene.settings),
        "metric": scene.metric,
        "length": scene.length,
        "span": scene.span,
    }
    if scene.poses is not None:
        tensors["poses.cam2world"] = scene.poses.cam2world
        about["frames"] = scene.poses.names
    write_tensors(path, tensors, about)


def load_map(path: Path) -> SplatMap:
    """Read what `save_map` wrote. Raises InputError for a file that is damaged or of another kind."""
    remedy = Remedy(
        f"remove {path.parent}; the swimm3r command that trained the map trains it again",
        cause="the file is damaged, of another version, or of another program",
        fault="is not a map that can be read",
    )
    stored = read_tensors(path, _MapHeader, remedy, SCHEMA)
    about = stored.about
    with guard(path, remedy):
        settings = from_document(about.settings, settings_of(cast(RecipeName, about.recipe)))
        parts = recipe_parts(settings)
        field, primitives = parts.field, primitives_from(stored.tensors, parts.primitives, "primitives.")
        try:
            field.load_state_dict(
                {k.removeprefix("field."): v for k, v in stored.tensors.items() if k.startswith("field.")}
            )
        except RuntimeError as error:  # torch on missing names and other shapes
            raise ValueError(" ".join(str(error).split())) from error
        poses = None
        if about.frames is not None:
            poses = RefinedPoses(about.frames, _poses(stored.tensors, len(about.frames)))
    field.requires_grad_(False)
    return SplatMap(primitives, field, settings, about.metric, about.length, about.span, poses)


def _poses(tensors: Mapping[str, Tensor], count: int) -> Tensor:
    cam2world = tensors["poses.cam2world"]
    if cam2world.shape != (count, 4, 4):
        raise ValueError(f"poses.cam2world has the shape {tuple(cam2world.shape)} for {count} frames")
    check_poses(cam2world)
    return cam2world
