"""The landmarks of a run on disk, RUN/localization/landmarks.npz: made once, read by every later stream."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from swimm3r.io.files.array_file import read_npz
from swimm3r.io.files.atomic import atomic_path
from swimm3r.io.files.cache_key import cache_key, code_version, content_digest
from swimm3r.io.files.damage import guard, remake
from swimm3r.localization.lenses import has_several_lenses
from swimm3r.localization.online.landmark_map import LandmarkMap, landmark_map
from swimm3r.progress import Progress, silent
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.rectified.run import run_frames, run_rectification

log = logging.getLogger(__name__)

_ARRAYS = ("xyz", "point", "frame", "descriptors", "words", "looks")


def landmarks_of_run(folder: Path, settings: FeatureSettings, progress: Progress = silent) -> LandmarkMap:
    """The landmarks of a run with finished structure from motion, made where the file is of another state of it.

    Of a run that cannot be written to they are made each time, with a warning. Raises InputError where the file is
    damaged.
    """
    frames = run_frames(folder)
    rec = load_reconstruction(folder / "sfm", frames)
    path = folder / "localization" / "landmarks.npz"
    made_from = (content_digest(folder / "sfm" / name) for name in ("cameras.json", "sparse"))
    key = cache_key(settings, code_version(), *made_from)
    found = _read(path, key, rec) if path.is_file() else None
    if found is None:
        found = landmark_map(rec, rec.still(frames), settings, progress)
        _keep(path, found, key)
    return replace(
        found,
        rectification=run_rectification(folder),
        several_lenses=has_several_lenses(rec, frames),
        rows_rectified=frames.rows_rectified,
    )


def _keep(path: Path, found: LandmarkMap, key: str) -> None:
    try:
        with atomic_path(path) as draft:
            arrays = {name: getattr(found, name).numpy() for name in _ARRAYS}
            np.savez(draft, key=np.array(key), distance=np.array(found.distance), **arrays)
    except OSError as error:  # read-only, or full: the poses may go elsewhere
        log.warning("%s is not written (%s): the landmarks are described anew each time", path, error.strerror or error)


def _read(path: Path, key: str, rec: Reconstruction) -> LandmarkMap | None:
    """The landmarks in the file; None where it was made from something else."""
    with guard(path, remake(path)):
        stored = read_npz(path)
        if str(stored["key"]) != key:
            return None
        xyz, point, frame, descriptors, words, looks = (torch.from_numpy(stored[name]) for name in _ARRAYS)
        distance = float(stored["distance"])
        return LandmarkMap(rec.cameras, rec.metric, xyz, point, frame, descriptors, words, looks, distance)
