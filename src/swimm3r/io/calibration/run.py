"""The lens that a run found, for other clips of the same camera in the same mode."""

import logging
from contextlib import suppress
from pathlib import Path

import numpy as np

from swimm3r.cameras import DISTORTION_PARAMETERS
from swimm3r.errors import Swimm3rError, UsageError
from swimm3r.io.calibration.record import Calibration
from swimm3r.io.cameras_json import CameraTable, read_cameras
from swimm3r.io.files.cache_key import cache_key
from swimm3r.io.files.damage import Remedy, guard

CAMERAS = Path("sfm") / "cameras.json"
_REMEDY = Remedy("name a run whose structure from motion is finished", fault="has no lens that can be read")

log = logging.getLogger(__name__)


def run_with_lens(folder: Path) -> Path:
    """A run folder, or that run in a folder of runs of one camera which has the most frames in place.

    Raises UsageError where there is none, and InputError where a run's cameras are damaged.
    """
    own = folder / CAMERAS
    found = [own] if own.is_file() else sorted(folder.glob(str(Path("*") / CAMERAS)))
    if not found:
        raise UsageError(
            f"{folder} is neither a run with a lens nor a folder of such runs",
            cause="its structure from motion is not finished, or the name has a slip",
            hint="--lens-from RUN, after swimm3r sfm has finished there",
        )
    if len(found) == 1:
        return found[0].parents[1]
    tables = {path.parents[1]: read_cameras(path) for path in found}
    chosen = max(tables, key=lambda run: len(tables[run].names))
    focals = ", ".join(f"{run.name} {_focal(table):.3f}" for run, table in tables.items())
    log.info("lens of the run %s, with the most frames in place; focal lengths in widths: %s", chosen.name, focals)
    return chosen


def calibration_of_run(folder: Path) -> Calibration:
    """The lens of a run folder, or of a folder of runs of one camera (`run_with_lens`).

    Raises UsageError where there is none, and InputError where a run's cameras are damaged or differ in their lens.
    """
    run = run_with_lens(folder)
    table = read_cameras(run / CAMERAS)
    with guard(run / CAMERAS, _REMEDY):
        return _calibration(run.name, table)


def lens_digest(folder: Path) -> str | None:
    """Of the lens of a run folder, whatever its unit; None where it cannot be read.

    None of a folder of runs, too: further runs in it may change the choice, and say nothing against what was made.
    """
    if not (folder / CAMERAS).is_file():
        return None
    with suppress(Swimm3rError):
        table = read_cameras(folder / CAMERAS)
        return cache_key(table.model, table.width, table.height, table.K.tolist(), table.distortion.tolist())
    return None


def _focal(table: CameraTable) -> float:
    return float(table.K[0, 0, 0]) / table.width


def _calibration(name: str, table: CameraTable) -> Calibration:
    if np.ptp(table.K, axis=0).any() or np.ptp(table.distortion, axis=0).any():
        raise ValueError(f"the cameras of {name} have several lenses")
    numbers = dict(zip(DISTORTION_PARAMETERS[table.model], table.distortion[0].tolist(), strict=True))
    p = numbers.pop("p1", 0.0), numbers.pop("p2", 0.0)
    return Calibration(
        name,
        "Swimm3R",
        (table.width, table.height),
        np.asarray(table.K[0]),
        fisheye=table.model == "OPENCV_FISHEYE",
        k=tuple(numbers.values()),
        p=p,
    )
