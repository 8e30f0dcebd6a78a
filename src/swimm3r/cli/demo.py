"""`swimm3r demo`: a synthetic dive with known truth through the whole pipeline; proves the installation."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from swimm3r.cli.terminal.console import drawn_progress, print_next, print_summary
from swimm3r.pipeline.presets import PRESETS
from swimm3r.splat.settings import RecipeName, UwbsSettings, with_recipe
from swimm3r.synthetic.settings import DiveSettings


def demo(
    out: Path = Path("runs/demo"),
    recipe: RecipeName = "uwbs-static",
    redo: bool = False,
    dive: Annotated[DiveSettings, arg(name="")] = DiveSettings(),  # noqa: B008
) -> None:
    """Make a synthetic dive and run the pipeline on it; needs no download and no GPU.

    Args:
        out: the run folder; the dive itself goes to OUT-dive beside it.
        recipe: uwbs-static; uwbs-dynamic, whose map changes with time; or another method on the same start.
        redo: make stages again that were made with other settings; what is there moves to OUT/old.
        dive: what the synthetic dive looks like.
    """
    size = PRESETS["fast"].splat
    assert isinstance(size, UwbsSettings)
    settings = replace(PRESETS["default"], splat=with_recipe(size, recipe))
    from swimm3r.io.files.outputs import output_folder
    from swimm3r.pipeline.run import run_pipeline
    from swimm3r.scene.run_folder import check_vacant
    from swimm3r.synthetic import write_dive

    out = Path(os.path.abspath(out))
    folder = out.parent / f"{out.name}-dive"
    with drawn_progress() as progress, output_folder(out), output_folder(folder):
        check_vacant(out)
        write_dive(dive, folder, progress)
        summary = run_pipeline(folder, out, settings, redo=redo, progress=progress)
    print_summary(summary, out)
    print_next("other views of the map", "render", out)
