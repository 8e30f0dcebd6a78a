"""A reconstruction read back from the folder that `Reconstruction.save` wrote.

Where matches that contradict the result were dropped, matches_unfiltered.npz has all of them: what epipolar scores are
taken over.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from swimm3r.cameras import Cameras, cameras_of
from swimm3r.io import cameras_json, medium_json, ply
from swimm3r.io.colmap import model as colmap
from swimm3r.io.files.array_file import Layout, read_arrays
from swimm3r.io.files.damage import guard, remake
from swimm3r.io.files.json_file import read_json
from swimm3r.scene.frame_changes import OWN_COLORS, STEADY, MovingMasks, SteadyFrames, read_own_colors
from swimm3r.scene.frames import MASKS, Frames
from swimm3r.scene.reconstruction import DenseCloud, DepthMaps, Matches, Points, QualityWarning, Reconstruction, Tracks
from swimm3r.scene.rig import RigFit
from swimm3r.scene.white_balance import UNBALANCED, WHITE_BALANCE, WhiteBalance, read_white_balance

_UNFILTERED = "matches_unfiltered.npz"
_ROUNDED_TO_WHITE = 254.5001 / 255  # the darkest color whose 8 bits are white
_MATCHES = {
    "i": Layout("matches", "int"),
    "j": Layout("matches", "int"),
    "xy_i": Layout("matches 2"),
    "xy_j": Layout("matches 2"),
    "confidence": Layout("matches"),
}


@dataclass(frozen=True)
class _About:
    """reconstruction.json."""

    backend: str
    metric: bool
    warnings: tuple[QualityWarning, ...]
    points_found: int | None = None  # earlier versions did not count
    up: tuple[float, float, float] | None = None
    rig: RigFit | None = None


def load_reconstruction(folder: str | Path, frames: Frames | None = None) -> Reconstruction:
    """Read what `Reconstruction.save` wrote, or RUN/sfm of a run.

    Raises InputError where it is damaged, or not of the training frames in `frames`.
    """
    folder = Path(folder)
    remedy = remake(folder)
    sparse = colmap.read_model(folder / "sparse", remedy)
    if frames is not None:
        with guard(folder / "sparse", remedy):
            _check_frames(sparse, frames)
    about = read_json(folder / "reconstruction.json", _About, remedy)
    fits = medium_json.read_fits(folder / "medium.json", remedy)
    balance = read_run_balance(folder) if _is_balanced(folder) else None
    return Reconstruction(
        names=sparse.names,
        cameras=_read_cameras(folder / "cameras.json", sparse.names),
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
        cloud=_load_cloud(folder, "points", balance),
        backdrop=_load_cloud(folder, "backdrop", balance),
        warnings=about.warnings,
        white_balance=UNBALANCED if balance is None else balance,
        points_found=about.points_found,
        up=about.up,
        rig=about.rig,
        moving=MovingMasks(folder / MASKS) if (folder / MASKS).is_dir() else None,
        steady=SteadyFrames(folder / STEADY) if (folder / STEADY).is_dir() else None,
        own_colors=read_own_colors(folder / OWN_COLORS, remedy) if (folder / OWN_COLORS).is_file() else None,
    )


def _read_cameras(path: Path, names: tuple[str, ...]) -> Cameras:
    """The cameras to the last bit: COLMAP's model rounds rotations to quaternions."""
    remedy = remake(path.parent)
    table = cameras_json.read_own_cameras(path, remedy)
    with guard(path, remedy):
        if table.names != names:
            raise ValueError("its frames are not those of sparse/")
    return cameras_of(table)


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
    matches.save(folder / _UNFILTERED)


def unfiltered_matches(folder: Path, rec: Reconstruction) -> Matches:
    """All matches that a reconstruction was made from: its own, where none of them was dropped."""
    path = folder / _UNFILTERED
    return _read_matches(path, len(rec.names)) if path.is_file() else rec.matches


def _read_matches(path: Path, frames: int) -> Matches:
    remedy = remake(path.parent)
    stored = read_arrays(path, _MATCHES, remedy)
    with guard(path, remedy):
        for index in (stored["i"], stored["j"]):
            if len(index) and not 0 <= int(index.min()) <= int(index.max()) < frames:
                raise ValueError(f"its matches point beyond the {frames} registered frames")
    return Matches(**{name: torch.from_numpy(values) for name, values in stored.items()})


def read_run_balance(folder: Path) -> WhiteBalance:
    """The white balance in RUN/sfm. Raises InputError where it is damaged, or lost beside a balanced cloud."""
    return read_white_balance(folder / WHITE_BALANCE, remake(folder)) if _is_balanced(folder) else UNBALANCED


def _is_balanced(folder: Path) -> bool:
    """Return whether points.ply is as shown; early runs of schema 2 have physical colors there and no balance."""
    return any((folder / name).exists() for name in (WHITE_BALANCE, "points_physical.ply"))


def _load_cloud(folder: Path, stem: str, balance: WhiteBalance | None) -> DenseCloud | None:
    """A cloud with its colors; None where there is none. Without a balance it has physical colors in the first file."""
    if not (folder / f"{stem}.ply").is_file():
        return None
    remedy = remake(folder)
    xyz, shown = ply.read_points(folder / f"{stem}.ply", remedy)

    def others(kind: str) -> np.ndarray:
        path = folder / f"{stem}{kind}.ply"
        _, rgb = ply.read_points(path, remedy)
        with guard(path, remedy):
            if len(rgb) != len(xyz):
                raise ValueError(f"it has {len(rgb)} points, {stem}.ply {len(xyz)}")
        return rgb

    raw, restored = others("_raw"), shown
    if balance is not None:
        restored = others("_physical")
        if balance.source == "restored":  # 8 bits end at white, which displayed colors have made darker
            brighter = np.maximum(shown / balance.factors.numpy(), _ROUNDED_TO_WHITE)
            restored = np.where(restored == 1, brighter, restored)
    return DenseCloud(torch.from_numpy(xyz), torch.from_numpy(raw), torch.from_numpy(restored))
