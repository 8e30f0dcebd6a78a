"""What follows once cameras and dense depth are known, whoever found them: the water, and everything without it."""

from dataclasses import replace
from pathlib import Path

from swimm3r.errors import InputError
from swimm3r.frames import Frames
from swimm3r.io import images
from swimm3r.progress import Progress, silent
from swimm3r.reconstruction import Caution, Reconstruction
from swimm3r.sfm.predicted_water import PredictedWater, dive_fit, restore_predicted
from swimm3r.sfm.restore import display_gains, restore_picture, restored_cloud
from swimm3r.sfm.seathru import fit_medium
from swimm3r.sfm.settings import RestoreSettings, SfmSettings
from swimm3r.sfm.tracks import fuse_depth, shared_rays
from swimm3r.sfm.water_samples import gather_samples


def with_water(
    rec: Reconstruction,
    frames: Frames,
    settings: SfmSettings,
    folder: Path,
    progress: Progress = silent,
    predicted: PredictedWater | None = None,
) -> Reconstruction:
    """The reconstruction with its water, in both encodings, its restored cloud, and the restored pictures on disk.

    Where depth is too scarce to tell the water, the poses and depth stand without it, under a caution. `predicted` is
    the physics head's water, which then restores pictures and cloud; only the fit in linear light is Sea-Thru's.
    """
    tracks = fuse_depth(rec, frames, settings.water.tracks, progress)
    samples = gather_samples(rec, frames, tracks, settings.water, progress)
    try:
        stored = (
            fit_medium(samples, settings.water, "srgb")
            if predicted is None
            else dive_fit(predicted, rec, settings.water)
        )
        linear = fit_medium(samples, settings.water, "linear")
    except InputError as failure:
        caution = Caution(f"The water was not estimated: {failure.what}.", f"Try: {failure.hint}")
        return replace(rec, cautions=(*rec.cautions, caution))
    medium_at = None if predicted is None else predicted.at
    cloud = restored_cloud(rec, frames, tracks, stored, settings.restore, progress, medium_at)
    rec = replace(rec, medium=stored, medium_linear=linear, cloud=cloud)
    if predicted is not None:
        restore_predicted(rec, frames, predicted, folder / "restored", progress)
        return rec
    write_restored_pictures(rec, frames, settings.restore, folder / "restored", progress)
    return rec


def write_restored_pictures(
    rec: Reconstruction, frames: Frames, settings: RestoreSettings, folder: Path, progress: Progress = silent
) -> None:
    """folder/NAME.png for every registered frame with some known depth, white-balanced for the eye where asked for."""
    assert rec.medium is not None
    assert rec.cloud is not None
    gains = display_gains(rec.cloud.restored) if settings.white_balance else None
    rays = shared_rays(rec.cameras)
    for i, name in enumerate(rec.names):
        progress("restoring pictures", i, len(rec.names))
        depth = rec.depth[name]
        if (depth.z_depth > 0).any():
            J = restore_picture(frames.image(frames.index(name)), depth, rays[i], rec.medium, settings, gains)
            images.write_rgb(folder / f"{name}.png", J.numpy())
    progress("restoring pictures", len(rec.names), len(rec.names))
