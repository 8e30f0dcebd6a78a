"""How good the pictures without water look to scores that need no reference (the paper's Tab. barbados_color_noref).

The restored training frames of run folders, and as a row of their own the frames as filmed: what a score gives a
picture from which nothing was taken. UIQM and UCIQE reward contrast stretching; look at the pictures side by side.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch

from swimm3r.bench.cells import Cell, Place, Scores, kept_cell, over_scenes
from swimm3r.bench.pictures import Panel, stored, write_grid
from swimm3r.bench.runs import Clip, clips_of
from swimm3r.bench.scores import columns
from swimm3r.bench.settings import JobSettings
from swimm3r.bench.tables import Table
from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.underwater import URANKER, uciqe, uiqm
from swimm3r.frames import Frames
from swimm3r.io import images
from swimm3r.progress import Progress, silent

COLUMNS = columns("uiqm_funie", "uciqe_cielab", "uranker")
_FILMED = "as filmed"
_SHOWN = 4  # frames side by side


def score_restoration(
    runs: Sequence[Path], out: Path, how: JobSettings | None = None, progress: Progress = silent
) -> Table:
    """Every run's restored frames. Raises InputError where a folder holds no finished structure from motion."""
    cells = over_scenes(clips_of(runs), partial(_cells_of_clip, out=out), out, how or JobSettings(), progress)
    return Table("restoration", "Pictures without the water", cells, COLUMNS)


def _cells_of_clip(clip: Clip, /, *, out: Path, progress: Progress) -> list[Cell]:
    first = clip.runs[0].open()
    scored = [c.score for c in COLUMNS]
    frames = first.frames.train
    cells = [
        kept_cell(
            out,
            Place(clip.name, _FILMED),
            [clip.runs[0].frames, scored],
            lambda _: no_reference_scores([frame.path for frame in frames], progress),
        )
    ]
    for run in clip.runs:
        sfm = run.open()
        paths = [run.folder / "sfm" / "restored" / f"{name}.png" for name in sfm.rec.names]
        make = partial(_of_paths, paths=paths, progress=progress)
        cells.append(kept_cell(out, Place(clip.name, run.sfm), [sfm.key, scored], make))
    for i in range(0, len(frames), max(1, len(frames) // _SHOWN)):
        _side_by_side(out, clip, frames, i)
    return cells


def no_reference_scores(paths: Sequence[Path], progress: Progress = silent) -> dict[str, float | NotComputed]:
    """Means over pictures of native size, those that are not there left out."""
    scores = []
    paths = [path for path in paths if path.is_file()]
    for done, path in enumerate(paths):
        progress("scoring pictures", done, len(paths))
        picture = images.read_rgb(path)
        rgb = torch.from_numpy(picture.astype("float32")) / (255 if picture.dtype == "uint8" else 65535)
        scores.append((uiqm(rgb).uiqm, uciqe(rgb)))
    if not scores:
        nothing = NotComputed("no frame was restored")
        return {"uiqm_funie": nothing, "uciqe_cielab": nothing, "uranker": URANKER}
    mean = torch.tensor(scores).mean(0).tolist()
    return {"uiqm_funie": mean[0], "uciqe_cielab": mean[1], "uranker": URANKER}


def _of_paths(folder: Path, *, paths: Sequence[Path], progress: Progress) -> Scores:
    return no_reference_scores(paths, progress)


def _side_by_side(out: Path, clip: Clip, frames: Frames, i: int) -> None:
    name = frames.names[i]
    filmed = (frames.image(i) * 255).round().to(torch.uint8).numpy()
    panels = [Panel(_FILMED, filmed)]
    panels += [stored(run.sfm, run.folder / "sfm" / "restored" / f"{name}.png") for run in clip.runs]
    write_grid(out / "pictures" / clip.name / f"{Path(name).stem}.png", [panels])
