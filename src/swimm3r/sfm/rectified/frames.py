"""Frames as a pinhole camera sees them, or as exposed at half time, in a folder with the record of the way there."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool

from swimm3r.errors import InputError
from swimm3r.imaging.rectification import Rectification
from swimm3r.imaging.turned_rows import RowTurns, at_half_time, mask_at_half_time
from swimm3r.io import images
from swimm3r.io.files.atomic import atomic_folder
from swimm3r.prepare import load_frames
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import MASKS, Frame, Frames, write_index
from swimm3r.sfm.rectified.records import write_pinhole, write_rectification, write_turns

_STEP = "rectifying frames"


class RectifiableError(InputError):
    """Images that structure from motion explains once they are redrawn; `rectification` leads to them."""

    def __init__(self, rectification: Rectification | RowTurns, what: str, *, cause: str, hint: str) -> None:
        super().__init__(what, cause=cause, hint=hint)
        self.rectification = rectification


class BentImagesError(RectifiableError):
    """No lens of COLMAP's models explains the images."""

    def __init__(self, rectification: Rectification) -> None:
        super().__init__(
            rectification,
            "no lens of COLMAP's models explains how these images are bent",
            cause="the camera stretches what it films, as GoPro's SuperView does, or films through a curved window",
            hint="swimm3r run, which rectifies them; in Python, swimm3r.rectify_frames(frames, error.rectification, "
            "folder), and reconstruct those",
        )

    def __reduce__(self) -> tuple[type["BentImagesError"], tuple[Rectification | RowTurns]]:
        return BentImagesError, (self.rectification,)  # between processes


class TurnedRowsError(RectifiableError):
    """Rows were exposed one after another while the camera turned."""

    def __init__(self, turns: RowTurns) -> None:
        super().__init__(
            turns,
            f"the camera turned by {turns.typical:.1f} degrees while the rows of a frame were exposed in turn",
            cause="the camera has a rolling shutter, and is held in the hand",
            hint="swimm3r run, which rectifies the rows; in Python, swimm3r.rectify_frames(frames, error.rectification,"
            ' folder), and reconstruct those; or shutter="global" for frames as filmed',
        )

    def __reduce__(self) -> tuple[type["TurnedRowsError"], tuple[Rectification | RowTurns]]:
        return TurnedRowsError, (self.rectification,)  # between processes


def rectify_frames(
    frames: Frames, rectification: Rectification | RowTurns, folder: str | Path, progress: Progress = silent
) -> Frames:
    """The frames as a pinhole camera sees them, or as exposed at half time, in a new `folder`, which appears once it is
    whole.

    Frames that have no turn stay as they are. Raises InputError where the frames are not of the size of the lens that
    the rectification is of.
    """
    lens = rectification.lens
    if (frames.width, frames.height) != (lens.width, lens.height):
        raise InputError(
            f"the frames are {frames.width}x{frames.height}, the lens that rectifies them is of images of"
            f" {lens.width}x{lens.height}",
            cause="they were prepared at another size, or are of another camera",
            hint="prepare them at the size of those that the lens was found from",
        )
    folder = Path(folder)
    with atomic_folder(folder) as draft:
        drawn = []
        for k, frame in enumerate(frames.frames):
            progress(_STEP, k, len(frames))
            drawn.append(_drawn(frame, rectification, draft))
        progress(_STEP, len(frames), len(frames))
        frames = replace(frames, frames=tuple(drawn))
        match rectification:
            case Rectification(pinhole=pinhole):
                write_rectification(rectification, draft)
                stated = write_pinhole(pinhole, draft)
                frames = replace(frames, calibration=stated, width=pinhole.width, height=pinhole.height)
            case RowTurns(turns=turns):
                write_turns(replace(rectification, turns={rectified_name(name): turns[name] for name in turns}), draft)
                if frames.calibration is not None:
                    stated = draft / frames.calibration.name
                    stated.write_bytes(frames.calibration.read_bytes())
                    frames = replace(frames, calibration=stated)
                frames = replace(frames, rows_rectified=True)
        write_index(draft, frames)
    return load_frames(folder)


def rectified_name(name: str) -> str:
    """The name of a rectified frame: a PNG, whatever the one before is."""
    return Path(name).with_suffix(".png").as_posix()


def _drawn(frame: Frame, rectification: Rectification | RowTurns, folder: Path) -> Frame:
    """A frame with its image and mask redrawn, in a folder."""
    name, up = rectified_name(frame.name), frame.up
    image = images.read_rgb(frame.path)
    usable = None if frame.mask is None else images.read_mask(frame.mask)
    match rectification:
        case Rectification(turn=turn):
            image, usable = rectification.image(image), None if usable is None else rectification.mask(usable)
            if up is not None:
                x, y, z = (turn.mT @ torch.tensor(up, dtype=torch.float64)).tolist()
                up = x, y, z
        case RowTurns(lens=lens, turns=turns) if frame.name in turns:
            usable = np.ones(image.shape[:2], dtype=bool) if usable is None else usable
            turn = turns[frame.name]
            image, usable = at_half_time(image, lens, turn), mask_at_half_time(usable, lens, turn)
    images.write_rgb(folder / name, image)
    return replace(frame, name=name, path=folder / name, mask=_written(usable, folder / MASKS / f"{name}.png"), up=up)


def _written(usable: Bool[np.ndarray, "h w"] | None, path: Path) -> Path | None:
    """The path of a mask, once it is there."""
    if usable is None:
        return None
    images.write_mask(path, usable)
    return path
