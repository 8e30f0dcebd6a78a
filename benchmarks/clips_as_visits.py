"""Parts of one real clip as visits of one site: nothing has changed between them but what was moved during the dive.

    python benchmarks/clips_as_visits.py DATA OUT [--clips NAME ...]

DATA holds the clips in folders of their names, OUT receives for each its parts, reduced, their runs (`swimm3r sfm PART
--out RUN --preset fast`, with the lens of the clip fixed where one is stated below) and the comparison (`swimm3r visits
RUN_1 RUN_2 --out OUT/NAME/visits`). Finished runs are not made again. Halves are halves of the time; of clips on which
they would share no ground, every second frame is one visit and the others are the other.

A row says how many frames each visit has, how many of its matches joint mapping took for one point and to how many
pixels, the ground reported as changed in height and in color, in percent of the ground that both visits saw, and the
change that a typical cell would have to show: heights in percent of the median distance to the camera.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from swimm3r import PRESETS, ColmapSettings, RunSettings, run_pipeline
from swimm3r.io import images
from swimm3r.io.image_folder import natural_key
from swimm3r.io.video import Video
from swimm3r.prepare.candidates import scaled_down
from swimm3r.products.survey import open_survey
from swimm3r.visits import write_visits
from swimm3r.visits.record import VisitsRecord

Split = Callable[[Sequence[Path]], tuple[Sequence[Path], Sequence[Path]]]
VIDEO_STEP = 6  # frames of a video of which one is taken
HEAD = ("clip", "visits", "frames", "shared points", "height changed, %", "color changed, %", "least height, %",
        "least color")  # fmt: skip


@dataclass(frozen=True)
class Clip:
    """A clip and its two visits."""

    name: str
    folders: tuple[str, ...]  # of images, or a video, in DATA
    split: Split
    visits: str  # in words
    long_side: int  # pixels of the frames
    lens: tuple[float, float] | None = None  # focal length in pixels of these frames, and k1; None to find them


def halves(files: Sequence[Path]) -> tuple[Sequence[Path], Sequence[Path]]:
    """Before and after the middle."""
    middle = len(files) // 2
    return files[:middle], files[middle:]


def alternating(files: Sequence[Path]) -> tuple[Sequence[Path], Sequence[Path]]:
    """Every second frame, and the others."""
    return files[::2], files[1::2]


def between(first: tuple[str, str], second: tuple[str, str]) -> Split:
    """Frames of two ranges of names, both ends included."""

    def split(files: Sequence[Path]) -> tuple[Sequence[Path], Sequence[Path]]:
        one, other = ([file for file in files if low <= file.stem <= high] for low, high in (first, second))
        return one, other

    return split


RUIE = (300.0, 0.08)  # the lens of all of these clips, by which each of them is complete
CLIPS = (
    Clip("gopro_transect", ("gopro_transect/transect.mp4",), alternating, "every second frame, the others", 640),
    Clip("rov_vent_a", ("rov_vent_a/images",), alternating, "every second frame, the others", 480, (532.0, 0.137)),
    Clip("ruie_cyan_slope", ("ruie_cyan_slope/images",), halves, "first half, second half", 400, RUIE),
    Clip("ruie_murky", ("ruie_murky/images",), alternating, "every second frame, the others", 400, RUIE),
    Clip("ruie_shallow_a", ("ruie_shallow_a/images",), halves, "first half, second half", 400, RUIE),
    Clip("ruie_cyan_gripper_b", ("ruie_cyan_gripper_b/images",), halves, "first half, second half", 400, RUIE),
    Clip(
        "ruie_cyan_gripper_place",
        ("ruie_cyan_gripper_a/images", "ruie_cyan_gripper_b/images"),
        between(("A_0128", "A_0144"), ("A_0154", "A_0169")),
        "before urchins are taken and a sea star falls, after",
        400,
        RUIE,
    ),
)


def write_parts(clip: Clip, data: Path, out: Path) -> list[Path]:
    """The folders of the images of both visits, reduced."""
    files = frames_of(clip, data, out)
    folders = []
    for number, part in enumerate(clip.split(files), 1):
        folder = out / f"part-{number}"
        for file in part:
            if not (folder / f"{file.stem}.png").is_file():
                images.write_rgb(folder / f"{file.stem}.png", scaled_down(images.read_rgb(file), clip.long_side))
        folders.append(folder)
    return folders


def frames_of(clip: Clip, data: Path, out: Path) -> list[Path]:
    """The images of a clip in their order; a video's are written first."""
    sources = [data / folder for folder in clip.folders]
    if sources[0].is_dir():
        found = [file for source in sources for file in source.iterdir()]
        return sorted(found, key=lambda file: natural_key(Path(file.name), Path()))
    folder = out / "frames"
    for number, frame in enumerate(islice(Video(sources[0]).frames(), 0, None, VIDEO_STEP)):
        if not (folder / f"{number:04d}.png").is_file():
            images.write_rgb(folder / f"{number:04d}.png", frame.rgb())
    return sorted(folder.iterdir())


def settings_of(clip: Clip) -> RunSettings:
    """The preset `fast` with the lens of a clip."""
    fast = PRESETS["fast"]
    if clip.lens is None:
        return fast
    assert isinstance(fast.sfm, ColmapSettings)
    focal, k1 = clip.lens
    return replace(fast, sfm=replace(fast.sfm, focal=focal, k1=k1, intrinsics="fixed"))


def compare(clip: Clip, data: Path, out: Path) -> str:
    """The row of a clip."""
    parts = write_parts(clip, data, out)
    runs = [out / f"run-{number}" for number in (1, 2)]
    for part, run in zip(parts, runs, strict=True):
        run_pipeline(part, run, settings_of(clip), last_stage="sfm")
    return row_of(clip, write_visits(runs, out / "visits"), runs[0])


def row_of(clip: Clip, record: VisitsRecord, first: Path) -> str:
    """The figures of a comparison as a row of the table."""
    change, by = record.changes[0], record.visits[1].alignment
    assert by is not None
    height, color = (
        f"{100 * area / change.compared_area:.2f}"
        for area in (change.gained_area + change.lost_area, change.paler_area + change.darker_area)
    )
    relative = None if change.height_std is None else 100 * change.height_std / distance_of(first)
    least = [
        "-" if std is None else f"{record.threshold * std:.{d}f}" for std, d in ((relative, 1), (change.color_std, 0))
    ]
    shared = f"{by.merged} of {by.matches}" + ("" if by.error_px is None else f", {by.error_px:.2f} px")
    frames = ", ".join(str(visit.frames) for visit in record.visits)
    return "| " + " | ".join((clip.name, clip.visits, frames, shared, height, color, *least)) + " |"


def distance_of(run: Path) -> float:
    """The median distance of the ground from the cameras, in the unit of the maps of a run without scale."""
    survey = open_survey(run)
    away = [np.linalg.norm(points - survey.centers[i], axis=1) for i, points in survey.overview.items()]
    return float(np.median(np.concatenate(away)))


def main() -> None:
    """The table that the command names, a row per clip."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    names = [clip.name for clip in CLIPS]
    parser.add_argument("--clips", nargs="+", choices=names, default=names)
    given = parser.parse_args()
    print(f"| {' | '.join(HEAD)} |\n|{' --- |' * len(HEAD)}", flush=True)
    for clip in CLIPS:
        if clip.name in given.clips:
            print(compare(clip, given.data, given.out / clip.name), flush=True)


if __name__ == "__main__":
    main()
