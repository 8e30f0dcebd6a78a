"""Localization of a stream beside localization of single images: speed, errors, and how often a pose is found.

    python benchmarks/online_localization.py RUN [--frames 60] [--width 642] [--visit 1] [--stills 10]

RUN is a finished run of a synthetic dive (swimm3r demo). Its seafloor is filmed again along another path (`--visit`),
5 images per second, and every image is placed in the run's map: by the tracker, as `localize --stream` does, and the
first few one by one, as `localize` does. Queries per second are of processor time, by both cores' sum, and of the clock
of this computer, which others may use at the same time; the map is loaded before. Errors are those of the camera's
center, in shares of the map's median distance, and of its direction: medians and largest, in the axes of the run's
cameras by their truth. NEES is the mean squared error in units of the stated covariance: 6 where nothing else errs.
The last row is the tracker on images of another seafloor, where every pose is a false one.
"""

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter, process_time

import torch
from torch import Tensor

from swimm3r.errors import RegistrationError
from swimm3r.geometry import align_poses, rotation_angle, so3_log
from swimm3r.localization.localizer import Localizer
from swimm3r.localization.online.landmark_file import landmarks_of_run
from swimm3r.localization.online.landmark_map import LandmarkMap
from swimm3r.localization.online.tracker import Tracker
from swimm3r.localization.settings import LocalizationSettings
from swimm3r.pipeline.presets import from_yaml
from swimm3r.scene.ground_truth import FOLDER, read_ground_truth
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.settings_document import from_document
from swimm3r.sfm.rectified.run import run_frames
from swimm3r.splat.map_file import load_map
from swimm3r.synthetic import make_dive
from swimm3r.synthetic.dive import Dive
from swimm3r.synthetic.settings import DiveSettings

Asked = tuple[Tensor, Tensor, float]  # an image, its true pose in the axes of the run, its time
Found = tuple[Tensor, Tensor | None] | None  # a pose and its covariance
_FPS = 5
_HEADS = ("method", "images", "per second of processor", "per second of clock", "lost")
_HEADS += ("center", "largest", "direction, deg", "largest", "NEES")


@dataclass
class Scores:
    """Speed and errors of the images so far."""

    asked: int = 0
    clock: float = 0.0
    processor: float = 0.0
    shifts: list[float] = field(default_factory=list)  # shares of the map's median distance
    turns: list[float] = field(default_factory=list)  # degrees
    nees: list[float] = field(default_factory=list)

    def row(self) -> str:
        """The columns of the table."""
        errors = " | ".join(
            f"{median(each):{form}} | {max(each, default=math.nan):{form}}"
            for each, form in ((self.shifts, ".3%"), (self.turns, ".3f"))
        )
        nees = f"{sum(self.nees) / len(self.nees):.1f}" if self.nees else ""
        speed = f"{self.asked / self.processor:.2f} | {self.asked / self.clock:.2f}"
        return f"{self.asked} | {speed} | {1 - len(self.shifts) / self.asked:.0%} | {errors} | {nees}"


def median(values: list[float]) -> float:
    """NaN of none."""
    return float(torch.tensor(values).median()) if values else math.nan


def scores(queries: list[Asked], answer: Callable[[Tensor, float], Found], distance: float) -> Scores:
    """Speed and errors of a way to place images."""
    found = Scores()
    for image, truth, time in queries:
        clock, processor = perf_counter(), process_time()
        got = answer(image, time)
        found.clock += perf_counter() - clock
        found.processor += process_time() - processor
        found.asked += 1
        if got is None:
            continue
        pose, covariance = got
        off, turn = pose[:3, 3] - truth[:3, 3], so3_log(pose[:3, :3] @ truth[:3, :3].mT)
        found.shifts.append(float(off.norm()) / distance)
        found.turns.append(math.degrees(float(rotation_angle(truth[:3, :3].mT @ pose[:3, :3]))))
        if covariance is not None:
            error = torch.cat([off, turn])
            found.nees.append(float(error @ torch.linalg.solve(covariance, error)))
    return found


def queries_of(run: Path, dive: Dive) -> list[Asked]:
    """The images of a dive, and their true poses in the axes of the run."""
    rec = load_reconstruction(run / "sfm")
    truth = read_ground_truth(source_of(run) / FOLDER)
    known = truth.cameras.cam2world[[truth.names.index(name) for name in rec.names]]
    to_run = align_poses(known.double(), rec.cameras.cam2world.double())
    poses = to_run.poses(dive.cameras.cam2world.double())
    return [(dive.frame(i).raw.clamp(0, 1), poses[i], i / _FPS) for i in range(len(dive))]


def source_of(run: Path) -> Path:
    """The folder of the dive."""
    return Path(json.loads((run / "summary.json").read_text())["input"]["path"])


def dive_again(run: Path, visit: int, frames: int, width: int, *, elsewhere: bool = False) -> Dive:
    """The run's seafloor, or another one, filmed along another path at another size."""
    document = json.loads((source_of(run) / FOLDER / "dive.json").read_text())
    del document["whole"]  # whether the dive was written to its end
    s = from_document(document, DiveSettings)
    height = width * s.height // s.width
    if height * s.width != width * s.height:
        raise SystemExit(
            f"--width {width} is no multiple of {s.width // math.gcd(s.width, s.height)}: pixels not square"
        )
    changes = {"visit": visit, "frames": frames, "width": width, "height": height, "seed": s.seed + elsewhere}
    return make_dive(replace(s, **changes))


def tracked(landmarks: LandmarkMap) -> Callable[[Tensor, float], Found]:
    """Placing by the tracker."""
    tracker = Tracker(landmarks)

    def answer(image: Tensor, time: float) -> Found:
        found = tracker.locate(tracker.describe(image), time)
        return None if found.cam2world is None else (found.cam2world, found.covariance)

    return answer


def one_by_one(run: Path) -> Callable[[Tensor, float], Found]:
    """Placing by the protocol of single images."""
    frames = run_frames(run)
    rec = load_reconstruction(run / "sfm", frames)
    localizer = Localizer(
        load_map(run / "splat" / "map.safetensors"), rec, frames, LocalizationSettings(matcher="sift")
    )

    def answer(image: Tensor, time: float) -> Found:
        try:
            return localizer.in_axes_of_sfm(localizer.locate(image).cam2world), None
        except RegistrationError:
            return None

    return answer


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--width", type=int, default=642)
    parser.add_argument("--visit", type=int, default=1)
    parser.add_argument("--stills", type=int, default=10, help="number of images placed one by one; 0: none")
    parser.add_argument("--elsewhere", type=int, default=20, help="number of images of another seafloor")
    a = parser.parse_args()
    landmarks = landmarks_of_run(a.run, from_yaml(a.run / "settings.yaml").sfm.features)
    queries = queries_of(a.run, dive_again(a.run, a.visit, a.frames, a.width))
    tracked(landmarks)(queries[0][0], 0.0)  # compiles
    print(f"| {' | '.join(_HEADS)} |\n|{'---|' * len(_HEADS)}")
    print(f"| stream | {scores(queries, tracked(landmarks), landmarks.distance).row()} |", flush=True)
    if a.stills:
        some = queries[:: max(1, len(queries) // a.stills)][: a.stills]
        still = one_by_one(a.run)
        still(queries[0][0], 0.0)
        print(f"| one by one | {scores(some, still, landmarks.distance).row()} |", flush=True)
    other = queries_of(a.run, dive_again(a.run, a.visit, a.elsewhere, a.width, elsewhere=True))
    print(f"| stream, another seafloor | {scores(other, tracked(landmarks), landmarks.distance).row()} |")


if __name__ == "__main__":
    main()
