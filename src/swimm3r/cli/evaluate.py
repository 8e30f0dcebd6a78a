"""`swimm3r eval`: scores a finished run again."""

from pathlib import Path

from tyro.conf import Positional

from swimm3r.cli.console import drawn_progress, print_summary
from swimm3r.presets import RunSettings
from swimm3r.splat.settings import PoseRefinementSettings


def evaluate(
    run: Positional[Path],
    /,
    reference: Path | None = None,
    test: PoseRefinementSettings = PoseRefinementSettings(),  # noqa: B008
) -> None:
    """Score a run's map on its test frames again, and write its report.

    Args:
        run: the run folder.
        reference: a cameras.json with poses to compare with.
        test: how the test frames' poses are refined.
    """
    from swimm3r.run import evaluate_run

    with drawn_progress() as progress:
        summary = evaluate_run(run, RunSettings(test=test), reference=reference, progress=progress)
    print_summary(summary, run)
