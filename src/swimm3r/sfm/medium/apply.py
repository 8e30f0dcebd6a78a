"""The water of a reconstruction with known cameras and depth, and everything restored with it."""

import logging
from dataclasses import replace
from pathlib import Path

from swimm3r.errors import InputError
from swimm3r.imaging.appearance import decide_appearance
from swimm3r.imaging.settings import AppearanceSettings
from swimm3r.io import images
from swimm3r.medium import MediumFit
from swimm3r.progress import Progress, silent
from swimm3r.scene.frame_changes import STEADY
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import QualityWarning, Reconstruction
from swimm3r.sfm.medium.backdrop import Backdrop
from swimm3r.sfm.medium.dense_cloud import MIN_TRANSMITTANCE, dense_cloud
from swimm3r.sfm.medium.dense_tracks import fuse_depth
from swimm3r.sfm.medium.flicker import with_steady
from swimm3r.sfm.medium.from_head import PredictedWater, dive_fit, predicted_images
from swimm3r.sfm.medium.light import judge_light
from swimm3r.sfm.medium.plausibility import water_warnings, with_like_channels
from swimm3r.sfm.medium.restore import RestoredImage, restored_images, white_balance, within_white
from swimm3r.sfm.medium.samples import WaterSamples, collect_samples
from swimm3r.sfm.medium.seathru import fit_medium
from swimm3r.sfm.medium.settings import LightChoice, MediumSettings, SeathruSettings

log = logging.getLogger(__name__)


def fit_lit(samples: WaterSamples, settings: SeathruSettings, light: LightChoice) -> tuple[MediumFit, MediumFit]:
    """The water on values as stored and in linear light, under the sun or a lamp as given or as the samples tell.

    That on values as stored, which images are restored with, has like channels where nothing determines it.
    """
    evidence = None
    stored = fit_medium(samples, settings, "srgb", "lamp" if light == "lamp" else "sun")
    if light == "auto":
        evidence = judge_light(samples, stored, settings)
        light = "sun" if evidence is None else evidence.light
        if light == "lamp":
            stored = fit_medium(samples, settings, "srgb", "lamp")
        log.info("the light is taken for %s", "a lamp's on the camera" if light == "lamp" else "the sun's")
    linear = fit_medium(samples, settings, "linear", light)
    stored = with_like_channels(stored, samples.I[samples.measured].mean(0))
    return replace(stored, light=evidence), replace(linear, light=evidence)


def with_water(
    rec: Reconstruction,
    frames: Frames,
    settings: MediumSettings,
    folder: Path,
    progress: Progress = silent,
    predicted: PredictedWater | None = None,
) -> Reconstruction:
    """The reconstruction with its water, in both encodings, restored cloud and backdrop, and restored images on disk.

    The water is that of the frames as filmed; where the sunlight flickers, cloud and images are those of the frames in
    steady light, and where the camera exposed and balanced frames each by itself, in their common colors. Where depth
    is too scarce to tell the water, the poses and depth stand without it, under a warning. `predicted` is the physics
    head's water, which then restores images and cloud, with the light as filmed; only the fit in linear light is
    Sea-Thru's.
    """
    rec = replace(rec, steady=None, own_colors=None)
    frames = rec.still(frames)
    tracks = fuse_depth(rec, frames, settings.water.tracks, progress)
    samples = collect_samples(rec, frames, tracks, settings.water, progress)
    try:
        if predicted is None:
            stored, linear = fit_lit(samples, settings.water, settings.light)
        else:  # the head knows of no lamp
            stored = dive_fit(predicted, rec, settings.water)
            linear = fit_medium(samples, settings.water, "linear")
    except InputError as failure:
        warning = QualityWarning(f"The water was not estimated: {failure.what}.", f"Try: {failure.hint}")
        return replace(rec, warnings=(*rec.warnings, warning))
    doubts = water_warnings(stored, gray=frames.gray, predicted=predicted is not None, linear=linear)
    rec = replace(rec, medium=stored, medium_linear=linear, warnings=(*rec.warnings, *doubts))
    if settings.flicker == "auto" and predicted is None:
        rec = with_steady(rec, frames, settings.restore, folder / STEADY, progress)
        frames = rec.still(frames)
    if settings.appearance == "auto" and predicted is None:
        rec = with_own_colors(rec, frames)
        frames = rec.evened(frames)
    at, eps_inv = (None, MIN_TRANSMITTANCE) if predicted is None else (predicted.at, predicted.head.min_transmittance)
    fusion = settings.water.tracks
    cloud = dense_cloud(rec, frames, tracks, stored, settings.restore, fusion, progress, at, eps_inv)
    rec = replace(rec, cloud=cloud)
    balance = white_balance(rec, settings.restore)
    if settings.restore.white_balance:
        balance = within_white(rec, frames, balance)
    rec = replace(rec, white_balance=balance)
    filmed = rec.white_balance.source == "filmed"

    def keep(i: int, image: RestoredImage) -> None:
        shown = frames.image(frames.index(rec.names[i])) if filmed else image.shown
        images.write_rgb(folder / "restored" / f"{rec.names[i]}.png", shown.numpy())
        images.write_rgb_16(folder / "restored_physical" / f"{rec.names[i]}.png", image.clear.numpy())

    restored = (
        restored_images(rec, frames, settings.restore, progress, keep)
        if predicted is None
        else predicted_images(rec, frames, predicted, progress, keep)
    )
    backdrop = Backdrop(rec, frames)
    for i, image in restored:
        backdrop.add(i, image)
    return replace(rec, backdrop=backdrop.points())


def with_own_colors(rec: Reconstruction, frames: Frames) -> Reconstruction:
    """The reconstruction with the colors of single frames, where its points tell that exposure or balance changed."""
    found = decide_appearance(rec, frames, rec.names, AppearanceSettings())
    if found.colors is not None:
        log.info("frames are restored in one exposure and white balance: %s", found.decision.reason)
    return replace(rec, own_colors=found.colors)
