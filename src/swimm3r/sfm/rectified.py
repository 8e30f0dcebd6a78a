"""The frames of a run whose lens no model of COLMAP's describes, drawn anew as a pinhole camera sees them.

They lie in RUN/sfm/rectified, with the way there in rectification.json and the pinhole's lens as the one that their
source states; prepared frames stay as they are. Everything after works on them, or on what `rectified_rows` makes of
them, and `run_frames` finds which.
"""

import json
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path

import torch

from swimm3r.errors import InputError
from swimm3r.imaging.rectification import Rectification, from_key
from swimm3r.io import images
from swimm3r.io.calibration.run import run_with_lens
from swimm3r.io.files.atomic import atomic_folder, write_text
from swimm3r.io.files.damage import guard, remake
from swimm3r.io.files.json_file import read_json
from swimm3r.prepare import load_frames
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import MASKS, Frame, Frames, write_index
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.sfm.rectified_rows import (
    RECTIFIED_ROWS,
    has_rectified_rows,
    rectified_name,
    rows_as_filmed,
    run_turns,
)
from swimm3r.sfm.settings import LensSettings, SfmSettings

RECTIFIED = Path("sfm") / "rectified"
AS_FILMED = "masks_as_filmed"
_RECORD = "rectification.json"
_LENS = "cameras.txt"
_STEP = "rectifying frames"


class BentImagesError(InputError):
    """No lens of COLMAP's models explains the images; `rectification` leads to images that one does."""

    def __init__(self, rectification: Rectification) -> None:
        super().__init__(
            "no lens of COLMAP's models explains how these images are bent",
            cause="the camera stretches what it films, as GoPro's SuperView does, or films through a curved window",
            hint="swimm3r run, which rectifies them; in Python, swimm3r.rectify_frames(frames, error.rectification, "
            "folder), and reconstruct those",
        )
        self.rectification = rectification

    def __reduce__(self) -> tuple[type["BentImagesError"], tuple[Rectification]]:
        return BentImagesError, (self.rectification,)  # between processes


@dataclass(frozen=True)
class _Document:
    """rectification.json."""

    numbers: tuple[float, ...]
    width: int
    height: int
    rectified_width: int
    rectified_height: int


def is_rectified(run: Path) -> bool:
    """Return whether a run works on rectified frames; their folder appears whole."""
    return (run / RECTIFIED).is_dir()


def run_frames(run: Path) -> Frames:
    """The frames that a run's structure from motion and all after it work on: rectified ones where there are any.

    Raises InputError where they are incomplete.
    """
    if has_rectified_rows(run):
        return load_frames(run / RECTIFIED_ROWS)
    return load_frames(run / RECTIFIED if is_rectified(run) else run / "prepare")


def run_rectification(run: Path) -> Rectification | None:
    """The way from prepared images of a run to rectified ones; None where its frames are as prepared.

    Raises InputError where its record is damaged.
    """
    if not is_rectified(run):
        return None
    path = run / RECTIFIED / _RECORD
    remedy = remake(path.parent)
    document = read_json(path, _Document, remedy)
    with guard(path, remedy):
        return from_key(*astuple(document))


def rectified_truth(run: Path, truth: GroundTruth | None) -> GroundTruth | None:
    """Reference poses as a run's frames have them: named like rectified frames and in the axes of their cameras.

    Depth and images of the truth are of frames as filmed, and rectified ones go without.
    """
    rectification = run_rectification(run)
    if truth is None or (rectification is None and not has_rectified_rows(run)):
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


def rectify_frames(
    frames: Frames, rectification: Rectification, folder: str | Path, progress: Progress = silent
) -> Frames:
    """The frames as a pinhole camera sees them, in a new `folder`, which appears once it is whole.

    Raises InputError where the frames are not of the size of the rectification's lens.
    """
    lens, pinhole = rectification.lens, rectification.pinhole
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
        focal = pinhole.K[0, 0, 0].item()
        middle = f"{pinhole.width / 2} {pinhole.height / 2}"
        write_text(draft / _LENS, f"1 PINHOLE {pinhole.width} {pinhole.height} {focal!r} {focal!r} {middle}\n")
        write_text(draft / _RECORD, json.dumps(asdict(_Document(*rectification.key)), indent=1) + "\n")
        size = {"width": pinhole.width, "height": pinhole.height}
        write_index(draft, replace(frames, frames=tuple(drawn), calibration=draft / _LENS, **size))
    return load_frames(folder)


def write_masks_as_filmed(prepared: Frames, run: Path) -> None:
    """The masks of moving objects of a rectified run as its prepared frames have them, for users to correct."""
    rectification, turns = run_rectification(run), run_turns(run)
    if rectification is None and turns is None:
        raise ValueError(f"{run} works on frames as filmed")
    for frame in prepared.frames:
        name = rectified_name(frame.name)
        path = run / "sfm" / MASKS / f"{name}.png"
        if path.is_file():
            usable = rows_as_filmed(turns, name, images.read_mask(path))
            if rectification is not None:
                usable = rectification.mask_as_filmed(usable)
            images.write_mask(run / "sfm" / AS_FILMED / f"{frame.name}.png", usable)


def _drawn(frame: Frame, rectification: Rectification, folder: Path) -> Frame:
    """A frame with its image and mask rectified, in a folder."""
    name = rectified_name(frame.name)
    images.write_rgb(folder / name, rectification.image(images.read_rgb(frame.path)))
    mask = None
    if frame.mask is not None:
        mask = folder / MASKS / f"{name}.png"
        images.write_mask(mask, rectification.mask(images.read_mask(frame.mask)))
    up = frame.up
    if up is not None:
        x, y, z = (rectification.turn.mT @ torch.tensor(up, dtype=torch.float64)).tolist()
        up = x, y, z
    return replace(frame, name=name, path=folder / name, mask=mask, up=up)
