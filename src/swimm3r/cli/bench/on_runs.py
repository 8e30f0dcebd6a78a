"""`swimm3r bench restoration` and `localization`: scores of finished runs."""

from pathlib import Path
from typing import Annotated

from swimm3r.cli.bench.table import ONE_BY_ONE, Jobs, show_table
from swimm3r.cli.terminal.options import FLAT, Out, Runs
from swimm3r.localization.settings import GS_CPR, LocalizationSettings


def restoration(runs: Runs, /, out: Out, jobs: Jobs = ONE_BY_ONE) -> None:
    """Score the restored frames of runs without reference: UIQM, UCIQE, and URanker or the reason why it is missing.

    Rows are of physical colors, before the white balance of the displayed images, which has rows of its own.

    Args:
        runs: Run folders with finished structure from motion, such as bench sfm leaves; they are only read.
        out: Folder for images side by side and the tables restoration.md, .csv, .json and .tex.
        jobs: Scenes computed in parallel.
    """
    from swimm3r.bench.protocols.restoration import score_restoration

    show_table(out, lambda progress: score_restoration(runs, out, jobs, progress))


def localization(
    runs: Runs,
    /,
    out: Out,
    maps: Path | None = None,
    references: Path | None = None,
    settings: Annotated[LocalizationSettings, FLAT] = GS_CPR,
    jobs: Jobs = ONE_BY_ONE,
) -> None:
    """Locate every test frame of finished runs in their maps, scored against structure from motion of all frames.

    Several runs of one clip, their poses found in different ways, are rows of one table.

    Args:
        runs: Run folders with a map; they are only read.
        out: Folder for match images, references and the tables localization.md, .csv, .json and .tex.
        maps: Folder of swimm3r bench render, whose maps of these runs replace the runs' own.
        references: Folder with CLIP.json (a cameras.json) of all frames of each clip, test frames included. By default
            COLMAP finds their poses.
        settings: The localization protocol; SIFT where MASt3R's weights are missing.
        jobs: Scenes computed in parallel.
    """
    from swimm3r.bench.protocols.localization import localize

    show_table(out, lambda progress: localize(runs, out, settings, maps, references, jobs, progress))
