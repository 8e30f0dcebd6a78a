"""Training views of a map: undistorted images of one size, their masks and depth, in working units.

Every frame becomes a pinhole image with its own K at the training size. Depth along the optical axis is the same
number on both grids. Where it is unknown and a surface is shown, it is guessed from its surroundings, if training asks
for that. Time runs from 0 at the clip's first frame to 1 at its last, test frames included. Pixels
that the frame does not show, or its mask excludes, are not `seen` and take no part in any loss; of values that are
clipped a rendering may be brighter.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from swimm3r.appearance import FrameColors
from swimm3r.cameras import Cameras, image_directions, pixel_grid, resized, unproject
from swimm3r.devices import CPU
from swimm3r.errors import InputError
from swimm3r.imaging.clipped import clipped
from swimm3r.imaging.depth_completion import fill_z_depth, unlike
from swimm3r.imaging.open_water import sea_share, without_fringe
from swimm3r.imaging.undistortion import nearest_pixels, undistorted
from swimm3r.io.files.cache import ArrayCache
from swimm3r.scene.frames import Frames
from swimm3r.scene.point_groups import PointGroups
from swimm3r.scene.reconstruction import DepthMap, Reconstruction
from swimm3r.splat.ground import Window
from swimm3r.splat.settings import SplatSettings

_MEASURED = 0.1  # share of an image below which its known depth is too little to tell water from the rest
_STEP = 4  # pixels between those of which filled-in depth is kept
_CONFIDENCE = 0.5  # of known depth beside that of other images, where unknown depth is guessed


@dataclass(frozen=True)
class TrainingView:
    """One training image."""

    name: str
    camera: Cameras  # one pinhole, working units
    rgb: Float[Tensor, "3 h w"]  # in the colors that the dive has on average (`swimm3r.appearance`)
    seen: Bool[Tensor, "h w"]
    z_depth: Float[Tensor, "h w"]  # working units, 0 = unknown
    open_water: Bool[Tensor, "h w"]  # looks past every surface; nowhere where depth is not read
    time: Float[Tensor, ""] | None = None  # of the clip, 0..1; static maps do not ask
    clipped: Bool[Tensor, "3 h w"] | None = None  # None where no value is
    guessed_z_depth: Float[Tensor, "h w"] | None = None  # working units, 0 where depth is known or none; None unasked

    def compared(self, render: Float[Tensor, "3 h w"]) -> Bool[Tensor, "h w"] | Bool[Tensor, "3 h w"]:
        """Mask of the values that a rendering has to match: those seen, but clipped ones that it exceeds."""
        return self.seen if self.clipped is None else self.seen & ~(self.clipped & (render.detach() > self.rgb))

    @property
    def measured(self) -> Bool[Tensor, "h w"]:
        """Pixels seen whose colors are known in every channel."""
        return self.seen if self.clipped is None else self.seen & ~self.clipped.any(0)

    @property
    def surface(self) -> Bool[Tensor, "h w"]:
        """Pixels that show a surface: of known depth, or, where a tenth of the image has one, not open water."""
        known = self.z_depth > 0
        return known | (self.seen & ~self.open_water & (known.float().mean() >= _MEASURED))


class TrainingViews:
    """The registered training frames as views; images are made when asked for and kept in a bounded cache."""

    def __init__(
        self,
        rec: Reconstruction,
        frames: Frames,
        settings: SplatSettings,
        scale: float,
        window: Window | None = None,
        colors: FrameColors | None = None,
    ) -> None:
        self.colors = colors  # of single frames; None where all have the dive's
        self.rec, self.frames, self.settings, self.scale, self.window = rec, frames, settings, scale, window
        self._times = {frame.name: normalized_time(frames.span, frame.time) for frame in frames}
        train = {frame.name for frame in frames.train}
        self.names = tuple(name for name in rec.names if name in train)
        if not self.names:
            raise InputError(
                "None of the training frames is registered in the reconstruction.",
                cause="the reconstruction was made of other images, or its names differ",
                hint="the folder of images the reconstruction was made of",
            )
        self._cache = ArrayCache(max_bytes=768 << 20)
        self._filled: dict[str, Tensor] = {}  # small, and takes longer to make than all else of a view

    @property
    def times(self) -> list[float]:
        """Times of the views, 0..1 of the clip."""
        return [float(self._times[name]) for name in self.names]

    def __len__(self) -> int:
        return len(self.names)

    @property
    def cameras(self) -> Cameras:
        """The views' pinhole cameras, working units."""
        lenses = self.rec.cameras[[self.rec.index(name) for name in self.names]]
        return _in_working_units(lenses.drawn(self.settings.long_side), self.scale)

    def __getitem__(self, k: int) -> TrainingView:
        return self.on(CPU, k)

    def on(self, device: torch.device, k: int) -> TrainingView:
        """A view whose image is on a device, made there from what is kept of it; its camera stays with the poses."""
        name = self.names[k]
        i = self.rec.index(name)
        lens = self.rec.cameras[i]
        canvas = lens.drawn(self.settings.long_side)

        def make() -> tuple[np.ndarray, ...]:
            f = self.frames.index(name)
            rgb, seen = undistorted(self.frames.image(f), self.frames.mask(f), lens, canvas)
            stored = (rgb * 255).round().to(torch.uint8).permute(2, 0, 1).contiguous().numpy()
            z_depth, open_water = self._depth(name, lens, canvas, rgb, seen)
            if self.window is not None:
                inside = self._inside(self.window, canvas, z_depth) | open_water
                seen, z_depth = seen & inside, torch.where(inside, z_depth, 0.0)
            full = np.asarray(bool(clipped(torch.from_numpy(stored) / 255).any()))
            if self.settings.guesses_depth and name not in self._filled:
                row, column = nearest_pixels(lens, canvas)
                ground = seen & ~open_water & self._still.mask(f)[row, column]
                self._filled[name] = self._filled_in(canvas, rgb, ground, z_depth)
            return stored, seen.numpy(), z_depth.half().numpy(), open_water.numpy(), full

        *kept, full = self._cache.get(name, make)
        stored, seen, z_depth, open_water = (torch.tensor(values, device=device) for values in kept)
        rgb = stored.float() / 255
        guessed = None
        if self.settings.guesses_depth:
            everywhere = _enlarged(self._filled[name].to(device).float(), *z_depth.shape)
            guessed = torch.where(seen & ~open_water & (z_depth == 0), everywhere, 0.0)
        return TrainingView(
            name,
            _in_working_units(canvas, self.scale),
            rgb if self.colors is None else self.colors.common(name, rgb),
            seen,
            z_depth.float(),
            open_water,
            self._times[name].to(device),
            clipped(rgb) if full else None,
            guessed,
        )

    def _filled_in(
        self, canvas: Cameras, rgb: Float[Tensor, "h w 3"], ground: Bool[Tensor, "h w"], z_depth: Float[Tensor, "h w"]
    ) -> Float[Tensor, "rows columns"]:
        """Depth of ground from what is known beside it and from what other images measured, at every `_STEP`-th pixel;
        0 elsewhere, where too little is known, and where colors are of another thing than what is known around them.
        """
        few = [(torch.arange(0, size, _STEP) + _STEP // 2).clamp(max=size - 1) for size in z_depth.shape]
        known = z_depth > 0
        if float(known.float().mean()) < _MEASURED:
            return torch.zeros(len(few[0]), len(few[1]), dtype=torch.float16)
        depth = DepthMap(z_depth, _CONFIDENCE * known.float())
        elsewhere = None if self._cloud is None else self._cloud.z_depth(canvas) * self.scale
        filled = fill_z_depth(rgb, depth, 1 - ground.float(), elsewhere)
        told = ground & ~unlike(rgb, known, ground & ~known)
        return torch.where(told, filled, 0.0)[few[0][:, None], few[1]].half()

    @cached_property
    def _still(self) -> Frames:
        """The frames with masks of what moves, which dynamic maps show."""
        return self.rec.still(self.frames)

    @cached_property
    def _cloud(self) -> PointGroups | None:
        """Points that any image measured; None of a reconstruction without a dense cloud."""
        return None if self.rec.cloud is None else PointGroups(self.rec.cloud.xyz)

    def _depth(
        self, name: str, lens: Cameras, canvas: Cameras, rgb: Float[Tensor, "h w 3"], seen: Bool[Tensor, "h w"]
    ) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
        """Depth, and where there is none to be known because the image shows open water."""
        if not self.settings.reads_depth or name not in self.rec.depth:
            nothing = torch.zeros(canvas.height, canvas.width)
            return nothing, nothing > 0
        row, column = nearest_pixels(lens, canvas)
        z_depth = self.rec.depth[name].z_depth[row, column]
        known = seen & z_depth.isfinite() & (z_depth > 0)
        z_depth = torch.where(known, z_depth * self.scale, 0.0)
        fit = self.rec.medium
        if fit is None:
            return z_depth, (sea_share(rgb, z_depth) > 0.5) & seen
        veil = fit.open_water(normalize(image_directions(canvas).float(), dim=-1))
        z_depth = without_fringe(rgb, z_depth, veil)
        return z_depth, (sea_share(rgb, z_depth, veil) > 0.5) & seen

    def _inside(self, window: Window, canvas: Cameras, z_depth: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
        """Mask of the pixels whose surface lies over a window; where depth is unknown it is that of the next pixel."""
        z = filled(z_depth)
        if z is None:
            return torch.ones_like(z_depth, dtype=torch.bool)
        pixels = pixel_grid(canvas.height, canvas.width).reshape(1, -1, 2).double()
        points = unproject(canvas, pixels, z.reshape(1, -1).double() / self.scale)[0]
        return window.holds(points).reshape(z_depth.shape)


def filled(z_depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"] | None:
    """A depth map whose unknown pixels have the depth of the nearest known one; None where none is known."""
    unknown = (z_depth <= 0) | ~z_depth.isfinite()
    if bool(unknown.all()):
        return None
    if not bool(unknown.any()):
        return z_depth
    nearest = distance_transform_edt(unknown.numpy(), return_distances=False, return_indices=True)
    row, column = torch.from_numpy(np.asarray(nearest)).long()
    return z_depth[row, column]


def smaller(view: TrainingView, divisor: int) -> TrainingView:
    """A view of fewer pixels: colors are means of those a pixel covers, depth and open water those at its center."""
    if divisor == 1:
        return view
    height, width = (max(2, size // divisor) for size in view.seen.shape)
    rgb = interpolate(view.rgb[None], (height, width), mode="area")[0]
    seen = interpolate(view.seen[None, None].float(), (height, width), mode="area")[0, 0] > 0.999
    row, column = (
        ((torch.arange(few, device=view.seen.device) + 0.5) * (many / few)).long()
        for few, many in zip((height, width), view.seen.shape, strict=True)
    )
    z_depth, open_water = (values[row[:, None], column] for values in (view.z_depth, view.open_water))
    full = None
    if view.clipped is not None:
        full = interpolate(view.clipped[None].float(), (height, width), mode="area")[0] > 0
    camera = resized(view.camera, width, height)
    guessed = None if view.guessed_z_depth is None else view.guessed_z_depth[row[:, None], column]
    return TrainingView(view.name, camera, rgb, seen, z_depth, open_water, view.time, full, guessed)


def _enlarged(small: Float[Tensor, "rows columns"], height: int, width: int) -> Float[Tensor, "h w"]:
    """An image of every `_STEP`-th pixel at the size that it was taken from."""
    return small.repeat_interleave(_STEP, 0).repeat_interleave(_STEP, 1)[:height, :width]


def _in_working_units(cameras: Cameras, scale: float) -> Cameras:
    cam2world = cameras.cam2world.clone()
    cam2world[:, :3, 3] *= scale
    return replace(cameras, cam2world=cam2world)


def normalized_time(span: tuple[float, float], time: float) -> Float[Tensor, ""]:
    """A time in seconds of a clip that lasts from span[0] to span[1], as maps take it: 0..1."""
    start, end = span
    return torch.tensor((time - start) / (end - start) if end > start else 0.0)


def working_scale(rec: Reconstruction, settings: SplatSettings) -> float:
    """Working units per scene unit: 1 for a metric reconstruction, else what gives the scene its `working_depth`."""
    return 1.0 if rec.metric else settings.working_depth / median_z_depth(rec)


def median_z_depth(rec: Reconstruction) -> float:
    """Median z depth of the sparse points in the frames that track them; of all points in all frames without tracks."""
    z = rec.point_depths()
    if not len(z):
        raise InputError(
            "The reconstruction has no point in front of a camera.",
            cause="it holds poses alone, or its axes are not OpenCV's",
            hint="a reconstruction with sparse points",
        )
    return float(z.median())
