"""Run folders as scenes and methods of a table: one scene per clip, one method per way its poses were found."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from swimm3r.bench.settings import IMPORTED
from swimm3r.datasets import layouts
from swimm3r.errors import InputError
from swimm3r.io.images import image_size
from swimm3r.io.video import Video
from swimm3r.pipeline.finished_sfm import FinishedSfm, open_finished_sfm
from swimm3r.pipeline.presets import RunSettings
from swimm3r.pipeline.run import run_pipeline
from swimm3r.pipeline.run_settings import with_poses_of
from swimm3r.prepare import check_source
from swimm3r.prepare.image_folder import images_of
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.run_folder import is_run, open_run
from swimm3r.sfm.distillation.settings import RECIPES
from swimm3r.sfm.settings import ColmapModelSettings, ColmapSettings, Mast3rSettings

IMAGES = ("images_wb", "images")  # folders named so lend their clip no name
POSES_REFINED = " + poses"
"""Ends the name of how poses were found where maps refined them, whatever their recipe says."""


@dataclass(frozen=True)
class SfmRun:
    """A run folder with finished structure from motion."""

    folder: Path
    scene: str  # the clip's name
    sfm: str  # how its poses were found
    frames: str  # the same for runs that took the same frames in the same way

    def open(self) -> FinishedSfm:
        """The inputs of a map's training."""
        return open_finished_sfm(self.folder)


@dataclass(frozen=True)
class Clip:
    """One scene with every run of it, the first of which lends its frames and its knowledge of the lens."""

    name: str
    runs: tuple[SfmRun, ...]


def clip_name(source: Path) -> str:
    """The name of a clip: a folder's own, or that of the one around it where it is called `images`; a file's stem."""
    source = source.absolute()
    named = source.parent if source.name.lower() in IMAGES else source
    return named.stem if named.suffix and not named.is_dir() else named.name


def clip_names(sources: Sequence[Path]) -> list[str]:
    """The names of clips. Raises InputError where two have one name."""
    names = [clip_name(source) for source in sources]
    twice = sorted(name for name in names if names.count(name) > 1)
    if twice:
        raise InputError(
            f"two of the clips have one name: {', '.join(twice)}",
            cause="results are kept by the clips' names",
            hint="another name for one of them",
        )
    return names


def clips_of(folders: Sequence[Path]) -> list[Clip]:
    """The runs by clip. Two runs of a clip whose poses were found in the same way are told apart by their folders.

    Raises InputError where a folder holds no finished structure from motion, runs of one clip took other frames, or
    two clips have one name.
    """
    found: dict[str, list[SfmRun]] = {}
    prints: dict[str, str] = {}
    for folder in folders:
        sfm, run = open_finished_sfm(folder), open_run(folder, "sfm")
        name = clip_name(Path(run.input.path))
        if prints.setdefault(name, run.input.fingerprint) != run.input.fingerprint:
            raise InputError(
                f"two clips have the name {name}",
                cause="results are kept by the clips' names",
                hint="another name for one of them, and a run of it under that name",
            )
        label = sfm_label(sfm.settings, sfm.rec.backend)
        found.setdefault(name, []).append(SfmRun(folder, name, label, run.stages["prepare"].key))
    return [Clip(name, _told_apart(runs)) for name, runs in found.items()]


def made_runs(
    inputs: Sequence[Path],
    out: Path,
    settings: RunSettings,
    given_poses: bool = False,
    progress: Progress = silent,
) -> tuple[Path, ...]:
    """Run folders as they are; of clips, new ones up to their structure from motion in OUT/runs.

    With `given_poses` a clip is a folder of images with their COLMAP model, whose poses are taken. Raises InputError
    where it has none, and before anything is made where two clips have one name.
    """
    clip_names([given for given in inputs if not is_run(given)])
    runs = []
    for given in inputs:
        if is_run(given):
            runs.append(given)
            continue
        runs.append(out / "runs" / clip_name(given))
        source, chosen = _with_given_poses(given, settings) if given_poses else (given, settings)
        run_pipeline(source, runs[-1], chosen, redo=True, last_stage="sfm", progress=progress)
    return tuple(runs)


def _with_given_poses(scene: Path, settings: RunSettings) -> tuple[Path, RunSettings]:
    """The images of a scene as SeaThru-NeRF and its kin lay it out, and settings that take its model's poses."""
    here = layouts.folder(scene, scene) if scene.is_dir() else None
    images, model = (None, None) if here is None else (here.child(*IMAGES), here.child("sparse", "colmap"))
    if images is None or model is None:
        raise InputError(
            f"{scene} is no folder of images with their COLMAP model",
            cause=f"given poses are looked for in sparse/ or colmap/ beside {' or '.join(IMAGES)}",
            hint="without --given-poses they are found anew",
        )
    assert isinstance(settings.sfm, ColmapSettings)
    return images, replace(settings, sfm=with_poses_of(model, settings.sfm))


def original_pixels(source: Path, frames: Frames) -> float:
    """Pixels of the clip's own images per pixel of the frames made of them."""
    source = check_source(source)
    width = image_size(images_of(source).paths[0])[0] if source.is_dir() else Video(source).width
    return width / frames.width


def sfm_label(settings: RunSettings, backend: str) -> str:
    """The name of the method that estimated the poses."""
    match settings.sfm:
        case ColmapSettings(mapping=mapping) if mapping.method != "auto":
            return f"{backend}-{mapping.method}"
        case ColmapModelSettings(model=model) if model.parent.name in IMPORTED:
            return model.parent.name
        case ColmapModelSettings(model=model) if backend == "COLMAP model":
            return f"{backend} ({model.name})"
        case Mast3rSettings(adapter=Path() as adapter) if adapter.parent.name in RECIPES:
            return adapter.parent.name
        case _:
            return backend


def _told_apart(runs: list[SfmRun]) -> tuple[SfmRun, ...]:
    if len({run.frames for run in runs}) > 1:
        raise InputError(
            f"the runs of {runs[0].scene} took different frames",
            cause="they were made with other --fps, --pick or --long-side, and their scores would not compare",
            hint="runs of one clip with the same frames, as --preset and the options for frames decide",
        )
    labels = [run.sfm for run in runs]
    return tuple(
        run
        if labels.count(run.sfm) == 1
        else SfmRun(run.folder, run.scene, f"{run.sfm} ({run.folder.resolve().name})", run.frames)
        for run in runs
    )
