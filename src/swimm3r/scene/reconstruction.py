"""The result of structure from motion: the one record that every back end fills and every later stage reads.

On disk (`save`, `load`) it is a folder: sparse/ (COLMAP model), cameras.json, trajectory.tum, z_depth/NAME.npz,
matches.npz, medium.json, points.ply (restored colors), points_raw.ply, backdrop.ply (guessed ground, restored
colors), backdrop_raw.ply, reconstruction.json (back end, metric flag, warnings, points found). Where matches that
contradict the result were dropped, matches_unfiltered.npz has all of them: what epipolar scores are taken over.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from swimm3r.cameras import Cameras, cameras_of
from swimm3r.io import cameras_json, medium_json, ply
from swimm3r.io.colmap import model as colmap
from swimm3r.io.files.array_file import Layout, read_arrays
from swimm3r.io.files.atomic import atomic_path, write_text
from swimm3r.io.files.cache import ArrayCache
from swimm3r.io.files.damage import guard, remake
from swimm3r.io.files.json_file import read_json
from swimm3r.io.trajectory import write_tum
from swimm3r.medium import MediumFit
from swimm3r.scene.frames import Frames

_CACHE = ArrayCache(max_bytes=1 << 30)
_UNFILTERED = "matches_unfiltered.npz"
_DEPTH = {"z_depth": Layout("h w"), "confidence": Layout("h w")}
_MATCHES = {
    "i": Layout("matches", "int"),
    "j": Layout("matches", "int"),
    "xy_i": Layout("matches 2"),
    "xy_j": Layout("matches 2"),
    "confidence": Layout("matches"),
}


@dataclass(frozen=True)
class Points:
    """Sparse points with the colors they have in the images."""

    xyz: Float[Tensor, "p 3"]  # world, float64
    rgb: Float[Tensor, "p 3"]  # raw, 0..1
    error: Float[Tensor, " p"]  # mean reprojection error, pixels


@dataclass(frozen=True)
class Tracks:
    """Which point was seen where: one row per observation."""

    point: Int[Tensor, " o"]  # index into Points
    frame: Int[Tensor, " o"]  # index into Reconstruction.names
    xy: Float[Tensor, "o 2"]  # pixels of the prepared frame


@dataclass(frozen=True)
class Matches:
    """Two-view correspondences that survived geometric verification: one row each."""

    i: Int[Tensor, " m"]  # index into Reconstruction.names
    j: Int[Tensor, " m"]
    xy_i: Float[Tensor, "m 2"]  # pixels of the prepared frames
    xy_j: Float[Tensor, "m 2"]
    confidence: Float[Tensor, " m"]  # 1 for verified feature matches, the network's own for learned ones


@dataclass(frozen=True)
class DepthMap:
    """Dense depth of one frame; 0 where nothing is known."""

    z_depth: Float[Tensor, "h w"]  # along the optical axis, scene units
    confidence: Float[Tensor, "h w"]  # 0..1


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

        z_depth, confidence = _CACHE.get((self.folder, name), load)
        return DepthMap(torch.from_numpy(z_depth.astype(np.float32)), torch.from_numpy(confidence.astype(np.float32)))

    def write(self, name: str, depth: DepthMap) -> None:
        """Store the map of a frame: depth as float32, confidence as float16."""
        path = self.path(name)
        with atomic_path(path) as draft:
            np.savez_compressed(
                draft,
                z_depth=depth.z_depth.numpy().astype(np.float32),
                confidence=depth.confidence.numpy().astype(np.float16),
            )


@dataclass(frozen=True)
class DenseCloud:
    """Dense points: their colors in the water, and with the water removed."""

    xyz: Float[Tensor, "n 3"]
    raw: Float[Tensor, "n 3"]  # 0..1
    restored: Float[Tensor, "n 3"]  # 0..1


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
    points_found: int | None = None  # sparse ones, before the settings' cap; None: nothing was left out

    def index(self, name: str) -> int:
        """The position of a registered frame by its name."""
        return self.names.index(name)


def colmap_model(rec: Reconstruction) -> colmap.ColmapModel:
    """Cameras, points and tracks as io/colmap writes them."""
    return colmap.ColmapModel(
        names=rec.names,
        model=rec.cameras.model,
        width=rec.cameras.width,
        height=rec.cameras.height,
        K=rec.cameras.K.numpy(),
        distortion=rec.cameras.distortion.numpy(),
        cam2world=rec.cameras.cam2world.numpy(),
        xyz=rec.points.xyz.numpy(),
        rgb=(rec.points.rgb.numpy() * 255).round().astype(np.uint8),
        error=rec.points.error.numpy(),
        track_point=rec.tracks.point.numpy(),
        track_frame=rec.tracks.frame.numpy(),
        track_xy=rec.tracks.xy.numpy(),
    )


def save(rec: Reconstruction, frames: Frames, folder: Path) -> None:
    """Write a reconstruction of some frames into a folder; depth maps already live under it."""
    colmap.write_model(folder / "sparse", colmap_model(rec))
    times = frames.times_of(rec.names)
    write_tum(folder / "trajectory.tum", times, rec.cameras.cam2world.numpy())
    cameras_json.write_cameras(
        folder / "cameras.json",
        cameras_json.CameraTable(
            names=rec.names,
            width=rec.cameras.width,
            height=rec.cameras.height,
            model=rec.cameras.model,
            K=rec.cameras.K.numpy(),
            distortion=rec.cameras.distortion.numpy(),
            cam2world=rec.cameras.cam2world.numpy(),
            units="metres" if rec.metric else "scene units",
            times=times,
        ),
    )
    _write_matches(folder / "matches.npz", rec.matches)
    fits = {"stored": rec.medium, "linear": rec.medium_linear}
    medium_json.write_fits(folder / "medium.json", {name: fit for name, fit in fits.items() if fit is not None})
    for stem, cloud in (("points", rec.cloud), ("backdrop", rec.backdrop)):
        if cloud is not None:
            ply.write_points(folder / f"{stem}.ply", cloud.xyz.numpy(), cloud.restored.numpy())
            ply.write_points(folder / f"{stem}_raw.ply", cloud.xyz.numpy(), cloud.raw.numpy())
    about = {"backend": rec.backend, "metric": rec.metric, "warnings": [vars(warning) for warning in rec.warnings]}
    about["points_found"] = rec.points_found
    write_text(folder / "reconstruction.json", json.dumps(about, indent=2) + "\n")


@dataclass(frozen=True)
class _About:
    """reconstruction.json."""

    backend: str
    metric: bool
    warnings: tuple[QualityWarning, ...]
    points_found: int | None = None  # earlier versions did not count


def load(folder: Path, frames: Frames | None = None) -> Reconstruction:
    """Read what `save` wrote. Raises InputError where it is damaged, or not of the training frames in `frames`."""
    remedy = remake(folder)
    sparse = colmap.read_model(folder / "sparse", remedy)
    if frames is not None:
        with guard(folder / "sparse", remedy):
            _check_frames(sparse, frames)
    about = read_json(folder / "reconstruction.json", _About, remedy)
    fits = medium_json.read_fits(folder / "medium.json", remedy)
    return Reconstruction(
        names=sparse.names,
        cameras=cameras_of(sparse),
        points=Points(
            torch.from_numpy(sparse.xyz),
            torch.from_numpy(sparse.rgb.astype(np.float32)) / 255,
            torch.from_numpy(sparse.error),
        ),
        tracks=Tracks(*(torch.from_numpy(a) for a in (sparse.track_point, sparse.track_frame, sparse.track_xy))),
        matches=_read_matches(folder / "matches.npz", len(sparse.names)),
        depth=DepthMaps(folder / "z_depth"),
        backend=about.backend,
        metric=about.metric,
        medium=fits.get("stored"),
        medium_linear=fits.get("linear"),
        cloud=_load_cloud(folder, "points"),
        backdrop=_load_cloud(folder, "backdrop"),
        warnings=about.warnings,
        points_found=about.points_found,
    )


def _check_frames(sparse: colmap.ColmapModel, frames: Frames) -> None:
    unknown = set(sparse.names) - set(frames.train.names)
    if unknown:
        raise ValueError(f"it places {min(unknown)}, which is no training frame of prepare/")
    if (sparse.width, sparse.height) != (frames.width, frames.height):
        raise ValueError(
            f"its images have {sparse.width}x{sparse.height} pixels, the frames {frames.width}x{frames.height}"
        )


def write_unfiltered_matches(folder: Path, matches: Matches) -> None:
    """Keep the matches that a reconstruction was made from, before those that contradict it are dropped."""
    _write_matches(folder / _UNFILTERED, matches)


def unfiltered_matches(folder: Path, rec: Reconstruction) -> Matches:
    """All matches that a reconstruction was made from: its own, where none of them was dropped."""
    path = folder / _UNFILTERED
    return _read_matches(path, len(rec.names)) if path.is_file() else rec.matches


def _write_matches(path: Path, matches: Matches) -> None:
    with atomic_path(path) as draft:
        np.savez_compressed(draft, **{name: tensor.numpy() for name, tensor in vars(matches).items()})


def _read_matches(path: Path, frames: int) -> Matches:
    remedy = remake(path.parent)
    stored = read_arrays(path, _MATCHES, remedy)
    with guard(path, remedy):
        for index in (stored["i"], stored["j"]):
            if len(index) and not 0 <= int(index.min()) <= int(index.max()) < frames:
                raise ValueError(f"its matches point beyond the {frames} registered frames")
    return Matches(**{name: torch.from_numpy(values) for name, values in stored.items()})


def _load_cloud(folder: Path, stem: str) -> DenseCloud | None:
    if not (folder / f"{stem}.ply").is_file():
        return None
    remedy = remake(folder)
    xyz, restored = ply.read_points(folder / f"{stem}.ply", remedy)
    _, raw = ply.read_points(folder / f"{stem}_raw.ply", remedy)
    with guard(folder / f"{stem}_raw.ply", remedy):
        if len(raw) != len(xyz):
            raise ValueError(f"it has {len(raw)} points, {stem}.ply {len(xyz)}")
    return DenseCloud(torch.from_numpy(xyz), torch.from_numpy(raw), torch.from_numpy(restored))
