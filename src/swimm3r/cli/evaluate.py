"""`swimm3r eval`: scores a finished run again."""

from pathlib import Path

from tyro.conf import Positional

from swimm3r.cli.terminal.console import drawn_progress, print_summary
from swimm3r.settings import CountOrZero


def evaluate(
    run: Positional[Path],
    /,
    reference: Path | None = None,
    steps: CountOrZero | None = None,
) -> None:
    """Score a run's map on its test frames again, and write its report.

    With other steps or another reference than the run's own, the scores stand beside its own: other_protocols in
    summary.json, the views in RUN/renders/protocols.

    Args:
        run: the run folder.
        reference: a cameras.json with poses to compare with.
        steps: of refinement for each test frame's pose; as in the run where not given.
    """
    from swimm3r.pipeline.run import evaluate_run

    with drawn_progress() as progress:
        summary = evaluate_run(run, steps=steps, reference=reference, progress=progress)
    print_summary(summary, run)
