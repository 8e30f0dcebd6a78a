"""The page of a run: one self-contained HTML file that opens anywhere."""

from pathlib import Path


def write_report(folder: Path) -> Path:
    """Write RUN/report.html from what the run folder holds, and return its path."""
    from swimm3r.report import page

    return page.write(folder)
