"""A finished run as products read it: frames with depth, their surface points, and their images, one at a time."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float

from swimm3r.cameras import Cameras, resized
from swimm3r.errors import InputError
from swimm3r.imaging.undistortion import frame_rays
from swimm3r.io import images
from swimm3r.io.files.cache import ArrayCache
from swimm3r.scene.frames import Frames
from swimm3r.scene.georeference import Georeference, load_georeference, local_georeference
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.run_folder import open_run
from swimm3r.sfm.rectified.run import run_frames

Colors = Literal["filmed", "restored", "physical"]
"""With the water, in one exposure and white balance where frames were restored in one; without the water, as shown;
without the water, before the white balance."""
FOLDERS: dict[Colors, str] = {"restored": "restored", "physical": "restored_physical"}
_FARTHEST = 4.0  # median depths of the dive beyond which depth is left out: it is as imprecise as its square
_SAMPLED = 32  # pixels along the long side of a depth map that stand for it in an overview
_CACHE = ArrayCache(max_bytes=384 << 20, least_entries=8)


@dataclass(frozen=True)
class SurfacePoints:
    """The pixels of one depth map in the local frame."""

    xyz: Float[np.ndarray, "h w 3"]
    z_depth: Float[np.ndarray, "h w"]  # along the optical axis, local units
    confidence: Float[np.ndarray, "h w"]
    usable: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class Survey:
    """One run, in the local frame of its georeference: z up, in metres where the scale is known."""

    folder: Path
    rec: Reconstruction
    frames: Frames
    place: Georeference

    @cached_property
    def indices(self) -> tuple[int, ...]:
        """The registered frames that have depth. Raises InputError where none has."""
        found = tuple(i for i, name in enumerate(self.rec.names) if name in self.rec.depth)
        if not found:
            raise InputError(
                f"{self.folder} has no depth maps, of which products are made",
                cause="they were removed, or the run was stopped before dense depth",
                hint=f"swimm3r run {self.folder}, which makes what is missing",
            )
        return found

    @property
    def scale(self) -> float:
        """Local units per unit of the run's files."""
        return self.place.scale or 1.0

    @cached_property
    def centers(self) -> Float[np.ndarray, "c 3"]:
        """Centers of all cameras, local."""
        return self.place.to_local(self.rec.cameras.centers.numpy())

    @cached_property
    def overview(self) -> dict[int, Float[np.ndarray, "n 3"]]:
        """A few surface points of each frame with depth, local; frames whose maps are empty are left out."""
        found = {}
        for i in self.indices:
            points = self.points(i, sampled=True)
            if points.usable.any():
                found[i] = points.xyz[points.usable]
        return found

    @cached_property
    def deepest(self) -> float:
        """The z depth beyond which depth is left out, local."""
        medians = []
        for i in self.indices:
            z = self.rec.depth[self.rec.names[i]].z_depth
            if bool((z > 0).any()):
                medians.append(float(z[z > 0].median()))
        return _FARTHEST * float(np.median(medians)) * self.scale if medians else np.inf

    @cached_property
    def footprint(self) -> float:
        """Median size of an image's pixel on the surface, local units. Raises InputError where no frame has depth."""
        found = []
        for i in self.overview:
            points, K = self.points(i, sampled=True), self.rec.cameras.K[i]
            found.append(float(np.median(points.z_depth[points.usable])) / float(torch.sqrt(K[0, 0] * K[1, 1])))
        if not found:
            raise InputError(
                f"the depth maps of {self.folder} are empty",
                cause="no surface was confirmed by a second frame, or masks exclude all of it",
                hint="frames with more overlap; masks of less",
            )
        return float(np.median(found))

    def points(self, i: int, *, sampled: bool = False) -> SurfacePoints:
        """The surface that a frame's depth map is of; `sampled`: a few pixels of it."""
        name = self.rec.names[i]
        depth, usable = self.rec.depth[name], self.frames.mask(self.frames.index(name))
        height, width = depth.z_depth.shape
        step = max(1, max(height, width) // _SAMPLED) if sampled else 1
        camera = self.camera(i, width, height)
        rays = frame_rays(camera).numpy()[::step, ::step].astype(np.float64)
        z = depth.z_depth.numpy()[::step, ::step]
        pose = camera.cam2world[0].numpy().astype(np.float64)
        world = (rays * z[..., None]) @ pose[:3, :3].T + pose[:3, 3]
        local_z = z * self.scale
        seen = (z > 0) & (local_z <= self.deepest)
        seen &= _resized_mask(usable.numpy(), width, height)[::step, ::step]
        return SurfacePoints(self.place.to_local(world), local_z, depth.confidence.numpy()[::step, ::step], seen)

    def camera(self, i: int, width: int, height: int) -> Cameras:
        """The camera of a frame on images of another size."""
        lens = self.rec.cameras[i]
        return lens if (lens.width, lens.height) == (width, height) else resized(lens, width, height)

    def has(self, colors: Colors) -> bool:
        """Return whether the run has images of a kind."""
        return colors == "filmed" or any(self._path(colors, i).is_file() for i in self.indices)

    def image(self, colors: Colors, i: int) -> Float[np.ndarray, "h w 3"] | None:
        """The image of a frame, 0..1, float32; None where there is none of that kind."""
        if colors == "filmed":
            return self._evened.image(self._evened.index(self.rec.names[i])).clamp(0, 1).numpy()
        path = self._path(colors, i)
        if not path.is_file():
            return None
        (stored,) = _CACHE.get((path, path.stat().st_mtime_ns), lambda: (images.read_rgb(path),))
        return stored.astype(np.float32) / (255 if stored.dtype == np.uint8 else 65535)

    @cached_property
    def _evened(self) -> Frames:
        return self.rec.evened(self.frames)

    def usable(self, i: int) -> Bool[np.ndarray, "h w"]:
        """True where the image of a frame may be used."""
        return self.frames.mask(self.frames.index(self.rec.names[i])).numpy()

    def _path(self, colors: Colors, i: int) -> Path:
        return self.folder / "sfm" / FOLDERS[colors] / f"{self.rec.names[i]}.png"


def open_survey(folder: Path) -> Survey:
    """A run with finished structure from motion. Raises InputError where it has not come so far, or is damaged."""
    open_run(folder, "sfm")
    frames = run_frames(folder)
    rec = load_reconstruction(folder / "sfm", frames)
    return Survey(folder, rec, rec.still(frames), load_georeference(folder) or local_georeference(rec))


def _resized_mask(usable: Bool[np.ndarray, "h w"], width: int, height: int) -> Bool[np.ndarray, "*n"]:
    if usable.shape == (height, width):
        return usable
    import cv2

    return cv2.resize(usable.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
