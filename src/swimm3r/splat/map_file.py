"""Maps and training states on disk, as safetensors: tensors under their names, everything else in the header.

map.safetensors (`schema` 6) holds the primitives as stored (before activation), the water, and in its header
the recipe, its settings, the metric flag, the working unit and when the clip begins and ends; also the training
frames' poses where they were refined, their colors where each has its own, small depth images of them, and the camera
that notebooks show the map from. That of a large map (`schema` 7) holds no primitives but lists the files of its blocks
(`splat.block_store`), which lie in blocks/ beside it.

Earlier maps, of one block and of several: the water's layers are 1 x 1 convolutions (schema 4 and 5); besides, there
are no footprints, and maps are drawn dilated, as they were trained (2 and 3); settings have other names, and are not
read (1, Swimm3R 0.1). A checkpoint adds the optimizer's moments and the step.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from torch import Tensor

from swimm3r.appearance import ORDERS, FrameColors
from swimm3r.cameras import Cameras, check_cameras, check_poses
from swimm3r.io.files.damage import Remedy, guard
from swimm3r.io.files.safe_names import check_names
from swimm3r.io.files.tensor_file import read_tensors
from swimm3r.settings_document import from_document
from swimm3r.splat.block_store import BlockEntry, StoredBlocks
from swimm3r.splat.medium.lamp import NO_LIGHT
from swimm3r.splat.primitives.kinds import primitives_from
from swimm3r.splat.projection.observed import coverage_from
from swimm3r.splat.recipes import recipe_parts
from swimm3r.splat.rendering import SCHEMA, SCHEMA_IN_BLOCKS, SplatMap
from swimm3r.splat.settings import IN_BLOCKS, RECIPES, RecipeName, settings_of
from swimm3r.splat.training_poses import RefinedPoses

_DILATED = (2, 3)  # schemas of maps before primitives were filtered
_WITH_CONVOLUTIONS = (*_DILATED, 4, 5)
_IN_BLOCKS = (3, 5, SCHEMA_IN_BLOCKS)


@dataclass(frozen=True)
class _ImageSize:
    width: int
    height: int


@dataclass(frozen=True)
class _MapHeader:
    recipe: str
    settings: dict[str, Any]
    metric: bool
    length: float
    schema: int
    span: tuple[float, float] = (0.0, 1.0)  # static maps of earlier versions have none
    frames: tuple[str, ...] | None = None  # whose poses were refined
    colors: tuple[str, ...] | None = None  # frames with colors of their own
    viewpoint: _ImageSize | None = None  # of its images; None of a map without one
    blocks: tuple[BlockEntry, ...] = ()  # of a large map
    key: str = ""  # of the training that made them

    def __post_init__(self) -> None:
        if self.recipe not in RECIPES:
            raise ValueError(f"its recipe is {self.recipe!r}, and known are {', '.join(RECIPES)}")
        if self.length <= 0:
            raise ValueError(f"its working unit is {self.length:g}")
        if self.span[0] > self.span[1]:
            raise ValueError(f"its clip ends before it begins: {list(self.span)}")
        check_names(self.frames or ())
        check_names(self.colors or ())
        if bool(self.blocks) != (self.schema in _IN_BLOCKS):
            raise ValueError(f"a file of schema {self.schema} lists {len(self.blocks)} blocks")
        check_names(entry.file for entry in self.blocks)
        if self.blocks and self.recipe not in IN_BLOCKS:
            raise ValueError(f"maps of {self.recipe} have no blocks")


def load_map(path: str | Path) -> SplatMap:
    """Read what `SplatMap.save` wrote. Raises InputError for a file that is damaged or of another kind."""
    path = Path(path)
    remedy = Remedy(
        f"remove {path.parent}; the swimm3r command that trained the map trains it again",
        cause="the file is damaged, of another version, or of another program",
        fault="is not a map that can be read",
    )
    stored = read_tensors(path, _MapHeader, remedy, (*_WITH_CONVOLUTIONS, SCHEMA, SCHEMA_IN_BLOCKS))
    about = stored.about
    with guard(path, remedy):
        settings = from_document(about.settings, settings_of(cast(RecipeName, about.recipe)))
        if about.schema in _DILATED:
            settings = replace(settings, render=replace(settings.render, antialiasing="dilation"))
        lit = any(name.startswith("field.lamp.") for name in stored.tensors)
        parts = recipe_parts(settings, NO_LIGHT if lit else None)
        empty = bool(about.blocks)
        primitives = primitives_from(stored.tensors, parts.primitives, "primitives.", may_be_empty=empty)
        field = parts.field
        try:
            field.load_state_dict(_of_field(stored.tensors, convolutions=about.schema in _WITH_CONVOLUTIONS))
        except RuntimeError as error:  # torch on missing names and other shapes
            raise ValueError(" ".join(str(error).split())) from error
        coverage = coverage_from(stored.tensors)
        poses = None
        if about.frames is not None:
            poses = RefinedPoses(about.frames, _poses(stored.tensors, len(about.frames)))
        colors = None if about.colors is None else _colors(stored.tensors, about.colors)
        viewpoint = None if about.viewpoint is None else _viewpoint(stored.tensors, about.viewpoint)
        blocks = None
        if about.blocks:
            blocks = StoredBlocks(path.parent, about.key, about.blocks)
            blocks.check_files()
    field.requires_grad_(False)
    return SplatMap(
        primitives,
        field,
        settings,
        about.metric,
        about.length,
        about.span,
        poses,
        viewpoint,
        blocks,
        colors,
        coverage,
    )


def _of_field(tensors: Mapping[str, Tensor], *, convolutions: bool) -> dict[str, Tensor]:
    """The stored state of the water; weights of 1 x 1 convolutions are taken as those of linear layers."""
    state = {k.removeprefix("field."): v for k, v in tensors.items() if k.startswith("field.")}
    if not convolutions:
        return state
    return {k: v.flatten(1) if v.shape[2:] == (1, 1) else v for k, v in state.items()}


def _colors(tensors: Mapping[str, Tensor], names: tuple[str, ...]) -> FrameColors:
    maps, shading = tensors["colors.maps"], tensors.get("colors.shading")
    if maps.shape != (len(names), 3, 4) or not bool(maps.isfinite().all()):
        raise ValueError(f"colors.maps has the shape {tuple(maps.shape)} for {len(names)} frames, or is not finite")
    if shading is not None and (shading.shape != (len(names), len(ORDERS), 3) or not bool(shading.isfinite().all())):
        raise ValueError(f"colors.shading has the shape {tuple(shading.shape)}, or is not finite")
    return FrameColors(names, maps, shading)


def _viewpoint(tensors: Mapping[str, Tensor], size: _ImageSize) -> Cameras:
    K, cam2world = tensors["viewpoint.K"], tensors["viewpoint.cam2world"]
    if K.shape != (1, 3, 3) or cam2world.shape != (1, 4, 4):
        raise ValueError(f"its viewpoint has the shapes {tuple(K.shape)} and {tuple(cam2world.shape)}")
    camera = Cameras(K, K.new_zeros(1, 0), cam2world, size.width, size.height)
    check_cameras(camera)
    return camera


def _poses(tensors: Mapping[str, Tensor], count: int) -> Tensor:
    cam2world = tensors["poses.cam2world"]
    if cam2world.shape != (count, 4, 4):
        raise ValueError(f"poses.cam2world has the shape {tuple(cam2world.shape)} for {count} frames")
    check_poses(cam2world)
    return cam2world
