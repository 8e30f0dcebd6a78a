"""Do disturbed poses recover while the map is trained, and do right ones stay?

    python benchmarks/pose_recovery.py RUN... [--degrees 0 2] [--share 0.02] [--iterations 1500] [--long-side 320]

RUN is a finished run of a synthetic dive (swimm3r demo --keep, or swimm3r run on one). Its cameras are turned about
random axes and moved by a share of the cameras' spread; depth, points and matches stay. Printed are the mean rotation
error and the ATE over the spread of the training cameras against the truth, before and after, and the test frames'
PSNR with poses refined and with poses held.
"""

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import torch

from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.poses import absolute_pose_errors
from swimm3r.geometry import pose_from, so3_exp
from swimm3r.pipeline.presets import PRESETS
from swimm3r.pipeline.scores import held_out
from swimm3r.scene.ground_truth import FOLDER, GroundTruth, read_ground_truth
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.sfm.rectified.run import run_frames
from swimm3r.splat import train
from swimm3r.splat.settings import PoseRefinementSettings, TrainingPoseSettings, UwbsSettings
from swimm3r.splat.training_poses import as_mapped, spread_of


def disturbed(rec: Reconstruction, degrees: float, share: float) -> Reconstruction:
    """The reconstruction with every camera turned by `degrees` and moved by `share` of the cameras' spread."""
    rng = torch.Generator().manual_seed(0)
    poses, n = rec.cameras.cam2world, len(rec.names)
    axis, way = torch.nn.functional.normalize(torch.randn(2, n, 3, generator=rng, dtype=torch.float64), dim=-1)
    R = poses[:, :3, :3] @ so3_exp(axis * torch.deg2rad(torch.tensor(degrees)))
    centers = poses[:, :3, 3] + share * spread_of(poses) * way
    return replace(rec, cameras=replace(rec.cameras, cam2world=pose_from(R, centers)))


def errors(names: tuple[str, ...], cam2world: torch.Tensor, truth: GroundTruth) -> str:
    """Mean rotation error, degrees, and ATE over the spread."""
    true = truth.cameras.cam2world[[truth.names.index(name) for name in names]]
    found = absolute_pose_errors(cam2world, true)
    assert not isinstance(found.ate, NotComputed)
    return f"{found.rotation_deg:.3f} | {100 * float(found.ate) / spread_of(true):.2f} %"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--degrees", nargs="+", type=float, default=[0.0, 2.0])
    parser.add_argument("--share", type=float, default=0.02)
    parser.add_argument("--iterations", type=int, default=PRESETS["fast"].splat.iterations)
    parser.add_argument("--long-side", type=int, default=320)
    parser.add_argument("--primitives", type=int, default=12_000)
    parser.add_argument("--rates", nargs="+", type=float, default=[TrainingPoseSettings().rate])
    a = parser.parse_args()
    base = PRESETS["fast"].splat
    assert isinstance(base, UwbsSettings)
    base = replace(
        base, iterations=a.iterations, long_side=a.long_side,
        initial=replace(base.initial, primitives=a.primitives),
        densify=replace(base.densify, cap_max=2 * a.primitives),
    )  # fmt: skip
    print("| run | disturbed by | poses | rotation before, deg | ATE | rotation after | ATE | test PSNR |")
    print("|---|---|---|---|---|---|---|---|")
    for run in a.runs:
        source = json.loads((run / "summary.json").read_text())["input"]["path"]
        truth = read_ground_truth(Path(source) / FOLDER)
        rec, frames = load_reconstruction(run / "sfm"), run_frames(run)
        for degrees in a.degrees:
            bent = disturbed(rec, degrees, a.share if degrees else 0.0)
            for rate in [0.0, *a.rates]:
                poses = replace(base.poses, enabled=rate > 0, rate=rate)
                row = measure(bent, frames, truth, replace(base, poses=poses))
                what = f"{degrees:g} deg, {a.share if degrees else 0:.0%}"
                print(f"| {run.name} | {what} | {f'rate {rate:g}' if rate else 'held'} | {row} |", flush=True)


def measure(rec: Reconstruction, frames: held_out.Frames, truth: GroundTruth, settings: UwbsSettings) -> str:
    """One training, as the table's last columns."""
    with tempfile.TemporaryDirectory() as folder:
        scene = train(rec, frames, settings, Path(folder))
        # the test frames' poses are the truth's, brought into the map's axes by its own cameras
        ours = as_mapped(rec, scene.poses)
        known = held_out.reference_poses(ours, truth)
        starts = {frame.name: held_out.FirstPose(known[frame.name], "reference") for frame in frames.test}
        test = PoseRefinementSettings(steps=100, long_side=160)
        views = held_out.score_views(scene, rec, frames, starts, Path(folder) / "test", test)
    before = errors(rec.names, rec.cameras.cam2world, truth)
    after = errors(rec.names, ours.cameras.cam2world, truth)
    return f"{before} | {after} | {held_out.mean_scores(views)['psnr']:.2f}"


if __name__ == "__main__":
    main()
