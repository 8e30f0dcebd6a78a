"""Keypoints as SIFT finds them, and where patches of the images agree (`mapping.align_keypoints`).

    python benchmarks/aligned_keypoints.py RUN[:TRUTH] ...

RUN are run folders whose structure from motion is finished. Their frames are placed twice, as found -> aligned:

    points         number of sparse points
    reprojection   median error of the observations in pixels
    focal          focal length in pixels

and, beside a TRUTH (the demo's is found):

    observations   median distance in pixels of an observation from the true pixel of its point, which is the true
                   surface where the point's nearest camera has it
    rotation       mean error of the cameras in degrees
    position       mean error of the cameras in thousandths of the truth's unit
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from dive_runs import dive_run, to_truth

from swimm3r.cameras import rows_of_frames, unproject
from swimm3r.geometry import rotation_angle
from swimm3r.pipeline.finished_sfm import FinishedSfm
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap import poses
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.sfm.tracks import reprojection_errors


def placed(sfm: FinishedSfm, *, align: bool) -> FinishedSfm:
    """A run with its frames placed anew, without depth."""
    settings = sfm.settings.sfm
    if not isinstance(settings, ColmapSettings):
        raise SystemExit(f"{sfm.folder.name} has no structure from motion by COLMAP")
    settings = replace(settings, mapping=replace(settings.mapping, align_keypoints=align))
    frames = sfm.frames.select([sfm.frames.index(name) for name in sfm.rec.names])
    with tempfile.TemporaryDirectory() as folder:
        return replace(sfm, rec=poses.reconstruct(frames, settings, Path(folder)))


def off_truth(rec: Reconstruction, truth: GroundTruth) -> float:
    """Median distance of the observations from the true pixels of their points."""
    tracks, cameras = rec.tracks, truth.cameras[[truth.names.index(name) for name in rec.names]]
    away = torch.linalg.vector_norm(rec.cameras.centers[tracks.frame] - rec.points.xyz[tracks.point], dim=1)
    order = torch.from_numpy(np.lexsort((away.numpy(), tracks.point.numpy())))
    nearest = order[torch.searchsorted(tracks.point[order], torch.arange(len(rec.points.xyz)))]
    surface = torch.zeros(len(nearest), 3, dtype=torch.float64)
    for i, rows in enumerate(rows_of_frames(tracks.frame[nearest], len(rec.names))):
        xy, z = tracks.xy[nearest[rows]].double(), truth.z_depth(rec.names[i])
        if z is None:
            raise SystemExit(f"the truth has no depth of {rec.names[i]}")
        x, y = (xy - 0.5).float().numpy().T
        there = cv2.remap(z.numpy(), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel()
        surface[rows] = unproject(cameras[i], xy[None], torch.from_numpy(there).double()[None])[0]
    others = torch.ones(len(tracks.point), dtype=torch.bool)
    others[nearest] = False
    return float(reprojection_errors(cameras, tracks.frame, tracks.xy, surface[tracks.point])[others].median())


def off_path(sfm: FinishedSfm, truth: GroundTruth) -> tuple[float, float]:
    """Mean errors of the cameras: degrees, and thousandths of the truth's unit."""
    there = truth.cameras.cam2world[[truth.names.index(name) for name in sfm.rec.names]].double()
    moved = to_truth(sfm).poses(sfm.rec.cameras.cam2world.double())
    turned = torch.rad2deg(rotation_angle(there[:, :3, :3].mT @ moved[:, :3, :3]))
    return float(turned.mean()), 1e3 * float(torch.linalg.vector_norm(moved - there, dim=1)[:, 3].mean())


def cells(sfm: FinishedSfm) -> list[str]:
    """The row's cells for one of the two."""
    rec, tracks = sfm.rec, sfm.rec.tracks
    off = reprojection_errors(rec.cameras, tracks.frame, tracks.xy, rec.points.xyz[tracks.point]).median()
    found = [f"{len(rec.points.xyz)}", f"{float(off):.3f}", f"{rec.cameras.K[0, 0, 0].item():.2f}"]
    if sfm.truth is None:
        return [*found, "-", "-", "-"]
    rotation, position = off_path(sfm, sfm.truth)
    return [*found, f"{off_truth(rec, sfm.truth):.3f}", f"{rotation:.4f}", f"{position:.2f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=dive_run, metavar="RUN[:TRUTH]")
    options = parser.parse_args()
    print("| run | points | reprojection | focal | observations | rotation | position |\n|" + " --- |" * 7)
    for sfm in options.runs:
        both = [cells(placed(sfm, align=align)) for align in (False, True)]
        row = [a if a == b else f"{a} -> {b}" for a, b in zip(*both, strict=True)]
        print(f"| {sfm.folder.name} | {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
