"""The lens of a long clip, from the one chunk whose frames share the most; it is kept in a file."""

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
from swimm3r.sfm.colmap import calibration
from swimm3r.sfm.colmap.chunks.place import lens_with
from swimm3r.sfm.colmap.mapping import map_frames
from swimm3r.sfm.features.database import FeatureDatabase, write_excerpt
from swimm3r.sfm.settings import ColmapSettings

if TYPE_CHECKING:
    import pycolmap

PILOT = "pilot"  # folder in that of the chunks
_TRIES = 4  # chunks at most
_ENOUGH = 0.8  # share of a chunk's frames that are in place where its lens is believed


@dataclass(frozen=True)
class _Lens:
    """pilot/lens.json."""

    made_from: str
    model: str
    params: tuple[float, ...]


def pilot_lens(
    store: FeatureDatabase,
    chunks: Sequence[tuple[int, ...]],
    matches: Mapping[tuple[int, int], int],
    settings: ColmapSettings,
    folder: Path,
    progress: Progress,
) -> "pycolmap.Camera | None":
    """The lens that the chunk with the most matches determines, or the next ones where it falls apart.

    None where none of a few chunks can be placed. A lens that the user holds fixed is taken as it is.
    """
    likely = calibration.lenses(store, settings)
    if settings.intrinsics == "fixed":
        return likely[0]
    path = folder / "lens.json"
    about = sorted((i, j, count) for (i, j), count in matches.items())
    made_from = cache_key(about, settings.mapping, [[lens.model.name, lens.params.tolist()] for lens in likely])
    if path.is_file():
        kept = read_json(path, _Lens, remake(folder.parent.parent))
        if kept.made_from == made_from:
            return lens_with(likely[0], kept.model, kept.params)
    inside = [
        sum(n for (i, j), n in matches.items() if i + 1 in chunk and j + 1 in chunk) for chunk in map(set, chunks)
    ]
    folder.mkdir(parents=True, exist_ok=True)
    best: tuple[float, pycolmap.Camera] | None = None
    for k in np.argsort(inside)[::-1][:_TRIES].tolist():
        with tempfile.TemporaryDirectory(dir=folder, prefix=".mapping.") as scratch:
            excerpt = write_excerpt(store, Path(scratch) / "database.db", chunks[k])
            models = map_frames(excerpt, settings, progress)
            if not models:
                continue
            share = models[0].num_reg_images() / len(chunks[k])
            if best is None or share > best[0]:
                best = share, calibration.refine(excerpt, models[0], settings, progress).model.cameras[1]
        if best[0] >= _ENOUGH:
            break
    if best is None:
        return None
    lens = best[1]
    write_text(path, json.dumps(vars(_Lens(made_from, lens.model.name, tuple(lens.params.tolist())))))
    return lens
