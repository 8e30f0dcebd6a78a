"""A procedural dive with exact ground truth: seafloor, camera path, water, caustics, marine snow, a fish."""

from pathlib import Path
from typing import TYPE_CHECKING

from swimm3r.progress import Progress, watched
from swimm3r.synthetic.settings import Coefficients, DiveSettings

if TYPE_CHECKING:
    import swimm3r.synthetic.dive

__all__ = ["Coefficients", "DiveSettings", "make_dive", "write_dive"]


def make_dive(settings: DiveSettings) -> "swimm3r.synthetic.dive.Dive":
    """The seafloor, path and water of a dive; images are rendered one by one, by `Dive.frame`."""
    from swimm3r.synthetic import dive

    return dive.make_dive(settings)


def write_dive(settings: DiveSettings, folder: str | Path, progress: Progress | None = None) -> None:
    """Render a dive into a folder: images/ and truth/. Raises InputError where another dive's images lie there."""
    from swimm3r.synthetic import dive

    with watched(progress) as told:
        dive.write_dive(settings, Path(folder), told)
