"""A metric survey from images to maps: scale by printed markers and by noisy navigation, and the maps it gives.

    python benchmarks/maps/survey.py FOLDER [--draws 16]

FOLDER/dive becomes a synthetic dive of 50 m of parallel lines over 5.4 x 5.8 m, one frame a second, with 8 markers of
0.25 m, FOLDER/run its run (`swimm3r sfm FOLDER/dive --preset fast`); what is finished is not made again. Navigation is
drawn several times: positions and attitude of the vehicle every 0.5 s, by a clock that is 0.3 s ahead, with errors of
0.1 m and 1 degree. Scales are compared with that of the similarity from the camera centers to the true ones. The run
then gets the scale of the markers and of the first draw, is laid over the truth by a motion of its camera centers, and
its maps are compared with the true view from above.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from products import compare, placed
from swimm3r import PRESETS, run_pipeline, write_dive
from swimm3r.geometry import align_similarity
from swimm3r.products.survey import open_survey
from swimm3r.scale.estimate import estimate_scale
from swimm3r.scale.navigation.fit import angles_of
from swimm3r.scale.run import scale_run
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scale.solve import ScaleEstimate, ScaleSolution, solve_scale
from swimm3r.scene.ground_truth import read_ground_truth
from swimm3r.synthetic import DiveSettings, make_dive
from swimm3r.synthetic.path import PITCH, survey
from swimm3r.synthetic.printed_markers import FAMILY

DIVE = DiveSettings(
    path="lawnmower", length=50, speed=0.3, fps=1, width=480, height=270, seed=3,
    printed_markers=8, printed_marker_size=0.25,
)  # fmt: skip
STEP, OFFSET = 0.5, 0.3  # seconds between positions, and by which the vehicle's clock is ahead
RESOLUTION = 0.01  # metres, least distance of the heights that rugosity is computed from
POSITION, ANGLE = 0.1, 1.0  # standard deviations, metres and degrees
SLOPE = np.array([[0, 1, 0], [-np.sin(PITCH), 0, np.cos(PITCH)], [np.cos(PITCH), 0, np.sin(PITCH)]])
"""Right, down and ahead of the image in the axes of the vehicle, which is level: forward, starboard and down."""


@dataclass(frozen=True)
class Draw:
    """Scales by one draw of the navigation's errors."""

    navigation: ScaleEstimate
    both: ScaleSolution


@dataclass(frozen=True)
class Bar:
    """A figure beside the one that it may not exceed, or fall below."""

    name: str
    found: float
    bar: float
    form: str = ".3%"
    least: bool = False

    def show(self) -> None:
        """Print the figure as a row of a table."""
        holds = self.found >= self.bar if self.least else self.found <= self.bar
        bar = f"at {'least' if self.least else 'most'} {self.bar:{self.form}}"
        print(f"| {self.name} | {self.found:{self.form}} | {bar} | {'holds' if holds else 'FAILS'} |")


def draw_navigation(path: Path, seed: int) -> Path:
    """Write a draw of the vehicle's navigation: seconds by its own clock, metres and degrees."""
    rng = np.random.default_rng(seed)
    fine = replace(DIVE, fps=20)
    poses, moments = survey(fine), np.arange(fine.frame_count) / fine.fps
    seconds = np.arange(OFFSET, moments[-1] + OFFSET, STEP)
    position = CubicSpline(moments, poses[:, :3, 3])(seconds - OFFSET)
    attitude = Slerp(moments, Rotation.from_matrix(poses[:, :3, :3] @ SLOPE))(seconds - OFFSET).as_matrix()
    angles = np.stack(angles_of(attitude), -1)
    rows = np.column_stack(
        [
            seconds,
            position + POSITION * rng.normal(size=position.shape),
            angles + ANGLE * rng.normal(size=angles.shape),
        ]
    )
    head = "time,easting,northing,height,heading [deg],pitch [deg],roll [deg]"
    np.savetxt(path, rows, "%.6f", ",", header=head, comments="")
    return path


def scales(folder: Path, markers: ScaleSettings, draws: int) -> tuple[ScaleSolution, list[Draw], float]:
    """The scale by markers, by each draw of the navigation and by both, and the true one of the run as it is."""
    run = open_survey(folder / "run")
    truth = read_ground_truth(folder / "dive" / "truth")
    reference = truth.cameras[[truth.names.index(name) for name in run.rec.names]]
    true = float(align_similarity(run.rec.cameras.centers.double(), reference.centers.double()).scale)
    by_markers = estimate_scale(run.rec, run.frames, markers).solution
    drawn = []
    for seed in range(draws):
        path = draw_navigation(folder / f"navigation_{seed}.csv", seed)
        found = estimate_scale(run.rec, run.frames, ScaleSettings(nav=path)).solution.sources[0].estimate
        both = solve_scale([*(each.estimate for each in by_markers.sources), found])
        drawn.append(Draw(found, both))
    return by_markers, drawn, true


def show_scales(by_markers: ScaleSolution, draws: list[Draw], true: float) -> list[Bar]:
    """Print the errors of the scales, and return the figures with a bar."""
    errors = np.array([[draw.navigation.scale / true - 1, draw.both.scale / true - 1] for draw in draws])
    stds = np.array([[draw.navigation.std, draw.both.std] for draw in draws])
    by_size = by_markers.scale / true - 1
    print(f"{len(by_markers.sources)} markers: {by_size:+.2%}, stated {by_markers.std:.2%}")
    print("| draw | navigation | stated | both | stated | |\n| --- | --- | --- | --- | --- | --- |")
    for k, (draw, (alone, both), (std, std_both)) in enumerate(zip(draws, errors, stds, strict=True)):
        print(f"| {k} | {alone:+.2%} | {std:.2%} | {both:+.2%} | {std_both:.2%} | {draw.navigation.detail} |")
    rms, in_std = (np.sqrt((values**2).mean(0)) for values in (errors, errors / stds))
    print(f"rms of the errors in their stated standard deviations: navigation {in_std[0]:.2f}, both {in_std[1]:.2f}")
    return [
        Bar("scale by markers", abs(by_size), 0.003),
        Bar(f"scale by navigation, rms of {len(draws)} draws", rms[0], 0.01),
        Bar("scale by navigation, worst draw", np.abs(errors[:, 0]).max(), 0.01),
        Bar(
            "scale by both, rms; the better one and a tenth of the stated deviation",
            rms[1],
            min(abs(by_size), rms[0]) + 0.1 * stds[:, 1].mean(),
        ),
    ]


def show_maps(folder: Path) -> list[Bar]:
    """Print the errors of the maps of a metric run, and return the figures with a bar."""
    metric, truth = open_survey(folder / "run"), read_ground_truth(folder / "dive" / "truth")
    maps = compare(placed(metric, truth, metric.scale), make_dive(DIVE))
    maps.show()
    found, level = next(values for spacing, values in maps.rugosity.items() if spacing >= RESOLUTION)
    return [
        Bar("orthophoto without water, dB", maps.psnr, 24, ".1f", least=True),
        Bar("shift of the orthophoto, cells", float(np.median(maps.shifts)), 1, ".2f"),
        Bar("heights, rms by the range", maps.rms() / maps.distance, 0.01),
        Bar("rugosity", abs(found / level - 1), 0.03),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--draws", type=int, default=16)
    given = parser.parse_args()
    write_dive(DIVE, given.folder / "dive")
    run_pipeline(given.folder / "dive", given.folder / "run", PRESETS["fast"], last_stage="sfm")
    markers = ScaleSettings(markers=FAMILY, marker_size=DIVE.printed_marker_size)
    bars = show_scales(*scales(given.folder, markers, given.draws))
    scale_run(given.folder / "run", replace(markers, nav=given.folder / "navigation_0.csv"))
    bars += show_maps(given.folder)
    print("| figure | found | bar | |\n| --- | --- | --- | --- |")
    for bar in bars:
        bar.show()


if __name__ == "__main__":
    main()
