"""Reference poses where nobody knows the truth: structure from motion of all frames, test frames included.

The paper places test frames by poses of the full sequence, which no method's own training frames could give. They are
made once per clip, without dense depth and water, and kept in a folder with the key of what they were made of.

Poses that somebody else found can take their place: a folder with NAME.json, a cameras.json, for each clip.

The lens is held at what the clip's first run found: calibrated anew, it would come out different on other frames (on
small hazy images by a quarter), and poses under two lenses differ by more than a good localization errs.

A camera that turned while rows were exposed has no pose without its turn. Structure from motion of test frames as
filmed is off by a part of it (on ruie_cyan_slope renderings are 0.30 px beside their frames; a pose and a turn from a
frame's own matches leave 0.19), so such clips have no reference unless somebody gives one. Nor have rigs whose cameras
have lenses of their own, as the lens that is held would be that of one of them.
"""

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from swimm3r.cameras import Cameras
from swimm3r.errors import InputError, RegistrationError
from swimm3r.evaluate import NotComputed
from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.cache_key import cache_key, code_version
from swimm3r.localization.lenses import has_several_lenses
from swimm3r.pipeline.finished_sfm import FinishedSfm
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.ground_truth import GroundTruth, read_ground_truth
from swimm3r.sfm.colmap import poses
from swimm3r.sfm.settings import ColmapSettings


def given(references: Path | None, scene: str) -> GroundTruth | None:
    """The poses that a folder of references has for a scene, if it has any. Raises InputError for no such folder."""
    if references is None:
        return None
    if not references.is_dir():
        raise InputError(
            f"{references} is no folder",
            cause="the path is mistyped, or names a single file",
            hint="--references DIR with DIR/CLIP.json, a cameras.json, for each clip",
        )
    path = references / f"{scene}.json"
    return read_ground_truth(path) if path.is_file() else None


def required(references: Path | None, scenes: Sequence[str]) -> None:
    """Raises InputError where a folder of references lacks one of the scenes, before there is any work to lose."""
    missing = [scene for scene in scenes if references is not None and given(references, scene) is None]
    if missing:
        raise InputError(
            f"{references} has no reference poses of {', '.join(missing)}",
            cause=f"they are looked for in {missing[0]}.json, a cameras.json",
            hint="add the file, or leave --references out: poses of all frames are then found by COLMAP",
        )


def of_clip(sfm: FinishedSfm, folder: Path, progress: Progress = silent) -> GroundTruth | NotComputed:
    """The reference of a run's clip, by the run's own settings where COLMAP found its poses, else by the defaults.

    NotComputed where frames cannot be placed, where rows of training frames are rectified but not of test frames, and
    where the cameras of a rig have lenses of their own.
    """
    if sfm.frames.rows_rectified:
        return NotComputed("no reference: the camera turned within exposures; test frames are placed by their matches")
    if has_several_lenses(sfm.rec, sfm.frames):
        return NotComputed("no reference: the rig's cameras have lenses of their own; --references DIR gives one")
    settings = sfm.settings.sfm if isinstance(sfm.settings.sfm, ColmapSettings) else ColmapSettings()
    return whole_clip(sfm.frames, sfm.rec.cameras[0], settings, folder, progress)


def whole_clip(
    frames: Frames, lens: Cameras | None, settings: ColmapSettings, folder: Path, progress: Progress = silent
) -> GroundTruth | NotComputed:
    """Poses of all frames together, made in `folder` or found there; NotComputed where they cannot be placed.

    `lens` is held; without one it is calibrated as the settings say.
    """
    listing = [(f.name, f.path.stat().st_size) for f in frames]
    through = None if lens is None else [lens.model, lens.K.tolist(), lens.distortion.tolist()]
    used = {k: v for k, v in asdict(settings).items() if k not in ("depth", "water", "restore", "threads")}
    key = cache_key(code_version(), listing, through, used)
    record, cameras = folder / "reference.json", folder / "cameras.json"
    stored = json.loads(record.read_text(encoding="utf-8")) if record.is_file() else {}
    if stored.get("key") == key:
        return NotComputed(stored["failed"]) if stored["failed"] else read_ground_truth(cameras)
    everything = replace(frames, frames=tuple(replace(frame, split="train") for frame in frames))
    settings = replace(settings.of_frames_as_filmed(), mapping=replace(settings.mapping, method="auto"))
    failed = ""
    try:
        found = poses.reconstruct(everything, settings, folder / "work", progress, lens)
    except RegistrationError as error:
        failed = f"no reference: {error.what}"
    else:
        found.cameras.save(cameras, found.names, frames.times_of(found.names))
    shutil.rmtree(folder / "work", ignore_errors=True)
    write_text(record, json.dumps({"key": key, "failed": failed, "frames": len(frames)}, indent=2) + "\n")
    return NotComputed(failed) if failed else read_ground_truth(cameras)


def digest(reference: GroundTruth | NotComputed) -> str:
    """Another one for other poses."""
    if isinstance(reference, NotComputed):
        return reference.reason
    return cache_key(reference.names, reference.cameras.cam2world.tolist())
