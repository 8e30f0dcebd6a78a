"""Cost and accuracy as a dive grows: synthetic surveys of one kind and several lengths, each run in its own process.

A survey is a lawnmower path over a plain, a line back across it included, a frame every 10 cm; so 100 frames are 10 m.
Processor seconds are per frame and part of the work, memory is the process's peak, errors are those against the truth.
"""

import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import get_args

import torch

from swimm3r.bench.cells import ResultKey, Scores, kept_cell
from swimm3r.bench.memory import in_own_process, with_peak_mb
from swimm3r.bench.scores import columns
from swimm3r.bench.settings import SurveySettings
from swimm3r.bench.tables import Table
from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.poses import absolute_pose_errors
from swimm3r.pipeline.inputs import truth_of
from swimm3r.pipeline.presets import RunSettings
from swimm3r.pipeline.run import run_pipeline
from swimm3r.pipeline.stage_start import StageStart
from swimm3r.prepare import read_frames
from swimm3r.progress import Progress, silent
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.sfm.colmap import poses
from swimm3r.sfm.plane_sweep.estimate import Step
from swimm3r.sfm.rectified.run import run_frames
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.synthetic import DiveSettings, write_dive

SPACING = 0.1  # m between frames
_SPEED, _FPS = 0.3, 3.0
_DEPTH = get_args(Step)  # steps of the plane sweep, as progress calls them

COLUMNS = columns(
    "registered_pct", "ate_pct", "rotation_deg", "psnr", "cpu_prepare", "cpu_mapping", "cpu_depth", "cpu_water",
    "cpu_map", "cpu_scores", "cpu_minutes_100m", "peak_run_mb",
)  # fmt: skip


class StepClock:
    """A `Progress` that adds up the processor seconds of each step, apart for each stage of a run."""

    def __init__(self) -> None:
        self.stages: list[dict[str, float]] = [{}]
        self._since = time.process_time()

    def __call__(self, what: str, done: int, total: int, /) -> None:
        now = time.process_time()
        steps = self.stages[-1]
        steps[what] = steps.get(what, 0.0) + now - self._since
        self._since = now

    @property
    def total(self) -> float:
        """Processor seconds of all steps."""
        return sum(sum(steps.values()) for steps in self.stages)

    def next_stage(self, start: StageStart, /) -> None:
        """Count what follows for another stage (`run_pipeline`'s `on_stage`)."""
        self.stages.append({})


def survey(frames: int, scale: SurveySettings) -> DiveSettings:
    """The survey of so many frames."""
    length = round(SPACING * (frames - 0.9), 3)  # just beyond the last frame
    return DiveSettings(
        path="lawnmower",
        length=length,
        speed=_SPEED,
        fps=_FPS,
        width=scale.width,
        height=scale.height,
        seed=scale.seed,
    )


def scale_table(out: Path, scale: SurveySettings, settings: RunSettings, progress: Progress = silent) -> Table:
    """A row for every number of frames; surveys and runs stay in OUT, and a repeated call goes on with them."""
    cells = []
    for done, frames in enumerate(scale.counts):
        progress("surveys", done, len(scale.counts))
        dive = survey(frames, scale)
        folder = out / "dives" / f"{frames}"
        write_dive(dive, folder, progress)
        key = ResultKey("survey", f"{frames} frames")
        make = partial(_measured, dive=folder, last=scale.last, settings=settings)
        cells.append(kept_cell(out, key, [dive, scale.last, settings], make))
    progress("surveys", len(scale.counts), len(scale.counts))
    return Table("scale", "Cost and accuracy by the length of a survey", cells, COLUMNS)


def _measured(folder: Path, *, dive: Path, last: str, settings: RunSettings) -> Scores:
    return in_own_process(_scores, folder, dive, last, settings)


def _scores(folder: Path, dive: Path, last: str, settings: RunSettings) -> dict[str, float | NotComputed]:
    """The scores of one survey, run up to a stage."""
    clock = StepClock()
    truth = truth_of(dive, None)
    assert truth is not None
    if last == "mapping":
        assert isinstance(settings.sfm, ColmapSettings)
        frames = read_frames(dive, settings.frames, folder / "run" / "prepare", clock)
        prepared = clock.total
        rec, peaks = with_peak_mb(partial(poses.reconstruct, frames.train, settings.sfm, folder / "run" / "sfm", clock))
        steps = {"cpu_prepare": prepared, "cpu_mapping": clock.total - prepared}
        peak, psnr = peaks["peak_mb"], NotComputed("mapping alone was asked for")
    else:
        summary = run_pipeline(
            dive, folder / "run", settings, last_stage=last, progress=clock, on_stage=clock.next_stage
        )
        frames, rec = run_frames(folder / "run"), load_reconstruction(folder / "run" / "sfm")
        steps = by_part(clock.stages, summary["stages"])
        peak = max(stage["peak_mb"] for stage in summary["stages"].values())
        psnr = summary["test"]["psnr"] if "test" in summary else NotComputed("no map was asked for")
    used = len(frames.train) + len(frames.test) + len(frames.between)
    per_frame = {name: seconds / used for name, seconds in steps.items()}
    meters = path_length(truth)
    return {
        "registered_pct": 100 * len(rec.names) / len(frames.train),
        **pose_errors(rec, truth, meters),
        "psnr": psnr,
        **per_frame,
        "cpu_minutes_100m": sum(steps.values()) / 60 * 100 / meters,
        "peak_run_mb": peak,
    }


def by_part(steps_of: Sequence[dict[str, float]], stages: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Processor seconds of the parts of a run; structure from motion is told apart by its steps."""
    steps = next((steps for steps in steps_of if _DEPTH[0] in steps), {})
    before = list(steps).index(_DEPTH[0]) if steps else 0
    water = sum(seconds for name, seconds in list(steps.items())[before:] if name not in _DEPTH)
    depth = sum(steps.get(name, 0.0) for name in _DEPTH)
    parts = {"cpu_prepare": stages["prepare"]["cpu_seconds"]}
    parts |= {"cpu_mapping": stages["sfm"]["cpu_seconds"] - depth - water, "cpu_depth": depth, "cpu_water": water}
    for stage, name in (("splat", "cpu_map"), ("eval", "cpu_scores")):
        if stage in stages:
            parts[name] = stages[stage]["cpu_seconds"]
    return parts


def pose_errors(rec: Reconstruction, truth: GroundTruth, meters: float) -> dict[str, float | NotComputed]:
    """ATE in percent of the path's length, and mean rotation error, after alignment of the registered frames."""
    place = {name: i for i, name in enumerate(truth.names)}
    reference = truth.cameras.cam2world.double()[[place[name] for name in rec.names]]
    found = absolute_pose_errors(rec.cameras.cam2world.double(), reference)
    ate = found.ate if isinstance(found.ate, NotComputed) else 100 * found.ate / meters
    return {"ate_pct": ate, "rotation_deg": found.rotation_deg}


def path_length(truth: GroundTruth) -> float:
    """Length of the camera's path, m."""
    return float(torch.linalg.norm(truth.cameras.centers.diff(dim=0), dim=1).sum())
