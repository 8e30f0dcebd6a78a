"""Structure from motion: frames in, one `Reconstruction` out, whichever method found it."""

from pathlib import Path
from tempfile import mkdtemp
from types import ModuleType
from typing import TYPE_CHECKING

from swimm3r.errors import InputError
from swimm3r.progress import Progress, watched
from swimm3r.sfm.settings import ColmapModelSettings, ColmapSettings, Mast3rSettings, SfmSettings
from swimm3r.tasks.settings import EngineSettings

if TYPE_CHECKING:
    import swimm3r.scene.frames
    import swimm3r.scene.placement
    import swimm3r.scene.reconstruction

__all__ = ["ColmapModelSettings", "ColmapSettings", "Mast3rSettings", "SfmSettings", "reconstruct"]


def reconstruct(
    frames: "swimm3r.scene.frames.Frames",
    settings: SfmSettings | None = None,
    folder: str | Path | None = None,
    progress: Progress | None = None,
    engine: EngineSettings = EngineSettings(),  # noqa: B008 - records are frozen
    navigator: "swimm3r.scene.placement.Navigator | None" = None,
) -> "swimm3r.scene.reconstruction.Reconstruction":
    """Cameras, points, dense depth, water and restored cloud of a set of frames, made from `frames.train` alone.

    Frames between keyframes get poses in cameras_between.json (`sfm.between`), and all frames that a given model places
    in cameras_imported.json (`sfm.imported.model_poses`).

    `settings` choose the method: `ColmapSettings()` by default, `swimm3r.PRESETS["fast"].sfm` the quickest. Works in
    `folder` (a new temporary one by default) and goes on from what an interrupted call left there. A terminal or a
    notebook shows how far it is, unless `progress` is given (`swimm3r.silent`: nothing). `engine` can spread the chunks
    of a long clip and dense depth over processes or a cluster. A `navigator` (`swimm3r.scale.navigation`)
    holds the path of COLMAP's mapping, and joins parts that share no ground; other back ends do without.
    Raises InputError for fewer than 2 frames, RegistrationError where too few can be placed, and a RectifiableError
    (`sfm.rectified.frames`): BentImagesError where no lens model explains the images and `settings.rectify` is "auto",
    TurnedRowsError where the camera turned while rows were exposed and `settings.shutter` is "auto".
    """
    settings = settings or ColmapSettings()
    used = frames.train
    if len(used) < 2:
        raise InputError(
            f"structure from motion needs at least 2 frames, got {len(used)}",
            cause="the clip is too short or the sampling too coarse",
            hint="a longer clip or a higher --fps",
        )
    with watched(progress) as told:
        work = Path(folder or mkdtemp(prefix="swimm3r-sfm-"))
        rec = _backend(settings).reconstruct(used, settings, work, told, engine, navigator)
        if len(frames.between):
            from swimm3r.sfm.between import place_between

            place_between(rec, frames, work, told)
        if isinstance(settings, ColmapModelSettings):
            from swimm3r.sfm.imported.model_poses import keep_model_poses

            keep_model_poses(frames, settings.model, work)
        return rec


def check_files(settings: SfmSettings) -> None:
    """Raise the error of the first file named by the settings that cannot be used: InputError or WeightsError."""
    _backend(settings).check_files(settings)


def _backend(settings: SfmSettings) -> ModuleType:
    """The module of a back end: `reconstruct` and `check_files`."""
    match settings:
        case ColmapSettings():
            from swimm3r.sfm.backends import colmap as colmap_backend

            return colmap_backend
        case Mast3rSettings():
            from swimm3r.sfm.backends import mast3r as mast3r_backend

            return mast3r_backend
        case ColmapModelSettings():
            from swimm3r.sfm.backends import imported as imported_backend

            return imported_backend
