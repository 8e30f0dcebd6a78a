"""`swimm3r eval`: scores a finished run again."""

from pathlib import Path

from swimm3r.cli.pipeline.stages import RESULTS
from swimm3r.cli.terminal.console import drawn_progress, print_results
from swimm3r.cli.terminal.options import Run
from swimm3r.cli.terminal.summary import print_summary
from swimm3r.settings import CountOrZero
from swimm3r.splat.settings import MapDevice


def evaluate(
    run: Run,
    /,
    reference: Path | None = None,
    steps: CountOrZero | None = None,
    map_device: MapDevice = "auto",
) -> None:
    """Score a run's map on its test frames again, and write its report.

    With other steps or another reference than the run's own, the scores stand beside its own: other_protocols in
    summary.json, the views in RUN/renders/protocols.

    Args:
        run: Run folder with a finished map.
        reference: File cameras.json with known poses to score the result against.
        steps: Refinement steps for the pose of each test frame; those of the run by default.
        map_device: Device that renders the map; auto uses CUDA if a GPU and NVIDIA Warp are present.
    """
    from swimm3r.pipeline.scores.evaluation import evaluate_run

    with drawn_progress() as progress:
        summary = evaluate_run(run, steps=steps, reference=reference, map_device=map_device, progress=progress)
    print_summary(summary)
    print_results(run, RESULTS)
