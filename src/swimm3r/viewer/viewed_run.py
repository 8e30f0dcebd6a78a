"""A run as the viewer shows it: its frames and cameras, its cloud, and its map where there is one.

The browser's world has the axes of the map and working units: metres where the run is metric, else thirds of the median
depth, so that a scene of any scale fits the browser's depth buffer. Everything else here is in scene units.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from swimm3r import devices
from swimm3r.cameras import Cameras
from swimm3r.geometry import Similarity, rotation_angle
from swimm3r.imaging.undistortion import undistorted
from swimm3r.io import images
from swimm3r.io.files.cache import ArrayCache
from swimm3r.pipeline.presets import from_yaml
from swimm3r.pipeline.renders import DisplayStyle, display_style
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.run_folder import open_run
from swimm3r.sfm.rectified.run import run_frames
from swimm3r.splat.map_file import load_map
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import MapDevice
from swimm3r.splat.training_poses import as_mapped, axes_of_map
from swimm3r.splat.views import median_z_depth

_WORKING_DEPTH = 3.0  # of the median surface where lengths are not metric, as maps are trained
_CACHE_BYTES = 256 << 20
_THUMBNAIL = 128  # pixels
_FRAME_SIDE = 960  # pixels of a frame shown over the picture


@dataclass(frozen=True)
class FrameImage:
    """A frame without lens distortion, or of a fisheye as it is, with the camera it belongs to."""

    rgb: UInt8[np.ndarray, "h w 3"]
    seen: Bool[np.ndarray, "h w"]  # false where the lens showed nothing
    camera: Cameras


@dataclass(frozen=True)
class ViewedRun:
    """The parts of a run that can be looked at."""

    folder: Path
    frames: Frames
    rec: Reconstruction
    cameras: Cameras  # of the registered frames, in the axes of the map
    scale: float  # working units per scene unit
    scene: SplatMap | None = None
    style: DisplayStyle | None = None  # None without a map
    to_map: Similarity | None = None  # from the axes of the reconstruction; None where they are the same
    cache: ArrayCache = field(default_factory=lambda: ArrayCache(_CACHE_BYTES))

    @property
    def unit(self) -> str:
        """The unit of length, for people."""
        return "m" if self.rec.metric else "scene units"

    @cached_property
    def median_depth(self) -> float:
        """Distance of the middle surface from the cameras, scene units."""
        return _WORKING_DEPTH / self.scale if not self.rec.metric else median_z_depth(self.rec)

    @property
    def has_restored_frames(self) -> bool:
        """Return whether structure from motion restored any frame."""
        return any((self.folder / "sfm" / "restored").rglob("*.png"))  # frames of a rig lie in folders

    def time_of(self, name: str) -> float:
        """Time of a frame, seconds of the clip."""
        return self.frames.times_of([name])[0]

    def nearest(self, cam2world: Float[Tensor, "4 4"]) -> str:
        """The registered frame whose camera is most like a pose: near, and looking the same way."""
        away = torch.linalg.vector_norm(self.cameras.centers - cam2world[:3, 3], dim=-1) / self.median_depth
        turned = rotation_angle(self.cameras.cam2world[:, :3, :3].mT @ cam2world[:3, :3])
        return self.rec.names[int((away + turned).argmin())]

    def frame_image(self, name: str, restored: bool = False) -> FrameImage | None:
        """A frame as filmed, or as structure from motion restored it; None where it did not."""
        path = self.folder / "sfm" / "restored" / f"{name}.png"
        if restored and not path.is_file():
            return None
        lens = self.cameras[self.rec.index(name)]
        canvas = lens.drawn(_FRAME_SIDE)

        def make() -> tuple[np.ndarray, np.ndarray]:
            number = self.frames.index(name)
            stored = _unit_range(images.read_rgb(path)) if restored else self.frames.image(number)
            rgb, seen = undistorted(stored, self.frames.mask(number), lens, canvas)
            return (rgb * 255).round().to(torch.uint8).numpy(), seen.numpy()

        rgb, seen = self.cache.get((name, restored), make)
        return FrameImage(rgb, seen, canvas)

    def thumbnail(self, name: str) -> UInt8[np.ndarray, "h w 3"]:
        """A small copy of a frame as a pinhole has it, which is what the frustum of a camera shows."""
        lens = self.cameras[self.rec.index(name)]

        def make() -> tuple[np.ndarray]:
            image = self.frames.image(self.frames.index(name))
            everything = torch.ones(image.shape[:2], dtype=torch.bool)
            small, _ = undistorted(image, everything, lens, lens.pinhole(_THUMBNAIL))
            return ((small * 255).to(torch.uint8).numpy(),)

        (small,) = self.cache.get((name, "thumbnail"), make)
        return small

    def cloud(self, restored: bool) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
        """The dense cloud, else the sparse points, in the browser's world."""
        cloud = self.rec.cloud
        if cloud is None:
            xyz, colors = self.rec.points.xyz, self.rec.points.rgb
        else:
            xyz, colors = cloud.xyz, cloud.shown(self.rec.white_balance) if restored else cloud.raw
        xyz = xyz.double() if self.to_map is None else self.to_map.points(xyz.double())
        return (xyz * self.scale).numpy(), (colors.clamp(0, 1) * 255).round().to(torch.uint8).numpy()

    def in_axes_of_sfm(self, cam2world: Float[Tensor, "c 4 4"]) -> Float[Tensor, "c 4 4"]:
        """Poses of the map's axes in those of RUN/sfm, as `swimm3r render --path` reads them."""
        return cam2world if self.to_map is None else self.to_map.inverse().poses(cam2world)

    def up(self) -> Float[np.ndarray, "3"]:
        """The direction that is up on average in the frames; against the view in a survey that turns."""
        above = -self.cameras.cam2world[:, :3, 1].mean(0)
        if float(above.norm()) < 0.3:
            above = -self.cameras.cam2world[:, :3, 2].mean(0)
        return (above / above.norm().clamp(min=1e-9)).numpy()


def of_reconstruction(folder: Path, frames: Frames, rec: Reconstruction) -> ViewedRun:
    """A run with structure from motion alone. Raises InputError where it holds no point before a camera."""
    scale = 1.0 if rec.metric else _WORKING_DEPTH / median_z_depth(rec)
    return ViewedRun(folder, frames, rec, rec.cameras, scale)


def with_map(run: ViewedRun, scene: SplatMap, style: DisplayStyle) -> ViewedRun:
    """The same run with its map."""
    cameras = as_mapped(run.rec, scene.poses).cameras
    return replace(run, scene=scene, style=style, cameras=cameras, to_map=axes_of_map(run.rec, scene.poses))


def open_viewed_run(folder: Path, map_device: MapDevice = "auto") -> ViewedRun:
    """Read a run as far as it is finished. Raises InputError where structure from motion is not."""
    record = open_run(folder, "sfm")
    frames = run_frames(folder)
    run = of_reconstruction(folder, frames, load_reconstruction(folder / "sfm", frames))
    if not record.is_finished("splat"):
        return run
    scene = load_map(folder / "splat" / "map.safetensors").to(devices.for_maps(map_device))
    restore = from_yaml(folder / "settings.yaml").sfm.restore
    return with_map(run, scene, display_style(scene, run.rec, restore))


def _unit_range(stored: images.Rgb) -> Float[Tensor, "h w 3"]:
    return torch.from_numpy(stored.astype(np.float32)) / float(np.iinfo(stored.dtype).max)
