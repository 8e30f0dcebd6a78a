"""Poses and lens of dives filmed by cameras that squeeze their films and expose rows one after another.

    python benchmarks/cameras.py [OUT]

Every dive is a synthetic loop (or transect) whose poses are known. Errors of the training frames' poses are the mean
and the largest angle after the rotation that fits all orientations best, and the ATE after the similarity that fits the
centers, as a share of the path. `global` takes all rows as exposed at once, `auto` rectifies them where the tracks show
that the camera turned, `rolling` estimates the readout time, `stated` is told it. Features and matches of frames as
filmed are those of the first of them.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from swimm3r.evaluate.poses import absolute_pose_errors
from swimm3r.geometry import mean_rotation, rotation_angle
from swimm3r.prepare import read_frames
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap.poses import reconstruct
from swimm3r.sfm.rectified.frames import TurnedRowsError, rectify_frames
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.synthetic.dive import Dive, make_dive, write_dive
from swimm3r.synthetic.settings import DiveSettings

SQUEEZED = {"width": 480, "height": 360, "squeeze": 4 / 3}
DIVES = {
    "loop": DiveSettings(frames=60),
    "loop, 20 ms": DiveSettings(frames=60, readout=0.02),
    "loop, squeezed": DiveSettings(frames=48, **SQUEEZED),
    "loop, squeezed, 15 ms": DiveSettings(frames=48, readout=0.015, **SQUEEZED),
    "transect": DiveSettings(path="transect", length=8.0, speed=0.5),
    "transect, 20 ms": DiveSettings(path="transect", length=8.0, speed=0.5, readout=0.02),
}


def rows(name: str, settings: DiveSettings, folder: Path) -> Iterator[tuple[str, ...]]:
    """The rows of one dive."""
    write_dive(settings, folder / "dive")
    dive, frames = make_dive(settings), read_frames(folder / "dive", folder=folder / "prepare")
    timed = tuple(replace(frame, time=dive.seconds(dive.names.index(frame.name))) for frame in frames)
    train = replace(frames, frames=timed).train
    shutters = {"global": ColmapSettings(threads=1, shutter="global"), "auto": ColmapSettings(threads=1)}
    if settings.readout:
        shutters["rolling"] = replace(shutters["global"], shutter="rolling")
        shutters["stated"] = replace(shutters["rolling"], readout=settings.readout)
    for shutter, asked in shutters.items():
        yield name, shutter, *errors(placed(train, asked, folder), dive, train)


def placed(frames: Frames, settings: ColmapSettings, folder: Path) -> Reconstruction:
    """The frames, or what their rows are rectified to where they show that the camera turned, in place."""
    try:
        return reconstruct(frames, settings, folder / "sfm")
    except TurnedRowsError as error:
        straight = rectify_frames(frames, error.rectification, folder / "rows")
        return reconstruct(straight, settings, folder / "straight")


def errors(rec: Reconstruction, dive: Dive, frames: Frames) -> tuple[str, ...]:
    """Frames in place, angles, ATE, and the lens by the true one."""
    truth = dive.cameras.cam2world[[dive.names.index(name) for name in rec.names]].double()
    found = rec.cameras.cam2world.double()
    R, true = found[:, :3, :3], truth[:, :3, :3]
    angles = torch.rad2deg(rotation_angle(true.mT @ mean_rotation(true @ R.mT) @ R))
    path = np.linalg.norm(np.diff(dive.cameras.centers.numpy(), axis=0), axis=1).sum()
    ate = absolute_pose_errors(found, truth).ate
    ate = 100 * ate / float(path) if isinstance(ate, float) else ate
    ratio = rec.cameras.K[0].double() / dive.cameras.K[0]
    return (
        f"{len(rec.names)} / {len(frames)}",
        f"{angles.mean():.4f}",
        f"{angles.max():.4f}",
        f"{ate:.4f} %" if isinstance(ate, float) else str(ate),
        f"{ratio[0, 0]:.4f}, {ratio[1, 1]:.4f}",
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="?", default=Path("runs/cameras"))
    out = parser.parse_args().out
    print("| dive | shutter | frames | mean, deg | largest, deg | ATE / path | fx, fy by the true ones |")
    print("| --- " * 7 + "|")
    for k, (name, settings) in enumerate(DIVES.items()):
        for row in rows(name, settings, out / f"{k}"):
            print("|", " | ".join(row), "|", flush=True)


if __name__ == "__main__":
    main()
