"""TUM trajectories: a line `timestamp tx ty tz qx qy qz qw` per pose, camera to world, which evo and others read."""

from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from swimm3r.geometry import quaternion_from_rotation
from swimm3r.io.files.atomic import write_text


def write_tum(path: Path, times: Sequence[float] | Sequence[Decimal], cam2world: Float[np.ndarray, "c 4 4"]) -> None:
    """Write poses in the order of their times, seconds; stamps of a nanosecond take a Decimal."""
    order = np.argsort(np.asarray(times), kind="stable").tolist()
    write_text(path, "".join(tum_line(times[i], cam2world[i]) + "\n" for i in order))


def tum_line(time: float | Decimal, cam2world: Float[np.ndarray, "4 4"]) -> str:
    """One line of a trajectory."""
    w, x, y, z = quaternion_from_rotation(torch.from_numpy(cam2world[:3, :3]).double()).tolist()
    return " ".join(f"{value:.9f}" for value in (time, *cam2world[:3, 3].tolist(), x, y, z, w))
