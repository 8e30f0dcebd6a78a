"""A stereo dive against the same dive by its left camera alone: errors of the path, and of the scale by the baseline.

    python benchmarks/stereo.py dives [OUT] [--seeds 0 1 2 3 4 5 6 7] [--resamples 6]    from images
    python benchmarks/stereo.py noise [--draws 10]                                       from exact tracks with noise

Poses are found three times: from the left images alone, from both cameras with a pose per frame, and as a rig. Errors
are those of the left camera's centers (RMSE) under the similarity that fits them best, which has a free scale for all
three; those of the rig also under rotation and shift alone, its lengths in metres by the baseline. The latter has one
number less to fit with than mono, which has no metres to be wrong in. `dives` are rendered and reconstructed with the
settings of `fast`; `noise` has the same path and points that are seen in the same places in every row, and another draw
of the noise of their pixels.

The difference of rig and mono in a dive has a standard deviation by the bootstrap: the points of each are drawn anew
with replacement, everything is adjusted to their observations, and the errors are compared. Over all rows the logarithm
of the ratio of the errors has a mean with a standard error.
"""

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras, directions, project_visible
from swimm3r.geometry import align_similarity
from swimm3r.pipeline.presets import PRESETS
from swimm3r.prepare import read_frames
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.ground_truth import GroundTruth, read_ground_truth
from swimm3r.scene.reconstruction import DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.scene.rig import Rig, RigCamera
from swimm3r.sfm.colmap import poses
from swimm3r.sfm.colmap.adjustment import bundle_adjust
from swimm3r.sfm.colmap.rig.adjustment import as_rig
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.synthetic.dive import make_dive, write_dive
from swimm3r.synthetic.settings import DiveSettings

BASELINE = 0.1  # metres
NOISE = 0.5  # px, of the exact tracks
MM = 1000.0
LEFT, RIGHT = RigCamera("left"), RigCamera("right")
HEAD = (
    *("seed", "mono", "stereo, free poses", "stereo, rig", "rig, in metres", "error of the scale", "stated"),
    "rig less mono",
)


@dataclass(frozen=True)
class Errors:
    """Errors of one dive, centers in metres."""

    mono: float
    free: float
    rig: float
    rig_metric: float
    scale: float  # relative
    scale_std: float  # relative, as stated
    difference_std: float | None = None  # of rig less mono, by resampled points


def dive_of(seed: int) -> DiveSettings:
    """A small stereo dive."""
    return DiveSettings(frames=20, width=320, height=214, seed=seed, stereo=BASELINE)


def errors_of_dive(seed: int, out: Path, resamples: int) -> Errors:
    """Render a dive, find its poses in the three ways, and compare them with the truth."""
    folder = out / f"dive-{seed}"
    write_dive(dive_of(seed), folder)
    truth = read_ground_truth(folder / "truth")
    both = read_frames(folder, folder=out / f"both-{seed}").train
    settings = PRESETS["fast"].sfm
    assert isinstance(settings, ColmapSettings)
    mono = poses.reconstruct(left_of(both), settings, out / f"mono-sfm-{seed}")
    free = poses.reconstruct(both, settings, out / f"both-sfm-{seed}")
    rig = as_rig(free, both, settings)
    found = compared(mono, free, rig, truth)
    if resamples < 2:
        return found
    rng = torch.Generator().manual_seed(seed)
    differences = []
    for _ in range(resamples):
        alone = bundle_adjust(resampled(mono, rng), lens=True)
        together = as_rig(resampled(rig, rng), both, settings)
        differences.append(similarity_error(together, truth)[0] - similarity_error(alone, truth)[0])
    return replace(found, difference_std=float(np.std(differences, ddof=1)))


def errors_of_noise(draw: int) -> Errors:
    """Adjust exact tracks of the cameras of a dive with a draw of noise."""
    dive = make_dive(dive_of(0))
    truth = GroundTruth(dive.names, dive.cameras, metric=True)
    listed = (
        Frame(name, Path(name), float(i // 2), 1.0, "train", camera=dive.settings.sides[i % 2], instant=i // 2)
        for i, name in enumerate(dive.names)
    )
    both = Frames(tuple(listed), dive.cameras.width, dive.cameras.height, True, rig=Rig((LEFT, RIGHT)))
    rec = exact(dive.cameras, both, draw)
    left = [i for i, frame in enumerate(both) if frame.camera == "left"]
    known = ColmapSettings(intrinsics="fixed", focal=float(dive.cameras.K[0, 0, 0]))
    free = bundle_adjust(rec)
    return compared(bundle_adjust(part_of(rec, left)), free, as_rig(free, both, known), truth)


def exact(cameras: Cameras, frames: Frames, draw: int) -> Reconstruction:
    """The true cameras, points 1 to 2.5 m before them, and where these are seen, with noise."""
    rng = torch.Generator().manual_seed(draw)
    fixed = torch.Generator().manual_seed(0)
    rows = torch.randint(0, len(cameras.K), (1500,), generator=fixed)
    size = torch.tensor([cameras.width, cameras.height], dtype=torch.float64)
    pixels = torch.rand(1500, 2, generator=fixed, dtype=torch.float64) * size
    z = 1.0 + 1.5 * torch.rand(1500, 1, generator=fixed, dtype=torch.float64)
    rays = directions(cameras[rows], pixels[:, None])[:, 0]
    cam2world = cameras.cam2world[rows]
    xyz = torch.einsum("nij,nj->ni", cam2world[:, :3, :3], z * rays) + cam2world[:, :3, 3]
    xy, _, seen = project_visible(cameras, xyz.expand(len(cameras.K), -1, -1))
    frame, point = torch.nonzero(seen).unbind(-1)
    noisy = xy[frame, point] + NOISE * torch.randn(len(frame), 2, generator=rng, dtype=torch.float64)
    none, nowhere = torch.zeros(0, dtype=torch.int64), torch.zeros(0, 2)
    whole = Reconstruction(
        names=frames.names,
        cameras=cameras,
        points=Points(xyz, torch.full((1500, 3), 0.5), torch.zeros(1500, dtype=torch.float64)),
        tracks=Tracks(point, frame, noisy),
        matches=Matches(none, none, nowhere, nowhere, torch.zeros(0)),
        depth=DepthMaps(Path("z_depth")),
        backend="colmap",
    )
    return part_of(whole, range(len(frames)))


def part_of(rec: Reconstruction, rows: Sequence[int]) -> Reconstruction:
    """Some frames of a reconstruction, and the points that three of them see."""
    place = torch.full((len(rec.names),), -1)
    place[list(rows)] = torch.arange(len(rows))
    frame, point, xy = place[rec.tracks.frame], rec.tracks.point, rec.tracks.xy
    often = torch.bincount(point[frame >= 0], minlength=len(rec.points.xyz)) >= 3
    used = (frame >= 0) & often[point]
    kept, point = torch.unique(point[used], return_inverse=True)
    points = Points(rec.points.xyz[kept], rec.points.rgb[kept], rec.points.error[kept])
    names = tuple(rec.names[row] for row in rows)
    tracks = Tracks(point, frame[used], xy[used])
    return replace(rec, names=names, cameras=rec.cameras[list(rows)], points=points, tracks=tracks)


def resampled(rec: Reconstruction, rng: torch.Generator) -> Reconstruction:
    """As many points with their observations, drawn with replacement."""
    count = len(rec.points.xyz)
    drawn = torch.randint(0, count, (count,), generator=rng)
    seen = torch.bincount(rec.tracks.point, minlength=count)
    by_point = torch.split(torch.argsort(rec.tracks.point, stable=True), seen.tolist())
    rows = torch.cat([by_point[point] for point in drawn.tolist()])
    points = Points(rec.points.xyz[drawn], rec.points.rgb[drawn], rec.points.error[drawn])
    tracks = Tracks(torch.repeat_interleave(seen[drawn]), rec.tracks.frame[rows], rec.tracks.xy[rows])
    return replace(rec, points=points, tracks=tracks)


def compared(mono: Reconstruction, free: Reconstruction, rig: Reconstruction, truth: GroundTruth) -> Errors:
    """Errors of three reconstructions of one dive."""
    if rig.rig is None or not rig.rig.rigid:
        raise SystemExit("the rig of a dive is not rigid")
    camera = rig.rig.cameras[1]
    metres = BASELINE / camera.baseline
    away, true = similarity_error(rig, truth)
    return Errors(
        similarity_error(mono, truth)[0],
        similarity_error(free, truth)[0],
        away,
        metric_error(rig, truth, metres),
        abs(metres / true - 1),
        camera.baseline_std,
    )


def left_of(both: Frames) -> Frames:
    """The frames of the left camera, as those of no rig."""
    left = replace(both, frames=tuple(frame for frame in both if frame.camera == "left"), rig=None)
    return replace(left, frames=tuple(replace(frame, camera=None, instant=None) for frame in left))


def centers_of(rec: Reconstruction, truth: GroundTruth) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Centers of the left camera, found and true."""
    rows = [row for row, name in enumerate(rec.names) if name.startswith("left/")]
    true = [truth.names.index(rec.names[row]) for row in rows]
    return rec.cameras.centers[rows].double(), truth.cameras.centers[true].double()


def similarity_error(rec: Reconstruction, truth: GroundTruth) -> tuple[float, float]:
    """RMSE of the centers under the similarity that fits them best, in metres, and its scale."""
    found, true = centers_of(rec, truth)
    onto = align_similarity(found, true)
    return rms(onto.points(found) - true), float(onto.scale)


def metric_error(rec: Reconstruction, truth: GroundTruth, metres: float) -> float:
    """RMSE of the centers under rotation and shift, with a unit of so many metres."""
    found, true = centers_of(rec, truth)
    found = metres * found
    turned = found @ align_similarity(found, true).R.mT  # of all similarities, the turn is that of the best motion
    return rms(turned - turned.mean(0) - (true - true.mean(0)))


def rms(away: Float[Tensor, "n 3"]) -> float:
    return math.sqrt(float((away**2).sum(1).mean()))


def row_of(name: str, errors: Errors) -> str:
    """A row of the table."""
    lengths = (errors.mono, errors.free, errors.rig, errors.rig_metric)
    shares = f"{100 * errors.scale:.2f} % | ± {100 * errors.scale_std:.2f} %"
    std = errors.difference_std
    difference = f"{MM * (errors.rig - errors.mono):+.2f}" + ("" if std is None else f" ± {MM * std:.2f}")
    return f"| {name} | " + " | ".join(f"{MM * length:.2f}" for length in lengths) + f" | {shares} | {difference} |"


def verdict(found: Sequence[Errors]) -> str:
    """Number of dives in which the rig is nearer to the truth, and the factor from the errors of mono to its own."""
    nearer = sum(one.rig <= one.mono for one in found)
    told = f"The rig is nearer to the truth than mono in {nearer} of {len(found)}."
    if all(one.difference_std is not None for one in found):
        clear = [one for one in found if abs(one.rig - one.mono) > 2 * (one.difference_std or 0.0)]
        worse = sum(one.rig > one.mono for one in clear)
        told += f" By more than two standard deviations it is nearer in {len(clear) - worse}, farther in {worse}."
    if len(found) > 1:
        logs = np.log([one.rig / one.mono for one in found])
        error = float(logs.std(ddof=1)) / math.sqrt(len(logs))
        told += (
            f" Error of the rig by that of mono: {math.exp(logs.mean()):.2f}, logarithm {logs.mean():.2f} ± {error:.2f}"
            f" (t = {logs.mean() / error:.1f} with {len(logs) - 1} degrees of freedom)."
        )
    return told


def main() -> None:
    """The table that the command names, a row per dive or draw, and the root mean squares over all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=("dives", "noise"))
    parser.add_argument("out", nargs="?", type=Path, default=Path("runs/stereo"))
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(8)))
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--resamples", type=int, default=6, help="of each dive's points; 0 leaves out their scatter")
    given = parser.parse_args()
    print(f"| {' | '.join(HEAD)} |\n|{' --- |' * len(HEAD)}")
    found = []
    for seed in given.seeds if given.table == "dives" else range(given.draws):
        dive = given.table == "dives"
        found.append(errors_of_dive(seed, given.out, given.resamples) if dive else errors_of_noise(seed))
        print(row_of(str(seed), found[-1]), flush=True)
    columns = np.array([(one.mono, one.free, one.rig, one.rig_metric, one.scale, one.scale_std) for one in found])
    print(row_of("root mean square", Errors(*np.sqrt((columns**2).mean(0)))))
    print(verdict(found))


if __name__ == "__main__":
    main()
