"""The files that a run is given, looked into before any work is done on them."""

import logging
from collections.abc import Collection
from pathlib import Path

from swimm3r.errors import UsageError
from swimm3r.io.bags.bag import is_bag
from swimm3r.pipeline.presets import RunSettings
from swimm3r.prepare import check_source
from swimm3r.prepare.clip import open_clip
from swimm3r.prepare.image_folder import source_digest
from swimm3r.prepare.masks import check_masks
from swimm3r.prepare.rig import NONE, check_rig
from swimm3r.scale.sources import check_sources
from swimm3r.scene.ground_truth import FOLDER, GroundTruth, read_ground_truth
from swimm3r.scene.run_folder import STAGES, is_run, read_run
from swimm3r.sfm import ColmapSettings, check_files

log = logging.getLogger(__name__)


def input_fingerprint(source: Path, folder: Path) -> str:
    """Digest of an input's files.

    Of an input that is not on this computer it is the one the folder holds, where the folder is a run of it whose
    frames are prepared. Raises InputError where the input cannot be used.
    """
    if not source.exists() and is_run(folder):
        run = read_run(folder)
        if Path(run.input.path) == source and run.is_finished("prepare"):
            log.info("%s is not on this computer: the run goes on with the frames of %s", source, folder / "prepare")
            return run.input.fingerprint
    check_source(source)
    return source_digest(source, leave_out=folder)


def check_inputs(
    source: Path,
    settings: RunSettings,
    reference: Path | None = None,
    stages: Collection[str] = STAGES,
    *,
    scaled: bool = False,
) -> None:
    """Raise the error of the first input of these stages that cannot be used: InputError, WeightsError or UsageError.

    A model is read whole, which takes seconds where preparing frames takes minutes. Of a `scaled` run the files that
    tell scale and place are not looked for.
    """
    if "prepare" in stages:
        if is_bag(check_source(source)):
            open_clip(source, settings.frames)  # its camera is chosen
        check_masks(settings.frames)
        check_rig(source, settings.frames)
    _check_adjusted(settings)
    truth_of(source, reference)
    if "sfm" in stages:
        check_files(settings.sfm)
    if not scaled:
        check_sources(settings.scale)


def _check_adjusted(settings: RunSettings) -> None:
    """Raise UsageError where a rig is asked for and its cameras would not be adjusted as one."""
    if settings.frames.rig in ((), (NONE,)) and settings.frames.rig_calibration is None:
        return
    if not isinstance(settings.sfm, ColmapSettings):
        raise UsageError(
            "a rig is asked for, and poses by MASt3R or of another program's model are those of single frames",
            cause="only COLMAP's mapping adjusts a rig with one pose per instant",
            hint="--backend colmap; or --rig none, which takes the images of one camera after the other",
        )
    if settings.sfm.housing != "none":
        raise UsageError(
            f"a rig is asked for, and its cameras are not adjusted under refraction (--housing {settings.sfm.housing})",
            cause="a port is taken into account for poses of single frames only",
            hint="leave out --housing: a lens that was calibrated or is refined in water takes most of a port; or"
            " --rig none",
        )


def truth_of(source: Path, reference: Path | None) -> GroundTruth | None:
    """The ground truth of a clip: the given reference, else the truth of a synthetic dive."""
    if reference is not None:
        return read_ground_truth(reference)
    beside = source / FOLDER
    return read_ground_truth(beside) if beside.is_dir() else None
