"""The lens of a long clip, from the one chunk whose frames share the most; it is kept in a file.

Straight-down strips over flat ground leave focal length and distance open. Where chunks fall apart, and what they say
of the focal length differs, the lens that was assumed for the best of them is held.
"""

import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.cache_key import cache_key
from swimm3r.io.files.damage import remake
from swimm3r.io.files.json_file import read_json
from swimm3r.progress import Progress
from swimm3r.sfm.colmap.calibration.refinement import refine
from swimm3r.sfm.colmap.calibration.start import lenses_to_try
from swimm3r.sfm.colmap.chunks.place import lens_with
from swimm3r.sfm.colmap.mapping import map_frames
from swimm3r.sfm.features.database import FeatureDatabase, write_excerpt
from swimm3r.sfm.settings import ColmapSettings

if TYPE_CHECKING:
    import pycolmap

PILOT = "pilot"  # folder in that of the chunks
_TRIES = 4  # chunks at most
_ENOUGH = 0.8  # share of a chunk's frames that are in place where its lens is believed at once
_AGREE = 1.15  # largest over smallest focal length of chunks that agree


@dataclass(frozen=True)
class PilotLens:
    """pilot/lens.json."""

    made_from: str
    model: str  # COLMAP's name
    params: tuple[float, ...]
    determined: bool  # by the images; else assumed, and to be held

    def camera(self, like: "pycolmap.Camera") -> "pycolmap.Camera":
        """The lens as a camera of another one's size and id."""
        return lens_with(like, self.model, self.params)


def pilot_lens(
    store: FeatureDatabase,
    chunks: Sequence[tuple[int, ...]],
    matches: Mapping[tuple[int, int], int],
    settings: ColmapSettings,
    folder: Path,
    progress: Progress,
) -> PilotLens | None:
    """The lens that the chunk with the most matches determines, or the next ones where it falls apart.

    None where none of a few chunks can be placed. A lens that the user holds fixed is taken as it is.
    """
    likely = lenses_to_try(store, settings)
    if settings.intrinsics == "fixed":
        return _record("", likely[0], determined=False)
    path = folder / "lens.json"
    about = sorted((i, j, count) for (i, j), count in matches.items())
    made_from = cache_key(about, settings.mapping, [[lens.model.name, lens.params.tolist()] for lens in likely])
    if path.is_file():
        kept = read_json(path, PilotLens, remake(folder.parent.parent))
        if kept.made_from == made_from:
            return kept
    folder.mkdir(parents=True, exist_ok=True)
    tried: list[_Trial] = []
    for k in _by_matches(chunks, matches)[:_TRIES]:
        with tempfile.TemporaryDirectory(dir=folder, prefix=".mapping.") as scratch:
            excerpt = write_excerpt(store, Path(scratch) / "database.db", chunks[k])
            models = map_frames(excerpt, settings, progress)
            if models:
                share = models[0].num_reg_images() / len(chunks[k])
                refined = refine(excerpt, models[0], settings, progress)
                tried.append(_Trial(share, models[0].cameras[1], refined.model.cameras[1], refined.refined))
        if tried and tried[-1].share >= _ENOUGH:
            break
    if not tried:
        return None
    best = max(tried, key=lambda trial: trial.share)
    determined = best.is_refined and (best.share >= _ENOUGH or _agree(tried))
    lens = _record(made_from, best.refined if determined else best.assumed, determined=determined)
    write_text(path, json.dumps(vars(lens)))
    return lens


@dataclass(frozen=True)
class _Trial:
    """A chunk that was placed."""

    share: float  # of its frames
    assumed: "pycolmap.Camera"
    refined: "pycolmap.Camera"
    is_refined: bool


def _agree(tried: Sequence[_Trial]) -> bool:
    """Return whether several chunks say the same of the focal length."""
    focals = [trial.refined.mean_focal_length() for trial in tried if trial.is_refined]
    return len(focals) >= 2 and max(focals) < _AGREE * min(focals)


def _by_matches(chunks: Sequence[tuple[int, ...]], matches: Mapping[tuple[int, int], int]) -> list[int]:
    """Chunks, those with the most matches inside first."""
    inside = [sum(n for (i, j), n in matches.items() if i + 1 in own and j + 1 in own) for own in map(set, chunks)]
    return np.argsort(inside)[::-1].tolist()


def _record(made_from: str, camera: "pycolmap.Camera", *, determined: bool) -> PilotLens:
    return PilotLens(made_from, camera.model.name, tuple(camera.params.tolist()), determined)
