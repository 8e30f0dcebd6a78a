"""Repeat visits of one site: several runs in one frame, and the changes between them with their significance."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from swimm3r.progress import Progress
from swimm3r.visits.settings import VisitSettings

if TYPE_CHECKING:
    import swimm3r.visits.record

__all__ = ["VisitSettings", "write_visits"]


def write_visits(
    runs: Sequence[str | Path],
    out: str | Path,
    settings: VisitSettings | None = None,
    progress: Progress | None = None,
) -> "swimm3r.visits.record.VisitsRecord":
    """Bring runs of one site, in the order of the visits, into one frame, and write their changes into `out`.

    Raises UsageError for fewer than two runs, RegistrationError where a run cannot be aligned with any before it,
    InputError where a run has no depth maps, DeviceError where a package of `swimm3r[geo]` is missing.
    """
    from swimm3r.visits.write import write_visits

    return write_visits([Path(run) for run in runs], Path(out), settings or VisitSettings(), progress)
