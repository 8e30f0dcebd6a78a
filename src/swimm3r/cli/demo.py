"""`swimm3r demo`: a synthetic dive with known truth through the whole pipeline; proves the installation."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from swimm3r.cli.pipeline.stages import RESULTS
from swimm3r.cli.terminal.console import drawn_progress, print_next, print_results
from swimm3r.cli.terminal.options import FLAT, Out
from swimm3r.cli.terminal.summary import print_summary
from swimm3r.pipeline.presets import PRESETS
from swimm3r.splat.settings import MapDevice, RecipeName, UwbsSettings, with_recipe
from swimm3r.synthetic.settings import DiveSettings


def demo(
    out: Out = Path("runs/demo"),
    recipe: RecipeName = "uwbs-static",
    map_device: MapDevice = "auto",
    redo: bool = False,
    dive: Annotated[DiveSettings, FLAT] = DiveSettings(),  # noqa: B008
) -> None:
    """Make a synthetic dive and run the pipeline on it; needs no download and no GPU.

    Args:
        out: Run folder that receives all results; the dive itself goes to OUT-dive beside it.
        recipe: Kind of map: uwbs-static, uwbs-dynamic for scenes that change with time, or another published method.
        map_device: Device that trains and renders the map; auto uses CUDA if a GPU and NVIDIA Warp are present.
        redo: Repeat stages that were made with other settings; the earlier results move to OUT/old.
        dive: The synthetic dive.
    """
    fast = PRESETS["fast"]
    assert isinstance(fast.splat, UwbsSettings)
    settings = replace(PRESETS["default"], splat=with_recipe(fast.splat, recipe), test=fast.test)
    from swimm3r.io.files.outputs import output_folder
    from swimm3r.pipeline.run import run_pipeline
    from swimm3r.scene.run_folder import check_vacant
    from swimm3r.synthetic import write_dive

    out = Path(os.path.abspath(out))
    folder = out.parent / f"{out.name}-dive"
    with drawn_progress() as progress, output_folder(out), output_folder(folder):
        check_vacant(out)
        write_dive(dive, folder, progress)
        summary = run_pipeline(
            folder, out, settings, redo=redo, map_device=map_device, progress=progress, on_stage=progress.begin_stage
        )
    print_summary(summary)
    print_results(out, RESULTS)
    print_next("fly through the map", "view", out)
