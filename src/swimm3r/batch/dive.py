"""One dive of a batch: its input, its settings and the name of its folder."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from swimm3r.errors import UsageError
from swimm3r.io.files.safe_names import check_name
from swimm3r.pipeline.presets import RunSettings

RESERVED = ("logs", "old")  # folders beside the dives'


@dataclass(frozen=True)
class Dive:
    """One input, the settings of its run, and the name of its folder."""

    name: str
    source: Path
    settings: RunSettings
    reference: Path | None = None


def check_names(dives: Sequence[Dive]) -> None:
    """Raise UsageError where a dive's name cannot be that of its folder, or two dives have the same."""
    for dive in dives:
        try:
            check_name(dive.name)
        except ValueError:
            usable = False
        else:
            usable = not set(dive.name) & set("/\\") and dive.name not in RESERVED and not dive.name.startswith(".")
        if not usable:
            raise UsageError(
                f"a dive cannot be called {dive.name!r}",
                cause="the name is that of its folder in --out, where logs/ and old/ have their own meaning",
                hint="another `name` in a CSV table",
            )
    twice = [name for name, count in Counter(dive.name.casefold() for dive in dives).items() if count > 1]
    if twice:
        raise UsageError(
            f"two dives are called {', '.join(twice)}",
            cause="the same dive was named twice, or two folders have one name",
            hint="a CSV table with a column `name`, or two batches",
        )
