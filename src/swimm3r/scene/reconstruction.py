"""The result of structure from motion: the one record that every back end fills and every later stage reads.

On disk (`Reconstruction.save`, `reconstruction_io.load_reconstruction`) it is a folder: sparse/ (COLMAP model),
cameras.json, trajectory.tum, z_depth/NAME.npz, masks/NAME.png (0 at moving objects), steady/NAME.png (frames without
the flicker of the sun), matches.npz, medium.json, white_balance.json, frame_colors.json (of frames in exposures of
their own), reconstruction.json (back end, metric flag, warnings, points found), and the dense cloud in three colors,
points.ply (as shown: restored and white-balanced), points_physical.ply (restored) and points_raw.ply (as filmed);
backdrop.ply and its two are ground at a guessed depth. Of frames that take no part, `reconstruct` writes poses beside
it: cameras_between.json those between keyframes, cameras_imported.json all that an imported model places.
"""

import json
import shutil
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from swimm3r import notebook
from swimm3r.appearance import FrameColors
from swimm3r.cameras import Cameras, project, rows_of_frames
from swimm3r.io import ply
from swimm3r.io.colmap import model as colmap
from swimm3r.io.files.array_file import Layout, read_arrays, write_arrays
from swimm3r.io.files.atomic import atomic_path, write_text
from swimm3r.io.files.cache import ArrayCache
from swimm3r.io.files.damage import remake
from swimm3r.io.files.outputs import check_empty
from swimm3r.io.trajectory import write_tum
from swimm3r.lamp import Lamp, rescaled_lamp
from swimm3r.medium import MediumFit, save_fits
from swimm3r.scene.frame_changes import OWN_COLORS, STEADY, MovingMasks, SteadyFrames, save_own_colors
from swimm3r.scene.frames import MASKS, Frames
from swimm3r.scene.rig import RigFit
from swimm3r.scene.white_balance import UNBALANCED, WHITE_BALANCE, WhiteBalance

_CACHE = ArrayCache(max_bytes=256 << 20, least_entries=20)
_SHOWN_WARNINGS = 10  # in a notebook
_DEPTH = {"z_depth": Layout("h w"), "confidence": Layout("h w")}


@dataclass(frozen=True)
class Points:
    """Sparse points with the colors they have in the images."""

    xyz: Float[Tensor, "p 3"]  # world, float64
    rgb: Float[Tensor, "p 3"]  # raw, 0..1
    error: Float[Tensor, " p"]  # mean reprojection error, pixels

    def __repr__(self) -> str:
        return notebook.shapes(self)


@dataclass(frozen=True)
class Tracks:
    """Observations of points in frames, one row each."""

    point: Int[Tensor, " o"]  # index into Points
    frame: Int[Tensor, " o"]  # index into Reconstruction.names
    xy: Float[Tensor, "o 2"]  # pixels of the prepared frame

    def __repr__(self) -> str:
        return notebook.shapes(self)


@dataclass(frozen=True)
class Matches:
    """Two-view correspondences that survived geometric verification: one row each."""

    i: Int[Tensor, " m"]  # index into Reconstruction.names
    j: Int[Tensor, " m"]
    xy_i: Float[Tensor, "m 2"]  # pixels of the prepared frames
    xy_j: Float[Tensor, "m 2"]
    confidence: Float[Tensor, " m"]  # 1 for verified feature matches, the network's own for learned ones

    def __repr__(self) -> str:
        return notebook.shapes(self)

    def save(self, path: Path) -> None:
        """Write them as NumPy arrays, whole or not at all."""
        with atomic_path(path) as draft:
            np.savez_compressed(draft, **{name: tensor.numpy() for name, tensor in vars(self).items()})


@dataclass(frozen=True)
class DepthMap:
    """Dense depth of one frame; 0 where nothing is known."""

    z_depth: Float[Tensor, "h w"]  # along the optical axis, scene units
    confidence: Float[Tensor, "h w"]  # 0..1

    def __repr__(self) -> str:
        return notebook.shapes(self)


@dataclass(frozen=True)
class DepthMaps:
    """Depth maps kept on disk, one NAME.npz per frame."""

    folder: Path

    def path(self, name: str) -> Path:
        """Path of a frame's depth map."""
        return self.folder / f"{name}.npz"

    def __contains__(self, name: str) -> bool:
        return self.path(name).is_file()

    def __getitem__(self, name: str) -> DepthMap:
        def load() -> tuple[np.ndarray, np.ndarray]:
            stored = read_arrays(self.path(name), _DEPTH, remake(self.folder.parent))
            return stored["z_depth"], stored["confidence"]

        path = self.path(name)
        version = path.stat().st_mtime_ns if path.is_file() else 0  # a map that was made anew is read anew
        z_depth, confidence = _CACHE.get((path, version), load)
        return DepthMap(torch.from_numpy(z_depth.astype(np.float32)), torch.from_numpy(confidence.astype(np.float32)))

    def write(self, name: str, depth: DepthMap) -> None:
        """Store the map of a frame: depth as float32, confidence as float16."""
        path = self.path(name)
        with atomic_path(path) as draft:
            write_arrays(
                draft,
                z_depth=depth.z_depth.numpy().astype(np.float32),
                confidence=depth.confidence.numpy().astype(np.float16),
            )


@dataclass(frozen=True)
class DenseCloud:
    """Dense points: their colors in the water, and with the water removed."""

    xyz: Float[Tensor, "n 3"]
    raw: Float[Tensor, "n 3"]  # 0..1
    restored: Float[Tensor, "n 3"]  # physical; beyond 1 where surfaces would be brighter than white without the water

    def shown(self, balance: WhiteBalance) -> Float[Tensor, "n 3"]:
        """The colors for people to look at, like the restored frames."""
        return balance.shown(self.restored, self.raw)

    def __repr__(self) -> str:
        return notebook.shapes(self)


@dataclass(frozen=True)
class QualityWarning:
    """Something about the result that its user should know, in plain words."""

    what: str
    advice: str


@dataclass(frozen=True)
class Reconstruction:
    """Cameras, points, tracks, two-view matches, dense depth and water of the registered frames of a dive."""

    names: tuple[str, ...]  # registered frames; everything is indexed by their order
    cameras: Cameras
    points: Points
    tracks: Tracks
    matches: Matches
    depth: DepthMaps
    backend: str
    metric: bool = False
    medium: MediumFit | None = None  # on pixel values as stored, what the pipeline uses
    medium_linear: MediumFit | None = None  # in linear light, what the water table shows
    cloud: DenseCloud | None = None  # fused from the depth maps; colors averaged over each point's track
    backdrop: DenseCloud | None = None  # ground filmed but not measured, at a guessed depth, for maps to start on
    warnings: tuple[QualityWarning, ...] = ()
    white_balance: WhiteBalance = UNBALANCED  # of everything that is shown
    points_found: int | None = None  # sparse ones, before the settings' cap; None: nothing was left out
    up: tuple[float, float, float] | None = None  # away from the earth, where the camera measured it; world axes
    rig: RigFit | None = None  # of a clip of several cameras that are fixed to each other
    moving: MovingMasks | None = None  # None: moving objects were not looked for
    steady: SteadyFrames | None = None  # None: the light does not flicker, or was kept
    own_colors: FrameColors | None = None  # None: one exposure and white balance, or frames were restored as filmed

    def __repr__(self) -> str:
        dense = "" if self.cloud is None else f", {len(self.cloud.xyz):,} dense points"
        unit = "metres" if self.metric else "scene units"
        water = "no water" if self.medium is None else f"water by {self.medium.estimator}"
        return (
            f"Reconstruction({len(self.names)} frames by {self.backend}, {len(self.points.xyz):,} points{dense},\n"
            f"  {unit}, {water}, {len(self.warnings)} warnings)"
        )

    def _repr_html_(self) -> str:
        """Tables of what was found, of the water, and of the warnings."""
        with_depth = sum(name in self.depth for name in self.names)
        rows = [
            ("frames registered", f"{len(self.names)}, {with_depth} of them with depth"),
            ("cameras", repr(self.cameras)),
            ("sparse points", f"{len(self.points.xyz):,}, {len(self.tracks.point):,} observations"),
            ("matches", f"{len(self.matches.i):,}"),
            ("dense points", "none" if self.cloud is None else f"{len(self.cloud.xyz):,}"),
            ("unit of length", "metre" if self.metric else "of the scene, not metric"),
        ]
        parts = [notebook.table(f"Reconstruction by {self.backend}", rows)]
        if self.medium is not None:
            parts.append(self.medium.table("1/m" if self.metric else "per scene unit"))
        if self.warnings:
            shown = [(each.what, each.advice) for each in self.warnings[:_SHOWN_WARNINGS]]
            parts.append(notebook.table(f"{len(self.warnings)} warnings", shown))
        return f"<div>{''.join(parts)}</div>"

    def lamp(self, scale: float) -> Lamp | None:
        """The lamp on the camera, with lengths times `scale`; None in daylight."""
        lamp = None if self.medium is None else self.medium.lamp
        return None if lamp is None else rescaled_lamp(lamp, scale)

    def still(self, frames: Frames) -> Frames:
        """The frames with masks of moving objects, where these were looked for, and in steady light."""
        masked = frames if self.moving is None else self.moving.on(frames)
        return masked if self.steady is None else self.steady.on(masked)

    def evened(self, frames: Frames) -> Frames:
        """The same in the dive's common exposure and white balance: the frames that restored ones are made from."""
        return replace(self.still(frames), own_colors=self.own_colors)

    def index(self, name: str) -> int:
        """The position of a registered frame by its name."""
        return self.names.index(name)

    def point_depths(self) -> Float[Tensor, " n"]:
        """z depths of the sparse points in the frames that track them; without tracks, of all points in all frames.

        Those behind a camera are left out.
        """
        depths = []
        for i, rows in enumerate(rows_of_frames(self.tracks.frame, len(self.names))):
            mine = self.tracks.point[rows]
            points = self.points.xyz[mine] if len(self.tracks.point) else self.points.xyz
            depths.append(project(self.cameras[i], points[None])[1][0])
        z = torch.cat(depths)
        return z[z > 0]

    def colmap_model(self) -> colmap.ColmapModel:
        """Cameras, points and tracks as io/colmap writes them."""
        return colmap.ColmapModel(
            names=self.names,
            model=self.cameras.model,
            width=self.cameras.width,
            height=self.cameras.height,
            K=self.cameras.K.numpy(),
            distortion=self.cameras.distortion.numpy(),
            cam2world=self.cameras.cam2world.numpy(),
            xyz=self.points.xyz.numpy(),
            rgb=(self.points.rgb.numpy() * 255).round().astype(np.uint8),
            error=self.points.error.numpy(),
            track_point=self.tracks.point.numpy(),
            track_frame=self.tracks.frame.numpy(),
            track_xy=self.tracks.xy.numpy(),
        )

    def save(self, folder: str | Path, frames: Frames | None = None) -> None:
        """Write everything into a folder, depth maps included; `swimm3r.load_reconstruction` reads it.

        With the `frames` it was made from, cameras.json has their times, and trajectory.tum is written. The folder is
        new or empty, or the one that already holds the depth maps. Raises StorageError where other things lie there.
        """
        folder = Path(folder)
        self._place_depth(folder)
        if self.moving is not None:
            self.moving.copy(folder / MASKS)
        if self.steady is not None:
            self.steady.copy(folder / STEADY)
        times = None if frames is None else frames.times_of(self.names)
        colmap.write_model(folder / "sparse", self.colmap_model())
        if times is not None:
            write_tum(folder / "trajectory.tum", times, self.cameras.cam2world.numpy())
        units = "metres" if self.metric else "scene units"
        self.cameras.save(folder / "cameras.json", self.names, times, units)
        self.matches.save(folder / "matches.npz")
        fits = {"stored": self.medium, "linear": self.medium_linear}
        save_fits(folder / "medium.json", {name: fit for name, fit in fits.items() if fit is not None})
        for stem, cloud in (("points", self.cloud), ("backdrop", self.backdrop)):
            if cloud is not None:
                colors = {"": cloud.shown(self.white_balance), "_physical": cloud.restored, "_raw": cloud.raw}
                for kind, rgb in colors.items():
                    ply.write_points(folder / f"{stem}{kind}.ply", cloud.xyz.numpy(), rgb.numpy())
        self.white_balance.save(folder / WHITE_BALANCE)
        if self.own_colors is not None:
            save_own_colors(folder / OWN_COLORS, self.own_colors)
        about = {"backend": self.backend, "metric": self.metric, "warnings": [vars(each) for each in self.warnings]}
        about["points_found"] = self.points_found
        about["up"] = self.up
        about["rig"] = None if self.rig is None else asdict(self.rig)
        write_text(folder / "reconstruction.json", json.dumps(about, indent=2) + "\n")

    def _place_depth(self, folder: Path) -> None:
        """Copy the depth maps into a folder that is to hold the reconstruction, unless they are there already."""
        if self.depth.folder.resolve() == (folder / "z_depth").resolve():
            return
        check_empty(folder)
        for name in self.names:
            if name in self.depth:
                with atomic_path(folder / "z_depth" / f"{name}.npz") as draft:
                    shutil.copyfile(self.depth.path(name), draft)
