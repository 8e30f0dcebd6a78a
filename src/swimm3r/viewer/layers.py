"""The pictures of the viewer: one layer of a run as one camera sees it, at a size that the caller chooses."""

import math
from collections import OrderedDict
from dataclasses import dataclass, replace
from threading import Lock
from typing import Literal, get_args

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from swimm3r.cameras import Cameras, image_directions, pixel_grid, project_visible, ray_depth_from_z, unproject
from swimm3r.imaging.depth_colors import depth_image
from swimm3r.medium import Medium, linear_from_srgb, srgb_from_linear
from swimm3r.pipeline.renders import shown_clear
from swimm3r.splat.rendering import (
    RenderOutput,
    SplatMap,
)
from swimm3r.viewer import water
from swimm3r.viewer.viewed_run import ViewedRun
from swimm3r.viewer.water import OtherWater

Layer = Literal[
    "With the water",
    "Without the water",
    "Light of the water alone",
    "Depth",
    "Surface normals",
    "Frame as filmed",
    "Frame restored",
    "Points alone",
]
LAYERS: tuple[Layer, ...] = get_args(Layer)
OF_MAP = LAYERS[:5]
"""Layers that only a map has."""
BACKGROUND = (18, 26, 32)  # where nothing is to be shown
_LINE = (255, 255, 255)
_KEPT_CROPS = 4
_SOLID = 0.5  # alpha from which on depth and normals are shown


@dataclass(frozen=True)
class CropBox:
    """A box along the axes of the browser's world, working units."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def holds(self, xyz: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Mask of the points inside."""
        return ((xyz >= torch.tensor(self.low).to(xyz)) & (xyz <= torch.tensor(self.high).to(xyz))).all(-1)


@dataclass(frozen=True)
class LayerChoice:
    """Everything that decides a picture besides its camera."""

    layer: Layer = "With the water"
    amount: float = 1.0  # of water
    water: OtherWater | None = None  # None: the dive's own
    exposure: float = 0.0  # stops
    time: float = 0.0  # second of the clip, for maps that change with it
    crop: CropBox | None = None
    frame: str | None = None  # shown by the frame layers and the wipe; None: the nearest
    wipe: float = 0.0  # share of the picture, from the left, that shows the frame


@dataclass(frozen=True)
class ViewCamera:
    """The browser's camera, in the axes of the map and scene units."""

    cam2world: Float[Tensor, "4 4"]  # float64
    fov: float  # vertical, radians
    aspect: float  # width by height
    window: int = 65_536  # longer side of the browser's window, pixels

    def at(self, long_side: int) -> Cameras:
        """The same as a pinhole camera with images of this size."""
        scale = long_side / max(self.aspect, 1.0)
        width, height = max(2, round(scale * self.aspect)), max(2, round(scale))
        f = height / (2 * math.tan(self.fov / 2))
        K = torch.tensor([[[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]]], dtype=torch.float64)
        return Cameras(K, K.new_zeros(1, 0), self.cam2world[None], width, height)


@dataclass(frozen=True)
class Picture:
    """One picture, and the depth of what it shows."""

    rgb: UInt8[np.ndarray, "h w 3"]
    z_depth: Float[np.ndarray, "h w"] | None  # scene units, 0 where nothing is; None without a map


class Painter:
    """Draws the pictures of a run; keeps the primitives of the last few crop boxes."""

    def __init__(self, run: ViewedRun) -> None:
        self.run = run
        self._crops: OrderedDict[tuple[int, CropBox], SplatMap] = OrderedDict()
        self._lock = Lock()

    @property
    def layers(self) -> tuple[Layer, ...]:
        """The layers that this run has."""
        scene = self.run.scene
        dry = () if scene is None or scene.has_water else ("Without the water", "Light of the water alone")
        missing = {*dry, *(OF_MAP if scene is None else ())}
        if not self.run.has_restored_frames:
            missing.add("Frame restored")
        return tuple(layer for layer in LAYERS if layer not in missing)

    def draw(self, view: ViewCamera, long_side: int, choice: LayerChoice) -> Picture:
        """A picture of at most `long_side` pixels."""
        camera = view.at(long_side)
        scene = self._cropped(choice.crop)
        if scene is None:
            return Picture(self._without_map(camera, choice), None)
        out = self._surface(scene, camera, choice)
        rgb = _bytes(self._layer(out, camera, choice))
        if choice.wipe > 0 and choice.layer not in ("Frame as filmed", "Points alone"):
            rgb = wiped(_bytes(self._frame(camera, out.z_depth, choice, "Frame as filmed")), rgb, choice.wipe)
        return Picture(rgb, out.z_depth.numpy())

    def z_depth(self, camera: Cameras, choice: LayerChoice) -> Float[Tensor, "h w"]:
        """Depth alone of a view of the map, scene units."""
        scene = self._cropped(choice.crop)
        assert scene is not None
        return self._surface(scene, camera, replace(choice, layer="Depth")).z_depth

    def _cropped(self, crop: CropBox | None) -> SplatMap | None:
        """The map without the primitives outside a crop box."""
        scene = self.run.scene
        if scene is None or crop is None:
            return scene
        key = (id(scene), crop)
        with self._lock:
            if key not in self._crops:
                self._crops[key] = scene.within(lambda xyz: crop.holds(xyz * self.run.scale))
                while len(self._crops) > _KEPT_CROPS:
                    self._crops.popitem(last=False)
            return self._crops[key]

    def _surface(self, scene: SplatMap, camera: Cameras, choice: LayerChoice) -> RenderOutput:
        """The map's view, with the water's own light where the layer shows it."""
        if not scene.count:
            return _nothing(camera)
        veil = choice.layer == "Light of the water alone"
        return scene.render(camera, choice.time if scene.dynamic else None, backscatter=veil, observed=False)

    def _layer(self, out: RenderOutput, camera: Cameras, choice: LayerChoice) -> Float[Tensor, "h w 3"]:
        run = self.run
        assert run.style is not None
        rays = image_directions(camera).to(out.z_depth)
        ray_depth = ray_depth_from_z(out.z_depth, rays)
        solid = torch.where(out.alpha > _SOLID, out.z_depth, 0.0)
        match choice.layer:
            case "With the water":
                other = choice.water
                shown = (
                    water.with_amount(out, ray_depth, choice.amount)
                    if other is None
                    else water.in_water(out, ray_depth, other, run.scale, choice.amount)
                )
            case "Without the water":
                shown = shown_clear(out, camera, run.style)
            case "Light of the water alone":
                shown = water.light_of_water(out, ray_depth, choice.water, run.scale, choice.amount)
            case "Depth":
                return torch.from_numpy(depth_image(solid.numpy(), *run.style.near_far) / np.float32(255))
            case "Surface normals":
                return normal_colors(solid, camera)
            case "Points alone":
                return _plain(camera)
            case "Frame as filmed" | "Frame restored":
                return self._frame(camera, out.z_depth, choice, choice.layer)
        return exposed(shown, choice.exposure)

    def _frame(
        self, camera: Cameras, z_depth: Float[Tensor, "h w"], choice: LayerChoice, layer: Layer
    ) -> Float[Tensor, "h w 3"]:
        """A frame laid onto the surface that the view shows; the far end of the scene stands in where there is none."""
        run = self.run
        name = choice.frame or run.nearest(camera.cam2world[0])
        frame = run.frame_image(name, restored=layer == "Frame restored")
        if frame is None:
            return _plain(camera)
        far = run.style.near_far[1] if run.style is not None else run.median_depth
        points = unproject(camera, _pixels(camera), torch.where(z_depth > 0, z_depth, far).reshape(1, -1).double())
        xy, _, visible = project_visible(frame.camera, points)
        column, row = (xy[0].float() - 0.5).reshape(*z_depth.shape, 2).numpy().transpose(2, 0, 1)
        rgb = cv2.remap(frame.rgb, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        seen = cv2.remap(frame.seen.astype(np.uint8), column, row, cv2.INTER_NEAREST)
        known = torch.from_numpy(seen > 0) & visible[0].reshape(z_depth.shape)
        image = torch.from_numpy(rgb.astype(np.float32) / 255)
        return torch.where(known[..., None], exposed(image, choice.exposure), _plain(camera))

    def _without_map(self, camera: Cameras, choice: LayerChoice) -> UInt8[np.ndarray, "h w 3"]:
        nothing = torch.zeros(camera.height, camera.width)
        if choice.layer in ("Frame as filmed", "Frame restored"):
            return _bytes(self._frame(camera, nothing, choice, choice.layer))
        plain = _bytes(_plain(camera))
        if choice.wipe > 0:
            return wiped(_bytes(self._frame(camera, nothing, choice, "Frame as filmed")), plain, choice.wipe)
        return plain


def exposed(image: Float[Tensor, "h w 3"], stops: float) -> Float[Tensor, "h w 3"]:
    """An image exposed by so many stops more, in linear light."""
    return image if stops == 0 else srgb_from_linear(linear_from_srgb(image.clamp(min=0)) * 2.0**stops)


def normal_colors(z_depth: Float[Tensor, "h w"], camera: Cameras) -> Float[Tensor, "h w 3"]:
    """Directions of the surface in camera axes as colors: (1 + right, 1 + up, 1 + towards the camera) / 2."""
    points = unproject(camera, _pixels(camera).to(z_depth), z_depth.reshape(1, -1))
    seen = (points[0] - camera.cam2world[0, :3, 3].to(points)) @ camera.cam2world[0, :3, :3].to(points)
    image = seen.reshape(*z_depth.shape, 3)
    across, down = (torch.gradient(image, dim=axis)[0] for axis in (1, 0))
    normal = torch.nn.functional.normalize(torch.linalg.cross(down, across, dim=-1), dim=-1)
    colors = (1 + normal * torch.tensor([1.0, -1.0, -1.0])) / 2
    return torch.where((z_depth > 0)[..., None], colors, _plain(camera))


def wiped(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], share: float
) -> UInt8[np.ndarray, "h w 3"]:
    """Two pictures beside each other with a line between them."""
    edge = round(share * left.shape[1])
    mixed = right.copy()
    mixed[:, :edge] = left[:, :edge]
    mixed[:, max(0, edge - 1) : edge + 1] = _LINE
    return mixed


def _nothing(camera: Cameras) -> RenderOutput:
    """The view of an empty box."""
    plain, zero = _plain(camera), torch.zeros(camera.height, camera.width)
    black = torch.zeros_like(plain)
    return RenderOutput(plain, black, black, zero, zero, Medium(black, black, black))


def _plain(camera: Cameras) -> Float[Tensor, "h w 3"]:
    return (torch.tensor(BACKGROUND) / 255).expand(camera.height, camera.width, 3)


def _pixels(camera: Cameras) -> Float[Tensor, "1 p 2"]:
    return pixel_grid(camera.height, camera.width).reshape(1, -1, 2).double()


def _bytes(image: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    return (image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
