"""`swimm3r report`: writes the page of a finished run again."""

from pathlib import Path

from tyro.conf import Positional


def report(run: Positional[Path], /) -> None:
    """Write RUN/report.html from what the run folder holds.

    Args:
        run: the run folder.
    """
    from swimm3r.report import write_report

    print(write_report(run))
