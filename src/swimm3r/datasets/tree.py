"""A folder is searched for sequences of any known layout, and what it holds is told."""

import os
from collections.abc import Callable
from pathlib import Path

from swimm3r.datasets import flsea, paired_folders, posed_scenes, seathru
from swimm3r.datasets.layouts import Folder, counted, folder
from swimm3r.datasets.sequences import Sequence, Skipped, Survey
from swimm3r.errors import InputError

_Reader = Callable[[Folder], tuple[Sequence | None, list[Skipped]]]
_LAYOUTS: tuple[tuple[Callable[[Folder], bool], _Reader], ...] = (
    (paired_folders.is_dive, paired_folders.read_dive),
    (flsea.is_sequence, flsea.read_sequence),
    (seathru.is_scene, seathru.read_scene),
    (paired_folders.is_triples, paired_folders.read_triples),
    (posed_scenes.is_scene, posed_scenes.read_scene),
)


def read_tree(root: Path) -> Survey:
    """Every sequence at or below a folder, by name, and everything that looked like one and is not used.

    Raises InputError where there is no sequence at all.
    """
    if not root.is_dir():
        raise _nothing(root, "there is no such folder")
    sequences: list[Sequence] = []
    skipped: list[Skipped] = []
    for where, folders, _ in os.walk(root):
        here = folder(Path(where), root)
        folders[:] = [p.name for p in here.children.values()]
        reader = next((read for fits, read in _LAYOUTS if fits(here)), None)
        if reader is None:
            continue
        folders.clear()
        try:
            found, left = reader(here)
        except InputError as error:  # one damaged scene must not hide eleven whole ones; the report names it
            skipped.append(Skipped(here.path, error.what))
            continue
        sequences += [found] if found else []
        skipped += left
    if not sequences:
        reasons = "; ".join(f"{s.path}: {s.why}" for s in skipped[:3])
        raise _nothing(root, reasons or "none of its folders has a known layout")
    return Survey(root, tuple(sorted(sequences, key=lambda s: s.name)), tuple(skipped))


def describe(survey: Survey) -> str:
    """A readable list of the sequences found and the files left out."""
    lines = [f"{counted(len(survey.sequences), 'sequence')} under {survey.root}"]
    for s in survey.sequences:
        have = [
            f"{sum(getattr(shot, name) is not None for shot in s.shots)} {name}" for name in ("raw", "clean", "depth")
        ]
        poses = f", {len(s.cam2world)} {'' if s.metric else 'unscaled '}poses" if s.cam2world else ""
        test = sum(shot.split == "test" for shot in s.shots)
        held = "" if not test else ", test" if test == len(s) else f", {test} of them test"
        lines.append(f"  {s.name}: {s.kind}, {counted(len(s), 'shot')} ({', '.join(have)}{poses}){held}")
        lines += [f"    note: {note}" for note in s.notes]
    reasons: dict[str, list[Path]] = {}
    for left in survey.skipped:
        reasons.setdefault(left.why, []).append(left.path)
    if reasons:
        lines.append(f"Not used: {counted(len(survey.skipped), 'item')}")
    for why, paths in reasons.items():
        more = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
        lines.append(f"  {paths[0].relative_to(survey.root)}{more}: {why}")
    return "\n".join(lines)


def _nothing(root: Path, why: str) -> InputError:
    return InputError(
        f"no data set was found in {root}: {why}",
        cause="the folder is another one, or was unpacked differently",
        hint="known are FLSea-VI, Sea-Thru, SeaThru-NeRF, synthetic dives and folders raw/ clean/ depth/ "
        "(docs/datasets.md shows them)",
    )
