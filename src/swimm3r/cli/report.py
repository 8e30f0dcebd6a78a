"""`swimm3r report`: writes the page of a finished run again."""

from swimm3r.cli.terminal.options import Run


def report(run: Run, /) -> None:
    """Write RUN/report.html from the contents of the run folder.

    Args:
        run: Run folder with finished structure from motion.
    """
    from swimm3r.report import write_report

    print(write_report(run))
