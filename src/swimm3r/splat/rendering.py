"""A trained map and its images: with the water, without it, the water alone, and depth."""

import copy
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import relu

from swimm3r import devices, notebook
from swimm3r.appearance import FrameColors
from swimm3r.cameras import Cameras
from swimm3r.io.files.tensor_file import write_tensors
from swimm3r.io.images import jpeg_uri
from swimm3r.medium import Medium
from swimm3r.raster import MediumMaps, RasterOutput, SggBuffers, rasterize
from swimm3r.settings_document import to_document
from swimm3r.splat.block_store import StoredBlocks, joined
from swimm3r.splat.gaussian_settings import GaussianSettings
from swimm3r.splat.medium.field import (
    NO_WATER,
    FieldGrid,
    MediumField,
    grid_of,
    medium_at_pixels,
    per_z_depth,
    ray_lengths,
)
from swimm3r.splat.medium.kinds import Water
from swimm3r.splat.medium.seasplat import SceneWater, WaterLayer, layer, relative_depth, seen_through
from swimm3r.splat.primitives.beta import BetaPrimitives, select
from swimm3r.splat.primitives.gaussian import GaussianPrimitives, mean_color
from swimm3r.splat.primitives.kinds import Primitives
from swimm3r.splat.projection.dispatch import project
from swimm3r.splat.projection.observed import COVERED, TrainingCoverage
from swimm3r.splat.projection.view_camera import Projection, ViewCamera, view_camera
from swimm3r.splat.settings import SplatSettings, UwbsSettings
from swimm3r.splat.training_poses import RefinedPoses
from swimm3r.splat.views import normalized_time

SCHEMA = 6  # of a map's file (earlier ones: `splat.map_file`)
SCHEMA_IN_BLOCKS = 7  # of one that lists blocks, which a version that knows none would leave out
_SHOWN_SIDE = 320  # pixels of a view in a notebook
_SEEN = 1e-3  # alpha below which a pixel has no depth


@dataclass(frozen=True)
class RenderOutput:
    """One view of a map."""

    rgb: Float[Tensor, "h w 3"]  # as the camera sees it
    clear: Float[Tensor, "h w 3"]  # J, without the water: the color of what covers a pixel; black where nothing does
    backscatter: Float[Tensor, "h w 3"] | None  # Binf V, the light of the water alone (Eq. 11); None if not drawn
    z_depth: Float[Tensor, "h w"]  # expected, scene units; 0 where nothing is
    alpha: Float[Tensor, "h w"]
    medium: Medium  # per pixel, [h, w, 3], per scene unit of ray depth
    observed: Bool[Tensor, "h w"] | None = None  # what some training frame saw; None if not asked for or not known

    def __repr__(self) -> str:
        height, width = self.alpha.shape
        return f"RenderOutput({', '.join(vars(self))} of {width}x{height} pixels)"

    def _repr_html_(self) -> str:
        shown = (("with the water", self.rgb), ("without", self.clear))
        return notebook.image_row("View of a map", [(_uri(image), caption) for caption, image in shown])


@dataclass(frozen=True)
class SplatMap:
    """Primitives and water of one scene, in the unit and axes of its reconstruction.

    Those of a large map lie in blocks on disk, of which a view takes what it sees; `primitives` are then none. Code
    that needs primitives asks `seen_by` or `parts`.
    """

    primitives: Primitives
    field: Water
    settings: SplatSettings
    metric: bool
    length: float = 1.0  # scene units per working unit (`settings.py`)
    span: tuple[float, float] = (0.0, 1.0)  # of the clip it was trained on, seconds
    poses: RefinedPoses | None = None  # of the training frames; None where they were held
    viewpoint: Cameras | None = None  # the pinhole camera of a training frame, from where notebooks show the map
    blocks: StoredBlocks | None = None  # None: all primitives are in memory
    colors: FrameColors | None = None  # of the training frames; None where all have the dive's
    coverage: TrainingCoverage | None = None  # what training frames saw; None of maps made before it was kept

    def __repr__(self) -> str:
        moving = f", {self.span[0]:.1f} to {self.span[1]:.1f} s" if self.dynamic else ""
        unit = "metres" if self.metric else "scene units"
        blocks = "" if self.blocks is None else f" in {len(self.blocks)} blocks"
        return f"SplatMap({self.settings.recipe}, {self.count:,} primitives{blocks}, {unit}{moving}, on {self.device})"

    def _repr_html_(self) -> str:
        """A view of the map with its water and without, in the middle of its clip; without a viewpoint, text."""
        if self.viewpoint is None:
            return notebook.table(repr(self), [])
        camera = self.viewpoint.pinhole(_SHOWN_SIDE)
        seen = self.render(camera, sum(self.span) / 2, backscatter=False, observed=False)
        shown = ((seen.rgb, "with the water"), (seen.clear, "without"))
        return notebook.image_row(repr(self), [(_uri(image), caption) for image, caption in shown])

    @property
    def device(self) -> torch.device:
        """The device that renders it."""
        return self.primitives.xyz.device

    @property
    def dynamic(self) -> bool:
        """Return whether it changes with time."""
        return self.primitives.dynamic

    @property
    def count(self) -> int:
        """Number of primitives, of all blocks."""
        return len(self.primitives.xyz) if self.blocks is None else self.blocks.count

    def seen_by(self, view: ViewCamera) -> Primitives:
        """The primitives that a view is drawn from: all, or those of the blocks that it sees."""
        if self.blocks is None:
            return self.primitives
        assert isinstance(self.primitives, BetaPrimitives)
        return joined([self.primitives, *self.blocks.seen_by(view)])

    def parts(self, *, coarse: bool = False) -> Iterator[Primitives]:
        """All primitives, of one block after another; `coarse`: the few that stand for a block from afar."""
        return iter((self.primitives,)) if self.blocks is None else self.blocks.parts(coarse=coarse)

    def within(self, holds: Callable[[Float[Tensor, "n 3"]], Bool[Tensor, " n"]]) -> "SplatMap":
        """The map of the primitives whose centers a function of positions, in scene units, accepts."""
        blocks = None if self.blocks is None else self.blocks.within(holds)
        return replace(self, primitives=select(self.primitives, holds(self.primitives.xyz)), blocks=blocks)

    def observed_part(self) -> "SplatMap":
        """The map without what no training frame saw, nor what lies far behind what it saw; all where it is unknown."""
        coverage = self.coverage
        if coverage is None:
            return self
        return self.within(lambda xyz: coverage.needs(xyz.cpu()).to(xyz.device))

    @property
    def has_water(self) -> bool:
        """Return whether it tells water and scene apart."""
        return isinstance(self.field, SceneWater) or not self.field.is_clear

    def to(self, device: torch.device) -> "SplatMap":
        """The same map on a device."""
        blocks = None if self.blocks is None else self.blocks.to(device)
        field = copy.deepcopy(self.field).to(device)
        return replace(self, primitives=self.primitives.to(device), field=field, blocks=blocks)

    def render(
        self, camera: Cameras, time: float | None = None, *, backscatter: bool = True, observed: bool = True
    ) -> RenderOutput:
        """The view of a pinhole or fisheye at a time of the clip (seconds; static maps need none), without gradient.

        The images are where the camera is, on the processor as a rule, wherever the map may be. The water's own light
        is a second pass of the rasterizer, and finding out what training frames `observed` takes half as long as one:
        views that need neither are drawn faster without.

        Raises ValueError where the camera has other distortion, or where a dynamic map is given no time.
        """
        with torch.no_grad():
            return render(self, camera, time, backscatter, observed)

    def save(self, path: str | Path) -> None:
        """Write a map.safetensors (layout: `splat.map_file`), whole or not at all; `swimm3r.load_map` reads it.

        The blocks of a large map are copied beside it, before it.
        """
        tensors = {f"primitives.{name}": values for name, values in self.primitives._asdict().items()}
        tensors |= {f"field.{name}": values for name, values in self.field.state_dict().items()}
        about = {
            "schema": SCHEMA if self.blocks is None else SCHEMA_IN_BLOCKS,
            "recipe": self.settings.recipe,
            "settings": to_document(self.settings),
            "metric": self.metric,
            "length": self.length,
            "span": self.span,
        }
        if self.poses is not None:
            tensors["poses.cam2world"] = self.poses.cam2world
            about["frames"] = self.poses.names
        if self.viewpoint is not None:
            tensors |= {"viewpoint.K": self.viewpoint.K, "viewpoint.cam2world": self.viewpoint.cam2world}
            about["viewpoint"] = {"width": self.viewpoint.width, "height": self.viewpoint.height}
        if self.colors is not None:
            tensors["colors.maps"] = self.colors.maps
            if self.colors.shading is not None:
                tensors["colors.shading"] = self.colors.shading
            about["colors"] = self.colors.names
        if self.coverage is not None:
            tensors |= self.coverage.tensors()
        if self.blocks is not None:
            self.blocks.copy_to(Path(path).parent)
            about |= {"blocks": [asdict(entry) for entry in self.blocks.entries], "key": self.blocks.key}
        write_tensors(Path(path), tensors, about)

    def normalized_time(self, time: float | None) -> Float[Tensor, ""] | None:
        """A time of the clip as the map's own parts take it: None in static maps, 0..1 in dynamic ones."""
        if not self.dynamic:
            return None
        if time is None:
            start, end = self.span
            raise ValueError(f"a dynamic map is rendered at a time of its clip, {start:g} to {end:g} s; got none")
        return normalized_time(self.span, time)


@dataclass(frozen=True)
class Drawing:
    """A view as the rasterizer makes it, channels first, with what the losses need."""

    images: RasterOutput
    projection: Projection
    grid: FieldGrid
    maps: MediumMaps | None  # as the rasterizer reads them, per unit of z depth; None in clear water
    sgg: SggBuffers | None  # filled when the gradient is taken
    time: Float[Tensor, ""] | None = None  # that primitives were conditioned on
    light: Float[Tensor, "n 3"] | None = None  # of a lamp on the primitives, in their colors; None in daylight


def draw(
    p: Primitives,
    field: MediumField,
    view: ViewCamera,
    settings: UwbsSettings | GaussianSettings,
    time: Float[Tensor, ""] | None = None,
    sgg: bool = False,
) -> Drawing:
    """Project, evaluate the water and rasterize; differentiable in everything but time, the pose included."""
    time = time if p.dynamic else None
    projection = projected(p, field, view, settings, time)
    grid, light = grid_of(field, view, field.stride, time), None
    if field.lamp is not None:
        light = field.lamp.light(p.xyz, view, grid.values[6:].mean((1, 2)), field.length)
        lit = projection.primitives._replace(color=projection.primitives.color * light)
        projection = replace(projection, primitives=lit)
    maps = None if field.is_clear else medium_at_pixels(grid, view.height, view.width)
    if maps is not None and settings.render.depth == "ray":
        maps = per_z_depth(maps, view)
    buffers = SggBuffers.zeros(len(p.xyz), p.xyz.device) if sgg else None
    images = rasterize(
        projection.primitives, maps, view.height, view.width,
        alpha_min=settings.render.alpha_min, kernel=projection.kernel,
        medium_depth_grad=settings.render.medium_depth_grad == "full", sgg=buffers,
    )  # fmt: skip
    return Drawing(images, projection, grid, maps, buffers, time, light)


def projected(
    p: Primitives,
    field: Water,
    view: ViewCamera,
    settings: UwbsSettings | GaussianSettings,
    time: Float[Tensor, ""] | None = None,
) -> Projection:
    """Primitives in a camera, in the colors that they have before it."""
    projection = project(p, view, settings.render, time if p.dynamic else None)
    if not isinstance(field, MediumField) or field.affine_colors is None:
        return projection
    assert isinstance(p, GaussianPrimitives)
    gain, offset = field.affine_colors.affine(p.xyz, mean_color(p), view, field.length)
    seen = projection.primitives
    return replace(projection, primitives=seen._replace(color=(gain * seen.color + offset).clamp(min=0)))


def evenly_lit(drawing: Drawing, view: ViewCamera, settings: UwbsSettings | GaussianSettings) -> RasterOutput:
    """The images of a drawing, with a clear one without the light of a lamp."""
    if drawing.light is None:
        return drawing.images
    lit = drawing.projection.primitives
    even = lit._replace(color=lit.color / drawing.light)
    alone = rasterize(
        even, None, view.height, view.width, alpha_min=settings.render.alpha_min, kernel=drawing.projection.kernel
    )
    return drawing.images._replace(clear=alone.clear)


def images(
    p: Primitives, field: Water, view: ViewCamera, settings: SplatSettings, time: Float[Tensor, ""] | None = None
) -> RasterOutput:
    """The images of any map; differentiable as `draw` is."""
    match field:
        case MediumField():
            return draw(p, field, view, settings, time).images
        case SceneWater():
            images = draw(p, NO_WATER, view, settings, time).images
            return images._replace(rgb=seen_through(images.clear, layer(field, relative_depth(images))))


def expected_z_depth(images: RasterOutput) -> Float[Tensor, "h w"]:
    """Mean z depth of what a pixel shows; 0 where it shows nothing but water."""
    return torch.where(images.alpha > _SEEN, images.z_depth / images.alpha.clamp(min=_SEEN), 0.0)


def surface_color(images: RasterOutput) -> Float[Tensor, "3 h w"]:
    """Mean clear color of what covers a pixel; it fades to black where less than half of the pixel is covered.

    The blended clear color itself is as dark as the pixel is transparent: the light of what lies behind is missing.
    """
    return images.clear / images.alpha.clamp(min=COVERED)


def _uri(image: Float[Tensor, "h w 3"]) -> str:
    """An image for a page."""
    return jpeg_uri((image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy())


OfMethod = TypeVar("OfMethod", bound=SplatSettings)


def settings_in_scene_units(settings: OfMethod, length: float) -> OfMethod:
    """Settings whose lengths are scene units instead of working units."""
    return replace(settings, render=replace(settings.render, near=settings.render.near * length))


memory_for_views = devices.memory_for(
    "views of this map", "smaller images; or the processor, by CUDA_VISIBLE_DEVICES= before the command"
)
"""Wraps what renders a map wherever it may be."""


@memory_for_views
def render(
    scene: SplatMap, camera: Cameras, time: float | None = None, backscatter: bool = True, observed: bool = True
) -> RenderOutput:
    """One view of a map at a time of its clip. Raises ValueError as `SplatMap.render` does."""
    settings = settings_in_scene_units(scene.settings, scene.length)
    view, now = view_camera(camera).to(scene.device), scene.normalized_time(time)
    match scene.field:
        case MediumField():
            drawing = draw(scene.seen_by(view), scene.field, view, settings, now)
            images, medium = (
                evenly_lit(drawing, view, settings),
                medium_at_pixels(drawing.grid, view.height, view.width),
            )
            veil = _water_alone(drawing, view, settings) if backscatter else None
        case SceneWater():
            images = draw(scene.seen_by(view), NO_WATER, view, settings, now).images
            over = layer(scene.field, relative_depth(images))
            medium, veil = _as_coefficients(scene.field, over, images, view), over.backscatter
            images = images._replace(rgb=seen_through(images.clear, over))
    there = camera.cam2world.device
    z_depth, seen = expected_z_depth(images).to(there), None
    if observed and scene.coverage is not None:
        seen = scene.coverage.of_view(camera, z_depth, images.alpha.to(there)).to(there)
    return RenderOutput(
        rgb=images.rgb.permute(1, 2, 0).to(there),
        clear=surface_color(images).permute(1, 2, 0).to(there),
        backscatter=None if veil is None else veil.permute(1, 2, 0).to(there),
        z_depth=z_depth,
        alpha=images.alpha.to(there),
        medium=Medium(
            Binf=medium.Binf.permute(1, 2, 0).to(there),
            beta_D=medium.beta_D.permute(1, 2, 0).to(there),
            beta_B=medium.beta_B.permute(1, 2, 0).to(there),
        ),
        observed=seen,
    )


def _water_alone(
    drawing: Drawing, view: ViewCamera, settings: UwbsSettings | GaussianSettings
) -> Float[Tensor, "3 h w"]:
    """The light of the water in a drawing (Eq. 11): that of its primitives in black."""
    seen = drawing.projection.primitives
    black = seen._replace(color=torch.zeros_like(seen.color))
    return rasterize(
        black, drawing.maps, view.height, view.width,
        alpha_min=settings.render.alpha_min, kernel=drawing.projection.kernel,
    ).rgb  # fmt: skip


def mean_water(scene: SplatMap, camera: Cameras, time: float | None = None) -> Medium:
    """The map's water averaged over one view, per scene unit of ray depth."""
    match scene.field:
        case MediumField():
            view = view_camera(camera).to(scene.device)
            grid = grid_of(scene.field, view, scene.field.stride, scene.normalized_time(time))
            mean = grid.values.flatten(1).mean(1).to(camera.cam2world.device)
            return Medium(mean[:3], beta_B=mean[3:6], beta_D=mean[6:])
        case SceneWater():
            medium = scene.render(camera, time, backscatter=False, observed=False).medium
            return Medium(**{name: values.flatten(0, 1).mean(0) for name, values in vars(medium).items()})


def _as_coefficients(water: SceneWater, over: WaterLayer, images: RasterOutput, view: ViewCamera) -> MediumMaps:
    """Betas per unit of ray depth that take, over each pixel's own, the light that the scene's coefficients take."""
    z = expected_z_depth(images)
    ray = (torch.where(z > 0, z, z.max()) * ray_lengths(view)).clamp(min=1e-6)
    shares = over.depth / ray
    a, b, Binf = (v[:, None, None] for v in (relu(water.attenuation), relu(water.backscatter), water.Binf))
    return MediumMaps(Binf.expand(3, *shares.shape), a * shares, b * shares)
