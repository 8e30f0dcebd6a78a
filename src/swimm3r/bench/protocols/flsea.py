"""Depth and poses on FLSea's test sequences (the paper's Tab. swimm3r_flsea), and of its ablated trainings.

Every method sees the same raw frames, every `stride`-th of a sequence, all of them: the paper holds none back here.
Depth is judged against the set's own. Reference poses are a COLMAP model beside the images where there is one; else
structure from motion of the restored (seaErra) images of the same frames, made once into OUT/references. It holds the
set's calibration where that has a distortion, and begins with its focal length where it has none.
"""

import os
import shutil
from collections.abc import Sequence as Many
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from swimm3r.bench import reference
from swimm3r.bench.cells import Result, ResultKey, Scores, check_choice, kept_cell, over_scenes, scene_folder
from swimm3r.bench.inputs import files_of
from swimm3r.bench.scores import columns
from swimm3r.bench.settings import SfmMethods
from swimm3r.bench.sfm_methods import reference_scores, settings_for
from swimm3r.bench.tables import Table
from swimm3r.cameras import Cameras
from swimm3r.datasets import load, read_tree
from swimm3r.datasets.sequences import Sequence, Shot
from swimm3r.errors import InputError, RegistrationError
from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.depth import depth_scores
from swimm3r.io.files.cache_key import cache_key
from swimm3r.prepare import load_frames, read_frames
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.settings import FrameSettings
from swimm3r.settings import Count, accepted
from swimm3r.sfm import reconstruct
from swimm3r.sfm.settings import ColmapSettings, Mast3rSettings, SfmSettings
from swimm3r.tasks.settings import EngineSettings

COLUMNS = columns(
    "absrel_median", "delta125_median", "rmselog_median", "depth_coverage_pct", "rra15", "rta15", "maa30",
    "registered_pct", "reference_pct",
)  # fmt: skip
_OWN_SIZE = FrameSettings(long_side=0)
_FAILED = NotComputed("too few frames could be placed")


def compare_on_flsea(
    root: Path,
    out: Path,
    given: SfmMethods,
    colmap: ColmapSettings,
    mast3r: Mast3rSettings,
    stride: int = 1,
    sequences: Many[str] = (),
    how: EngineSettings | None = None,
    progress: Progress = silent,
    name: str = "flsea",
) -> Table:
    """Every method on every test sequence below `root`, or on those that `sequences` names.

    Raises InputError where there is none of them, and UsageError for no method.
    """
    check_choice("methods", given.methods)
    accepted("stride", stride, Count)
    found = chosen_sequences(root, sequences)
    colmap = replace(colmap, rectify="keep")  # depth is scored in pixels of the images as they are published
    options = {"root": root, "out": out, "given": given, "colmap": colmap, "mast3r": mast3r, "stride": stride}
    cells = over_scenes(found, partial(_cells_of_sequence, **options), out, how or EngineSettings(), progress)
    return Table(name, "Depth and poses on FLSea's test sequences", cells, COLUMNS)


def chosen_sequences(root: Path, sequences: Many[str] = ()) -> list[str]:
    """The names of FLSea's sequences below a folder: the paper's test split, or those whose last part is given."""
    every = {s.name: s for s in read_tree(root).sequences if s.kind == "FLSea-VI"}
    if sequences:
        chosen = [name for name in every if name.split("/")[-1] in sequences or name in sequences]
    else:
        chosen = [name for name, s in every.items() if any(shot.split == "test" for shot in s.shots)]
    if not chosen:
        raise InputError(
            f"{root} holds none of the sequences " + (", ".join(sequences) if sequences else "of the test split"),
            cause=f"it holds {', '.join(every) or 'no sequence of FLSea-VI'}",
            hint="--sequences NAME..., by the names of their folders; swimm3r datasets ROOT lists them",
        )
    return chosen


def _cells_of_sequence(
    scene: str,
    /,
    *,
    root: Path,
    out: Path,
    given: SfmMethods,
    colmap: ColmapSettings,
    mast3r: Mast3rSettings,
    stride: int,
    progress: Progress,
) -> list[Result]:
    sequence = next(s for s in read_tree(root).sequences if s.name == scene)
    shots = tuple(shot for shot in sequence.shots if shot.raw is not None)[::stride]
    frames = _frames({shot.name: shot.raw for shot in shots if shot.raw}, scene_folder(out / "frames", scene), progress)
    truth = reference_of(sequence, shots, frames, colmap, out, progress)
    cells = []
    for method in given.methods:
        chosen = settings_for(method, scene.split("/")[-1], given, colmap, mast3r)
        if isinstance(chosen, NotComputed):
            cells.append(Result(scene, method, 0, not_run=chosen.reason))
            continue
        made_from = [_listing(frames), chosen, files_of(chosen)]
        scored_by = [reference.digest(truth), [c.score for c in COLUMNS]]
        make = partial(_scores, sequence=sequence, frames=frames, settings=chosen, truth=truth, progress=progress)
        cells.append(kept_cell(out, ResultKey(scene, method), made_from, make, scored_by))
    return cells


def reference_of(
    sequence: Sequence,
    shots: Many[Shot],
    frames: Frames,
    colmap: ColmapSettings,
    out: Path,
    progress: Progress = silent,
) -> GroundTruth | NotComputed:
    """Reference poses of the frames, under the frames' names."""
    lens = sequence.camera(frames.width, frames.height)
    named = {Path(name).stem: name for name in frames.names}
    if sequence.cam2world:
        posed = [shot.name for shot in shots if shot.name in sequence.cam2world and shot.name in named]
        if not posed:
            return NotComputed("no reference: the COLMAP model beside the images is of none of these frames")
        poses = torch.stack([torch.from_numpy(sequence.cam2world[name]).double() for name in posed])
        K = torch.eye(3, dtype=torch.float64) if lens is None else lens.K[0]
        flat = torch.zeros(len(posed), 0, dtype=torch.float64)
        cameras = Cameras(K.repeat(len(posed), 1, 1), flat, poses, frames.width, frames.height)
        return GroundTruth(tuple(named[name] for name in posed), cameras, sequence.metric)
    clean = {shot.name: shot.clean for shot in shots if shot.clean is not None}
    if len(clean) < 2:
        return NotComputed("no reference: the sequence has neither a COLMAP model nor restored images to make one of")
    images = _frames(clean, scene_folder(out / "frames", sequence.name), progress)
    if lens is not None and not lens.distortion.shape[-1]:
        colmap, lens = replace(colmap, focal=float(lens.K[0, 0, 0])), None
    folder = scene_folder(out / "references", sequence.name)
    found = reference.whole_clip(images, lens, colmap, folder, progress)
    if isinstance(found, NotComputed):
        return found
    return replace(found, names=tuple(named.get(Path(name).stem, name) for name in found.names))


def _frames(images: dict[str, Path], folder: Path, progress: Progress) -> Frames:
    """The images as frames, none of them held back; prepared once into a folder by what they are."""
    listing = sorted(f"{name}|{path}|{path.stat().st_size}" for name, path in images.items())
    folder = folder / cache_key(listing)[:12]
    if not (folder / "prepare" / "frames.json").is_file():
        together = folder / "images"
        together.mkdir(parents=True, exist_ok=True)
        for name, path in images.items():
            link = together / f"{name}{path.suffix}"
            link.unlink(missing_ok=True)
            try:
                os.symlink(path.resolve(), link)
            except OSError:  # where the disk or the system knows no links
                shutil.copyfile(path, link)
        read_frames(together, _OWN_SIZE, folder / "prepare", progress)
        shutil.rmtree(together)
    frames = load_frames(folder / "prepare")
    return replace(frames, frames=tuple(replace(frame, split="train") for frame in frames))


def _scores(
    folder: Path,
    *,
    sequence: Sequence,
    frames: Frames,
    settings: SfmSettings,
    truth: GroundTruth | NotComputed,
    progress: Progress,
) -> Scores:
    rec = None
    if isinstance(settings, ColmapSettings):
        settings = settings.of_frames_as_filmed()  # as the depth is that they are compared with
    with suppress(RegistrationError):  # its row then says that nothing was registered
        rec = reconstruct(frames, settings, folder / "sfm", progress)
    placed = 0 if rec is None else len(rec.names)
    return {
        **sequence_depth_scores(rec, sequence, frames.names, progress),
        **reference_scores(rec, frames.names, truth),
        "registered_pct": 100 * placed / len(frames),
    }


def sequence_depth_scores(
    rec: Reconstruction | None, sequence: Sequence, names: Many[str], progress: Progress = silent
) -> dict[str, float | NotComputed]:
    """Means over the frames that have depth; each frame is scaled by its median, and loaded alone."""
    index = {shot.name: i for i, shot in enumerate(sequence.shots)}
    totals, scored, known, covered = torch.zeros(3, dtype=torch.float64), 0, 0, 0.0
    for done, name in enumerate(names):
        progress("scoring depth", done, len(names))
        true = load(sequence, index[Path(name).stem]).z_depth
        if true is None:
            continue
        pixels = int((true > 0).sum())
        known += pixels
        if rec is None or name not in rec.names or name not in rec.depth:
            continue
        frame = depth_scores([(rec.depth[name].z_depth, true)])
        if not isinstance(frame.absrel, NotComputed):
            totals += torch.tensor([frame.absrel, frame.delta_125, frame.rmse_log], dtype=torch.float64)
            covered += pixels * float(frame.coverage) if not isinstance(frame.coverage, NotComputed) else 0.0
            scored += 1
    scores = ("absrel_median", "delta125_median", "rmselog_median")
    if not known:
        return dict.fromkeys((*scores, "depth_coverage_pct"), NotComputed("the sequence has no depth"))
    coverage = {"depth_coverage_pct": 100 * covered / known}
    if not scored:
        return {**dict.fromkeys(scores, _FAILED), **coverage}
    return {**dict(zip(scores, (totals / scored).tolist(), strict=True)), **coverage}


def _listing(frames: Frames) -> list[tuple[str, int]]:
    return [(frame.name, frame.path.stat().st_size) for frame in frames]
