"""Every file of a run that holds lengths, in another unit: all at once, or none.

The new files are written to RUN/.swimm3r-rescale, then its journal, then they take their places one by one. Without a
journal nothing has happened, and what lies there is litter; with one, the rest is done by `finish_rescale`, which every
command that writes into the run begins with, and readers are refused until it is.
"""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from swimm3r.io import ply
from swimm3r.io.depth import read_depth, write_depth
from swimm3r.io.files.array_file import read_npz, write_arrays
from swimm3r.io.files.atomic import atomic_path, write_text
from swimm3r.io.files.damage import Remedy, guard, remake
from swimm3r.io.files.json_file import read_json
from swimm3r.io.medium_json import read_fits
from swimm3r.medium import rescale, save_fits
from swimm3r.progress import Progress, silent
from swimm3r.scene.run_folder import RESCALING
from swimm3r.splat.block_store import BlockEntry, StoredBlocks, read_block, write_block
from swimm3r.splat.map_file import load_map
from swimm3r.splat.medium.field import MediumField
from swimm3r.splat.primitives import beta, gaussian
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.primitives.kinds import Primitives
from swimm3r.splat.rendering import SplatMap

_STEP = "rescaling files"
_JOURNAL = RESCALING.name
_POSES = (
    "sfm/cameras.json",
    "sfm/cameras_between.json",
    "sfm/cameras_imported.json",
    "splat/cameras.json",
    "localization/poses.json",
)
_TRAJECTORIES = ("sfm/trajectory.tum", "splat/trajectory.tum", "localization/poses.tum")
_CLOUDS = ("points", "backdrop")
_EXPORTS = (  # of other commands, where they are by default, and splats anywhere near
    "products/products.json", "export/*", "localization/stream.*", "sfm/*.glb",
    *(f"{room}{name}" for room in ("", "splat/") for name in ("gaussians*", "*.splat", "*.spz", "*.glb")),
    "transforms.json",
)  # fmt: skip

Change = tuple[str, Callable[[Path, Path], None]]  # a file of the run, and the function from the old one to the new


@dataclass(frozen=True)
class _Journal:
    files: tuple[str, ...]


def rescale_run(folder: Path, factor: float, texts: dict[str, str], progress: Progress = silent) -> tuple[str, ...]:
    """Multiply every length in a run folder by a factor and call it metres; `texts` are files written with them.

    Returns files that other commands made in the old unit, which have to be made again.
    """
    staging = folder / RESCALING.parent
    shutil.rmtree(staging, ignore_errors=True)
    changes = [] if factor == 1.0 else _changes(folder, factor)
    for done, (name, change) in enumerate(changes):
        progress(_STEP, done, len(changes))
        (staging / name).parent.mkdir(parents=True, exist_ok=True)
        change(folder / name, staging / name)
    written = [path.relative_to(staging).as_posix() for path in sorted(staging.rglob("*")) if path.is_file()]
    for name, text in texts.items():
        write_text(staging / name, text)
    write_text(folder / RESCALING, json.dumps({"files": [*written, *texts]}, indent=1) + "\n")
    finish_rescale(folder)
    progress(_STEP, len(changes), len(changes))
    return () if factor == 1.0 else _exports(folder)


def finish_rescale(folder: Path) -> bool:
    """Bring a rescaling that was interrupted to its end; return whether there was one."""
    journal = folder / RESCALING
    if not journal.is_file():
        return False
    remedy = Remedy(f"remove {journal.parent}, then swimm3r run {folder} --redo, as some files may be rescaled already")
    for name in read_json(journal, _Journal, remedy).files:
        fresh = journal.parent / name
        if fresh.is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(fresh, folder / name)
    journal.unlink()
    shutil.rmtree(journal.parent, ignore_errors=True)
    return True


def _changes(folder: Path, factor: float) -> list[Change]:
    """The files of a run that hold lengths, each with its change."""

    def there(names: tuple[str, ...]) -> list[str]:
        return [name for name in names if (folder / name).is_file()]

    def below(pattern: str) -> list[str]:
        return [path.relative_to(folder).as_posix() for path in sorted(folder.glob(pattern)) if path.is_file()]

    clouds = [name for stem in _CLOUDS for name in below(f"sfm/{stem}*.ply")]
    cameras = [*there(_POSES), *below("renders/**/rendered_cameras.json")]
    changes: list[Change] = [("sfm/sparse/points3D.bin", lambda old, new: _sparse(old.parent, new.parent, factor))]
    changes += [(name, lambda old, new: _poses(old, new, factor)) for name in cameras]
    changes += [(name, lambda old, new: _trajectory(old, new, factor)) for name in there(_TRAJECTORIES)]
    changes += [(name, lambda old, new: _depth(old, new, factor)) for name in below("sfm/z_depth/**/*.npz")]
    changes += [(name, lambda old, new: _cloud(old, new, factor)) for name in clouds]
    changes += [(name, lambda old, new: _frame_water(old, new, factor)) for name in below("sfm/water/**/*.npz")]
    changes += [(name, lambda old, new: _medium(old, new, factor)) for name in there(("sfm/medium.json",))]
    changes += [(name, lambda old, new: _about(old, new, factor)) for name in there(("sfm/reconstruction.json",))]
    changes += [(name, lambda old, new: _rendered(old, new, factor)) for name in below("renders/**/*_z_depth.tif")]
    if (folder / "splat/map.safetensors").is_file():
        changes.append(("splat/map.safetensors", lambda old, new: _map(old, new, factor)))
    return changes


def _sparse(old: Path, new: Path, factor: float) -> None:
    """A COLMAP model with everything in it."""
    import pycolmap

    with guard(old, remake(old.parent)):
        model = pycolmap.Reconstruction(str(old))
    model.transform(pycolmap.Sim3d(factor, pycolmap.Rotation3d(), np.zeros(3)))
    model.write_binary(str(new))


def _poses(old: Path, new: Path, factor: float) -> None:
    """Any JSON table of frames or images with poses `c2w`."""
    remedy = remake(old.parent)
    with guard(old, remedy):
        document = json.loads(old.read_text(encoding="utf-8"))
        for frame in document.get("frames", document.get("images", [])):
            for row in (frame["c2w"] or [])[:3]:
                row[3] *= factor
    for key in ("units", "unit"):
        if key in document:
            document[key] = "metres"
    write_text(new, json.dumps(document, indent=1) + "\n")


def _trajectory(old: Path, new: Path, factor: float) -> None:
    lines = []
    with guard(old, remake(old.parent)):
        for line in old.read_text(encoding="utf-8").splitlines():
            time, x, y, z, *turn = line.split()
            place = [f"{float(value) * factor:.9f}" for value in (x, y, z)]
            lines.append(" ".join([time, *place, *turn]) + "\n")
    write_text(new, "".join(lines))


def _depth(old: Path, new: Path, factor: float) -> None:
    with guard(old, remake(old.parent)):
        arrays = read_npz(old)
    arrays["z_depth"] = (arrays["z_depth"].astype(np.float64) * factor).astype(arrays["z_depth"].dtype)
    with atomic_path(new) as draft:
        write_arrays(draft, **arrays)


def _frame_water(old: Path, new: Path, factor: float) -> None:
    """The water that a network saw in a frame: every coefficient but the color is per length."""
    with guard(old, remake(old.parent)):
        arrays = read_npz(old)
    for name in ("beta_B", "curve"):
        arrays[name] = (arrays[name].astype(np.float64) / factor).astype(arrays[name].dtype)
    with atomic_path(new) as draft:
        write_arrays(draft, **arrays)


def _cloud(old: Path, new: Path, factor: float) -> None:
    xyz, rgb = ply.read_points(old, remake(old.parent))
    ply.write_points(new, (xyz.astype(np.float64) * factor).astype(np.float32), rgb)


def _medium(old: Path, new: Path, factor: float) -> None:
    fits = read_fits(old, remake(old.parent))
    save_fits(new, {name: rescale(fit, factor) for name, fit in fits.items()})


def _about(old: Path, new: Path, factor: float) -> None:
    """The metric flag, and the rig."""
    with guard(old, remake(old.parent)):
        document = json.loads(old.read_text(encoding="utf-8"))
        for camera in (document.get("rig") or {}).get("cameras", []):
            camera["baseline"] *= factor
            for row in camera["camera_from_rig"][:3]:
                row[3] *= factor
    write_text(new, json.dumps({**document, "metric": True}, indent=2) + "\n")


def _rendered(old: Path, new: Path, factor: float) -> None:
    write_depth(new, (read_depth(old).astype(np.float64) * factor).astype(np.float32))


def _map(old: Path, new: Path, factor: float) -> None:
    """A map, of one block or many; blocks first, as the map lists them."""
    scene = rescaled_map(load_map(old), factor)
    stored = load_map(old).blocks
    if stored is not None:
        assert scene.blocks is not None
        for entry, scaled in zip(stored.entries, scene.blocks.entries, strict=True):
            for file, kept in ((entry.file, scaled), (entry.coarse_file, None)):
                p = beta.rescaled(read_block(stored.folder / file, stored.key), factor)
                write_block(new.parent / file, p, stored.key, kept)
        scene = replace(scene, blocks=StoredBlocks(new.parent, stored.key, scene.blocks.entries))
    scene.save(new)


def rescaled_map(scene: SplatMap, factor: float) -> SplatMap:
    """The same map after every length was multiplied by a factor; entries of blocks too, their files apart."""
    if isinstance(scene.field, MediumField):
        scene.field.length.mul_(factor)
    poses = scene.poses
    if poses is not None:
        poses = replace(poses, cam2world=_moved(poses.cam2world, factor))
    viewpoint = scene.viewpoint
    if viewpoint is not None:
        viewpoint = replace(viewpoint, cam2world=_moved(viewpoint.cam2world, factor))
    blocks = scene.blocks
    if blocks is not None:
        blocks = replace(blocks, entries=tuple(_entry(entry, factor) for entry in blocks.entries))
    return replace(
        scene,
        primitives=_primitives(scene.primitives, factor),
        metric=True,
        length=scene.length * factor,
        poses=poses,
        viewpoint=viewpoint,
        blocks=blocks,
    )


def _primitives(p: Primitives, factor: float) -> Primitives:
    return beta.rescaled(p, factor) if isinstance(p, BetaPrimitives) else gaussian.rescaled(p, factor)


def _entry(entry: BlockEntry, factor: float) -> BlockEntry:
    low, high = ((x * factor, y * factor, z * factor) for x, y, z in (entry.low, entry.high))
    return replace(entry, spacing=entry.spacing * factor, low=low, high=high)


def _moved(cam2world: torch.Tensor, factor: float) -> torch.Tensor:
    moved = cam2world.clone()
    moved[..., :3, 3] *= factor
    return moved


def _exports(folder: Path) -> tuple[str, ...]:
    """Files for other programs, which keep the unit they were written in."""
    found = {path for pattern in _EXPORTS for path in folder.glob(pattern)}
    return tuple(sorted(path.relative_to(folder).as_posix() for path in found))
