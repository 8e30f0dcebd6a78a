"""No-reference scores of restored images (the paper's restoration table).

The restored training frames of run folders in physical colors, before any white balance; as rows of their own the same
frames as shown, with the white balance, and the frames as filmed: what a score gives an image from which nothing was
taken. UIQM and UCIQE reward contrast stretching; look at the images side by side.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch

from swimm3r.bench.cells import Result, ResultKey, Scores, kept_cell, over_scenes
from swimm3r.bench.images import Panel, stored, write_grid
from swimm3r.bench.inputs import reconstruction_of
from swimm3r.bench.runs import Clip, clips_of
from swimm3r.bench.scores import columns
from swimm3r.bench.tables import Table
from swimm3r.io.files.cache_key import content_digest
from swimm3r.io.view_names import view_stems
from swimm3r.pipeline.scores.restored import no_reference_scores
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.tasks.settings import EngineSettings

COLUMNS = columns("uiqm_funie", "uciqe_cielab", "uranker", "scored_pct")
_FILMED = "as filmed"
_SHOWN_AS = "{}, white-balanced"
_SHOWN = 4  # frames side by side


def score_restoration(
    runs: Sequence[Path], out: Path, how: EngineSettings | None = None, progress: Progress = silent
) -> Table:
    """Every run's restored frames. Raises InputError where a folder holds no finished structure from motion."""
    cells = over_scenes(clips_of(runs), partial(_cells_of_clip, out=out), out, how or EngineSettings(), progress)
    return Table("restoration", "Images without the water", cells, COLUMNS)


def _cells_of_clip(clip: Clip, /, *, out: Path, progress: Progress) -> list[Result]:
    first = clip.runs[0].open()
    scored = [c.score for c in COLUMNS]
    frames = first.frames.train
    cells = [
        kept_cell(
            out,
            ResultKey(clip.name, _FILMED),
            [clip.runs[0].frames, [content_digest(frame.path) for frame in frames]],
            partial(_of_paths, paths=[frame.path for frame in frames], frames=len(frames), progress=progress),
            scored,
        )
    ]
    for run in clip.runs:
        sfm = run.open()
        if sfm.rec.medium is None:
            cells.append(Result(clip.name, run.sfm, 0, not_run="its water was not estimated"))
            continue
        restored = f"{run.sfm} + {sfm.rec.medium.estimator}"
        for method, kind in ((restored, "restored_physical"), (_SHOWN_AS.format(restored), "restored")):
            paths = [run.folder / "sfm" / kind / f"{name}.png" for name in sfm.rec.names]
            make = partial(_of_paths, paths=paths, frames=len(frames), progress=progress)
            made_from = [reconstruction_of(run.folder, sfm), [content_digest(path) for path in paths]]
            cells.append(kept_cell(out, ResultKey(clip.name, method), made_from, make, scored))
    for i in range(0, len(frames), max(1, len(frames) // _SHOWN)):
        _side_by_side(out, clip, frames, i)
    return cells


def _of_paths(_: Path, *, paths: Sequence[Path], frames: int, progress: Progress) -> Scores:
    found, there = no_reference_scores(paths, progress), sum(path.is_file() for path in paths)
    scores = {"uiqm_funie": found.uiqm, "uciqe_cielab": found.uciqe, "uranker": found.urank}
    return {**scores, "scored_pct": 100 * there / frames}


def _side_by_side(out: Path, clip: Clip, frames: Frames, i: int) -> None:
    name = frames.names[i]
    filmed = (frames.image(i) * 255).round().to(torch.uint8).numpy()
    panels = [Panel(_FILMED, filmed)]
    panels += [stored(run.sfm, run.folder / "sfm" / "restored" / f"{name}.png") for run in clip.runs]
    write_grid(out / "images" / clip.name / f"{view_stems(frames.names)[name]}.png", [panels])
