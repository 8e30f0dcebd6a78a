"""Published data sets in their own layouts, and any folder of pairs, as sequences of shots.

survey = read_tree(Path("archive"))        every sequence below a folder, whichever data sets they are of
view = load(survey.sequences[0], 12)       its images and depth in memory
pairs = make_pairs(survey.sequences[0], PairSettings())
"""

from pathlib import Path
from typing import TYPE_CHECKING

from swimm3r.datasets.settings import PairSettings

if TYPE_CHECKING:
    import swimm3r.datasets.pairs
    import swimm3r.datasets.sequences

__all__ = ["PairSettings", "load", "make_pairs", "read_tree"]


def read_tree(root: Path) -> "swimm3r.datasets.sequences.Survey":
    """Every sequence below a folder. Raises InputError where there is none."""
    from swimm3r.datasets import tree

    return tree.read_tree(root)


def load(sequence: "swimm3r.datasets.sequences.Sequence", index: int) -> "swimm3r.datasets.sequences.DatasetView":
    """One shot in memory. Raises InputError where a file is damaged."""
    from swimm3r.datasets import sequences

    return sequences.load(sequence, index)


def make_pairs(
    sequence: "swimm3r.datasets.sequences.Sequence", settings: PairSettings | None = None
) -> list["swimm3r.datasets.pairs.Pair"]:
    """Two shots each that see much the same."""
    from swimm3r.datasets import pairs

    return pairs.make_pairs(sequence, settings or PairSettings())
