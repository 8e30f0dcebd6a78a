"""The frames of a run whose rows were exposed one after another while the camera turned, drawn anew as at half time.

They lie in RUN/sfm/rectified_rows, with the turns and the lens in turns.json; the frames they are made of stay as they
are. Everything after works on them. Frames that structure from motion does not place (test frames, and those between
keyframes) are as filmed; test frames are straightened where they are compared, by turns of their own.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from swimm3r.cameras import Cameras
from swimm3r.errors import InputError
from swimm3r.imaging.turned_rows import at_half_time, mask_as_filmed, mask_at_half_time
from swimm3r.io import images
from swimm3r.io.files.atomic import atomic_folder, write_text
from swimm3r.io.files.damage import guard, remake
from swimm3r.io.files.json_file import read_json
from swimm3r.prepare import load_frames
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import MASKS, Frame, Frames, write_index

RECTIFIED_ROWS = Path("sfm") / "rectified_rows"
_RECORD = "turns.json"
_STEP = "rectifying rows"


@dataclass(frozen=True)
class RowTurns:
    """The turns of one camera while each of some frames was exposed."""

    lens: Cameras  # one camera, its pose unused
    turns: dict[str, Float[np.ndarray, "3"]]  # rotation vectors, radians in the camera's axes, by frame

    @property
    def typical(self) -> float:
        """Median angle in degrees."""
        return float(np.degrees(np.median([np.linalg.norm(turn) for turn in self.turns.values()])))


class TurnedRowsError(InputError):
    """Rows were exposed one after another while the camera turned; `turns` leads to frames exposed at once."""

    def __init__(self, turns: RowTurns) -> None:
        super().__init__(
            f"the camera turned by {turns.typical:.1f} degrees while the rows of a frame were exposed in turn",
            cause="the camera has a rolling shutter, and is held in the hand",
            hint="swimm3r run, which rectifies the rows; in Python, swimm3r.rectify_rows(frames, error.turns, folder), "
            'and reconstruct those; or shutter="global" for frames as filmed',
        )
        self.turns = turns

    def __reduce__(self) -> tuple[type["TurnedRowsError"], tuple[RowTurns]]:
        return TurnedRowsError, (self.turns,)  # between processes


@dataclass(frozen=True)
class _Document:
    """turns.json."""

    model: str
    width: int
    height: int
    K: tuple[tuple[float, float, float], ...]
    distortion: tuple[float, ...]
    turns: dict[str, tuple[float, float, float]]


def has_rectified_rows(run: Path) -> bool:
    """Return whether a run works on frames with rectified rows; their folder appears whole."""
    return (run / RECTIFIED_ROWS).is_dir()


def run_turns(run: Path) -> RowTurns | None:
    """The turns that a run's frames were rectified by, by the names they have since; None where rows are as filmed.

    Raises InputError where their record is damaged.
    """
    if not has_rectified_rows(run):
        return None
    path = run / RECTIFIED_ROWS / _RECORD
    remedy = remake(path.parent)
    document = read_json(path, _Document, remedy)
    with guard(path, remedy):
        K = torch.tensor(document.K, dtype=torch.float64).reshape(1, 3, 3)
        distortion = torch.tensor(document.distortion, dtype=torch.float64)[None]
        origin = torch.eye(4, dtype=torch.float64)[None]
        lens = Cameras(K, distortion, origin, document.width, document.height, document.model)
    return RowTurns(lens, {name: np.array(turn) for name, turn in document.turns.items()})


def rectify_rows(frames: Frames, found: RowTurns, folder: str | Path, progress: Progress = silent) -> Frames:
    """The frames as exposed at half time, in a new `folder`, which appears once it is whole.

    Raises InputError where the frames are not of the size of the lens.
    """
    lens = found.lens
    if (frames.width, frames.height) != (lens.width, lens.height):
        raise InputError(
            f"the frames are {frames.width}x{frames.height}, the turns are of images of {lens.width}x{lens.height}",
            cause="they were prepared at another size, or are of another camera",
            hint="rectify the frames that the turns were found from",
        )
    folder = Path(folder)
    with atomic_folder(folder) as draft:
        drawn = []
        for k, frame in enumerate(frames.frames):
            progress(_STEP, k, len(frames))
            drawn.append(_drawn(frame, lens, found.turns.get(frame.name, np.zeros(3)), draft))
        progress(_STEP, len(frames), len(frames))
        turns = {rectified_name(name): tuple(turn.tolist()) for name, turn in found.turns.items()}
        K, distortion = lens.K[0].double().tolist(), lens.distortion[0].double().tolist()
        document = {"model": lens.model, "width": lens.width, "height": lens.height, "K": K, "distortion": distortion}
        write_text(draft / _RECORD, json.dumps(document | {"turns": turns}, indent=1) + "\n")
        calibration = frames.calibration
        if calibration is not None:
            kept = draft / calibration.name
            kept.write_bytes(calibration.read_bytes())
            calibration = kept
        write_index(draft, replace(frames, frames=tuple(drawn), calibration=calibration, rows_rectified=True))
    return load_frames(folder)


def rows_as_filmed(found: RowTurns | None, name: str, usable: np.ndarray) -> np.ndarray:
    """A mask of a rectified frame as its frame before has it; as it is where rows are as filmed."""
    if found is None or name not in found.turns:
        return usable
    return mask_as_filmed(usable, found.lens, found.turns[name])


def rectified_name(name: str) -> str:
    """The name of a rectified frame: a PNG, whatever the one before is."""
    return Path(name).with_suffix(".png").as_posix()


def _drawn(frame: Frame, lens: Cameras, turn: Float[np.ndarray, "3"], folder: Path) -> Frame:
    """A frame with its image and mask as at half time, in a folder."""
    name = rectified_name(frame.name)
    image = images.read_rgb(frame.path)
    usable = None if frame.mask is None else images.read_mask(frame.mask)
    if turn.any():
        usable = np.ones(image.shape[:2], dtype=bool) if usable is None else usable
        image, usable = at_half_time(image, lens, turn), mask_at_half_time(usable, lens, turn)
    images.write_rgb(folder / name, image)
    mask = None
    if usable is not None:
        mask = folder / MASKS / f"{name}.png"
        images.write_mask(mask, usable)
    return replace(frame, name=name, path=folder / name, mask=mask)
