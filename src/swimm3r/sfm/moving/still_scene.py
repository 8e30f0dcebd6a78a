"""The small images and measured surfaces of a reconstruction's frames, compared to tell what moves.

Frames are compared at 256 pixels, each with up to 16 others that see the same surfaces, spread over the time in which
they do: an object that moves with the camera stands before the same ground in neighboring frames.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from swimm3r.cameras import Cameras, pixel_grid, project_visible, resized, unproject
from swimm3r.imaging.filters import blur
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.moving.comparison import SmallView
from swimm3r.sfm.moving.objects import ColorSamples, color_models, color_samples, objects
from swimm3r.sfm.moving.occluders import Evidence, Layer, evidence_on, measured_range
from swimm3r.tasks.threads import thread_count

_LONG_SIDE = 256  # of the images that are compared, pixels
_BLUR = 1.0  # pixel, of these images: noise and compression
_OTHERS = 16  # frames that a frame is compared with
_SHARED = 0.05  # of a frame's surface that another one must show to be compared with it
_SAMPLES = 64  # points of a frame's surface that decide this
_EDGE = 0.1  # share of a depth by which it jumps at an edge
_KEPT = 128  # frames in memory, 3 MB each at most
_CORNERS = ((0, 0), (0, 1), (1, 0), (1, 1))  # pixels around a point, which together leave no cracks


@dataclass(frozen=True)
class _Surface:
    """The points that one frame measured, without those beside depth edges."""

    view: SmallView
    xyz: Float[Tensor, "n 3"]  # world
    at: Int[np.ndarray, " n"]  # row-major index of their pixels


@dataclass(frozen=True)
class StillScene:
    """The frames of a reconstruction with the surfaces that they measured, read when asked for; a few are kept."""

    rec: Reconstruction
    frames: Frames
    cameras: Cameras  # of the small images

    @cached_property
    def view(self) -> Callable[[int], SmallView]:
        """The small image of a frame, with its depth."""
        return lru_cache(maxsize=_KEPT)(self._read_view)

    @cached_property
    def _surface(self) -> Callable[[int], _Surface]:
        return lru_cache(maxsize=_KEPT)(self._read_surface)

    @cached_property
    def _samples(self) -> tuple[Float[Tensor, "n 3"], Int[Tensor, " n"]]:
        """A few points of each frame's surface, and the frames they are of."""
        points = []
        for i in range(len(self.rec.names)):
            z_depth = self._z_depth(i)
            at = np.flatnonzero(z_depth)
            points.append(self.points(i, z_depth, at[:: max(1, len(at) // _SAMPLES)]))
        of = torch.repeat_interleave(torch.arange(len(points)), torch.tensor([len(few) for few in points]))
        return torch.cat(points), of

    def moving_in_frames(self, progress: Progress = silent) -> Iterator[Bool[np.ndarray, "h w"]]:
        """The pixels of the small image of each frame, in turn, that show moving objects."""
        count = len(self.rec.names)
        evidence, samples = [], []
        with ThreadPoolExecutor(thread_count()) as pool:
            for i, (found, colors) in enumerate(pool.map(self._evidence_and_colors, range(count))):
                progress("moving objects", i, count)
                evidence.append(found.packed())
                samples.append(colors)
        models = color_models(samples)
        nothing = np.zeros((self.cameras.height, self.cameras.width), dtype=bool)

        def in_frame(i: int, neighbors: Bool[np.ndarray, "h w"] | None = None) -> Bool[np.ndarray, "h w"]:
            view = self.view(i)
            return objects(view.rgb, evidence[i].unpacked(), models, neighbors) & view.usable

        before, here = nothing, in_frame(0)
        for i in range(count):
            after = in_frame(i + 1) if i + 1 < count else nothing
            yield in_frame(i, before | after) if (before | after).any() else here
            before, here = here, after
        progress("moving objects", count, count)

    def moving_in(
        self, lens: Cameras, image: Float[Tensor, "h w 3"], neighbors: Sequence[str] = ()
    ) -> Bool[Tensor, "h w"]:
        """The pixels of another image of the scene, of known pose, that show moving objects.

        Its depth is the nearest that the frames measured on each pixel's ray. Colors of moving objects are its own and
        those under the frames' masks; `neighbors` names the frames before and after, whose masks tell what moves with
        the camera.
        """
        camera = resized(lens, self.cameras.width, self.cameras.height)
        layers = self._layers(camera, _spread(self._overlapping(camera)))
        z_depth = measured_range((camera.height, camera.width), layers).nearest
        view = SmallView(camera, _small(image, camera), z_depth, np.ones_like(z_depth, dtype=bool))
        found = evidence_on(view, layers)
        models = color_models([*self._masked_colors, color_samples(view.rgb, found)])
        beside = [self._masked(self.rec.index(name)) for name in neighbors]
        moving = objects(view.rgb, found, models, np.logical_or.reduce(beside) if beside else None)
        return enlarged(moving, lens.height, lens.width)

    @cached_property
    def _masked_colors(self) -> list[ColorSamples]:
        """Colors under the masks of frames, and of the surfaces that these frames measured beside them."""
        if self.rec.moving is None:
            return []
        samples = []
        for i in _spread([i for i, name in enumerate(self.rec.names) if name in self.rec.moving]):
            view, moving = self.view(i), self._masked(i)
            samples.append(color_samples(view.rgb, Evidence(moving, ~moving & (view.z_depth > 0))))
        return samples

    def _masked(self, i: int) -> Bool[np.ndarray, "h w"]:
        """The pixels of the small image of frame `i` that its mask says to move."""
        still = self._small_grid(self.rec.still(self.frames).mask(self.frames.index(self.rec.names[i])).numpy())
        return self.view(i).usable & ~still

    def _evidence_and_colors(self, i: int) -> tuple[Evidence, ColorSamples]:
        """Pixels of a frame on which other frames decide, and some of their colors."""
        view = self.view(i)
        found = evidence_on(view, self._layers(self.cameras[i], self.others(i)))
        return found, color_samples(view.rgb, found)

    def others(self, i: int) -> list[int]:
        """Up to 16 frames that see the same surfaces as frame `i`, spread over the time in which they do."""
        return _spread([j for j in self._overlapping(self.cameras[i]) if j != i])

    def _overlapping(self, camera: Cameras) -> list[int]:
        """The frames whose surfaces a camera sees."""
        points, of = self._samples
        visible = project_visible(camera, points[None])[2][0]
        seen, total = (torch.bincount(rows, minlength=len(self.rec.names)) for rows in (of[visible], of))
        return ((total > 0) & (seen >= _SHARED * total)).nonzero()[:, 0].tolist()

    def _layers(self, camera: Cameras, others: Sequence[int]) -> list[Layer]:
        return [_layer(camera, self._surface(j)) for j in others]

    def _read_view(self, i: int) -> SmallView:
        f = self.frames.index(self.rec.names[i])
        usable = self._small_grid(self.frames.mask(f).numpy())
        camera = self.cameras[i]
        return SmallView(camera, _small(self.frames.image(f), camera), self._z_depth(i), usable)

    def _read_surface(self, i: int) -> _Surface:
        view = self.view(i)
        known = np.flatnonzero((view.z_depth > 0) & ~beside_edges(view.z_depth))
        return _Surface(view, self.points(i, view.z_depth, known), known)

    def _z_depth(self, i: int) -> Float[np.ndarray, "h w"]:
        return self._small_grid(self.rec.depth[self.rec.names[i]].z_depth.numpy())

    def points(self, i: int, z_depth: Float[np.ndarray, "h w"], at: Int[np.ndarray, " n"]) -> Float[Tensor, "n 3"]:
        """World points of some pixels, by their row-major index."""
        camera = self.cameras[i]
        pixels = pixel_grid(camera.height, camera.width).reshape(-1, 2)[at]
        return unproject(camera, pixels[None].double(), torch.from_numpy(z_depth.reshape(-1)[at])[None].double())[0]

    def _small_grid(self, values: np.ndarray) -> np.ndarray:
        """The values of a frame's pixels nearest to those of its small image."""
        sizes = zip((self.cameras.height, self.cameras.width), values.shape, strict=True)
        rows, columns = (((np.arange(small) + 0.5) * full / small).astype(int) for small, full in sizes)
        return values[np.ix_(rows, columns)]


def still_scene(rec: Reconstruction, frames: Frames) -> StillScene:
    """The registered frames at a small size."""
    scale = min(1.0, _LONG_SIDE / max(frames.width, frames.height))
    width, height = max(8, round(scale * frames.width)), max(8, round(scale * frames.height))
    return StillScene(rec, frames, resized(rec.cameras, width, height))


def _small(image: Float[Tensor, "h w 3"], camera: Cameras) -> Float[np.ndarray, "sh sw 3"]:
    import cv2

    size = (camera.width, camera.height)
    return blur(torch.from_numpy(cv2.resize(image.numpy(), size, interpolation=cv2.INTER_AREA)), _BLUR).numpy()


def enlarged(mask: Bool[np.ndarray, "sh sw"], height: int, width: int) -> Bool[Tensor, "h w"]:
    """A mask at the size of the frames, its border halfway between the small image's pixels."""
    import cv2

    return torch.from_numpy(cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0.5)


def beside_edges(z_depth: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The pixels beside which depth jumps: dense depth puts edges a pixel or two away from where they are."""
    import cv2

    around = np.ones((3, 3), np.uint8)
    nearest = cv2.erode(np.where(z_depth > 0, z_depth, np.inf).astype(np.float32), around)
    return cv2.dilate(z_depth, around) / (1 + _EDGE) > nearest


def _layer(camera: Cameras, surface: _Surface) -> Layer:
    """A frame's surface in another image: the nearest point at each pixel."""
    uv, z, visible = (part[0].numpy() for part in project_visible(camera, surface.xyz[None]))
    uv, z, at = uv[visible], z[visible].astype(np.float32), surface.at[visible]
    far_to_near = np.argsort(-z)
    around = np.floor(uv[far_to_near, None] - 0.5).astype(np.int64) + np.array(_CORNERS)
    point, (column, row) = far_to_near.repeat(len(_CORNERS)), around.reshape(-1, 2).T
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    nearest = np.full(camera.height * camera.width, -1)
    nearest[(row * camera.width + column)[inside]] = point[inside]  # of several points the last, which is the nearest
    pixel = np.flatnonzero(nearest >= 0)
    return Layer(surface.view, at[nearest[pixel]], pixel, z[nearest[pixel]])


def _spread(frames: Sequence[int]) -> list[int]:
    """A few of the frames, evenly spread."""
    if not frames:
        return []
    at = np.unique(np.linspace(0, len(frames) - 1, min(_OTHERS, len(frames))).round().astype(int))
    return [frames[k] for k in at]
