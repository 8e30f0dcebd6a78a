"""The frames that a run works on: as prepared, rectified, or with rectified rows.

Frames that a pinhole camera sees lie in RUN/sfm/rectified, those exposed at half time, of them or of the prepared ones,
in RUN/sfm/rectified_rows. Prepared frames stay as they are. Frames that structure from motion does not place (test
frames, and those between keyframes) have rows as filmed; test frames are straightened where they are compared, by turns
of their own.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool

from swimm3r.errors import InputError
from swimm3r.imaging.rectification import Rectification
from swimm3r.imaging.turned_rows import RowTurns, mask_as_filmed
from swimm3r.io import images
from swimm3r.io.calibration.run import run_with_lens
from swimm3r.prepare import load_frames
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import MASKS, Frames
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.sfm.rectified.frames import rectified_name, rectify_frames
from swimm3r.sfm.rectified.records import read_rectification, read_turns
from swimm3r.sfm.settings import LensSettings, SfmSettings

RECTIFIED = Path("sfm") / "rectified"
RECTIFIED_ROWS = Path("sfm") / "rectified_rows"
AS_FILMED = "masks_as_filmed"


def is_rectified(run: Path) -> bool:
    """Return whether a run works on rectified frames; their folder appears whole."""
    return (run / RECTIFIED).is_dir()


def has_rectified_rows(run: Path) -> bool:
    """Return whether a run works on frames with rectified rows; their folder appears whole."""
    return (run / RECTIFIED_ROWS).is_dir()


def rectify_run(run: str | Path, rectification: Rectification | RowTurns, progress: Progress = silent) -> None:
    """Redraw the frames that a run works on; from here on it works on these.

    Raises InputError where they are not of the size of the rectification's lens.
    """
    into = RECTIFIED if isinstance(rectification, Rectification) else RECTIFIED_ROWS
    rectify_frames(run_frames(run), rectification, Path(run) / into, progress)


def run_frames(run: str | Path) -> Frames:
    """The frames that a run's structure from motion and all after it work on: rectified ones where there are any.

    Raises InputError where they are incomplete.
    """
    run = Path(run)
    if has_rectified_rows(run):
        return load_frames(run / RECTIFIED_ROWS)
    return load_frames(run / RECTIFIED if is_rectified(run) else run / "prepare")


def run_rectification(run: Path) -> Rectification | None:
    """The way from prepared images of a run to rectified ones; None where its frames are as prepared.

    Raises InputError where its record is damaged.
    """
    return read_rectification(run / RECTIFIED) if is_rectified(run) else None


def run_turns(run: Path) -> RowTurns | None:
    """The turns that a run's frames were rectified by, by the names they have since; None where rows are as filmed.

    Raises InputError where their record is damaged.
    """
    return read_turns(run / RECTIFIED_ROWS) if has_rectified_rows(run) else None


def run_truth(run: Path, frames: Frames, truth: GroundTruth | None) -> GroundTruth | None:
    """A clip's truth as the frames that its run works on have it: of their size and names, in their cameras' axes.

    Depth and images of the truth are of frames as filmed, and rectified ones go without.
    """
    if truth is None:
        return None
    truth, rectification = truth.at_size(frames.width, frames.height), run_rectification(run)
    if rectification is None and not has_rectified_rows(run):
        return truth
    cameras = truth.cameras
    if rectification is not None:
        turn = torch.eye(4, dtype=torch.float64)
        turn[:3, :3] = rectification.turn
        cameras = replace(rectification.pinhole[[0] * len(truth.names)], cam2world=cameras.cam2world.double() @ turn)
    names = tuple(rectified_name(name) for name in truth.names)
    return replace(truth, names=names, cameras=cameras, folder=None)


def given_rectification(settings: SfmSettings, frames: Frames) -> Rectification | None:
    """That of the run whose lens the settings take (--lens-from), for frames of this size; None without.

    Raises UsageError where there is no such run, InputError where its images have another shape than the frames.
    """
    if not isinstance(settings, LensSettings) or settings.lens_from is None:
        return None
    found = run_rectification(run_with_lens(settings.lens_from))
    if found is None:
        return None
    if not found.is_of(frames.width, frames.height):
        raise InputError(
            f"the lens of {settings.lens_from} bends images of {found.lens.width}x{found.lens.height}, and the prepared"
            f" frames are {frames.width}x{frames.height}",
            cause="the camera recorded them in another mode",
            hint="a run of a clip in the same mode, or none: the frames may say how their lens bends",
        )
    return found.resized(frames.width, frames.height)


def write_masks_as_filmed(prepared: Frames, run: Path) -> None:
    """The masks of moving objects of a rectified run as its prepared frames have them, for users to correct."""
    rectification, turns = run_rectification(run), run_turns(run)
    if rectification is None and turns is None:
        raise ValueError(f"{run} works on frames as filmed")
    for frame in prepared.frames:
        name = rectified_name(frame.name)
        path = run / "sfm" / MASKS / f"{name}.png"
        if path.is_file():
            usable = _rows_as_filmed(turns, name, images.read_mask(path))
            if rectification is not None:
                usable = rectification.mask_as_filmed(usable)
            images.write_mask(run / "sfm" / AS_FILMED / f"{frame.name}.png", usable)


def _rows_as_filmed(found: RowTurns | None, name: str, usable: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """A mask of a rectified frame as its frame before has it; as it is where rows are as filmed."""
    if found is None or name not in found.turns:
        return usable
    return mask_as_filmed(usable, found.lens, found.turns[name])
