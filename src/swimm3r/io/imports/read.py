"""Readers for the files of other programs, chosen by name and content."""

from contextlib import suppress
from pathlib import Path

from swimm3r.cameras import cameras_of, check_lens
from swimm3r.errors import InputError
from swimm3r.io.cameras_json import read_cameras
from swimm3r.io.colmap import model as colmap
from swimm3r.io.files import json_file
from swimm3r.io.files.damage import guard
from swimm3r.io.imports import metashape, nerfstudio, openmvg, vggt
from swimm3r.io.imports.record import REMEDY, ForeignModel, without_points


def read_foreign(path: Path) -> ForeignModel:
    """Read a COLMAP (GLOMAP, GLUEMAP, VGGT's demo_colmap) model, a nerfstudio or Spann3R transforms.json, a Metashape
    cameras.xml, an OpenMVG sfm_data.json or a VGGT predictions.npz; or the folder that holds one of them; or a
    cameras.json of ours, which lies beside models that say more and so must be named itself.

    Raises InputError for anything else and for a damaged file.
    """
    found = _file(path)
    with guard(found or path, REMEDY):
        foreign = _read(found) if found else ForeignModel("COLMAP model", colmap.read_model(path))
        check_lens(cameras_of(foreign.model))
        return foreign


def model_path(path: Path) -> Path | None:
    """The file, or the folder of a COLMAP model, that `read_foreign` reads; None where there is none."""
    with suppress(InputError):
        return _file(path) or colmap.find_model(path)
    return None


def _read(path: Path) -> ForeignModel:
    match path.suffix.lower():
        case ".xml":
            return metashape.read(path)
        case ".npz":
            return vggt.read(path)
    document = json_file.decode(path.read_bytes())
    if not isinstance(document, dict):
        raise ValueError("a JSON object is expected")
    if "sfm_data_version" in document:
        return openmvg.read(document)
    frames = document.get("frames")
    if isinstance(frames, list) and any(isinstance(frame, dict) and "c2w" in frame for frame in frames):
        return _own(path)
    return nerfstudio.read(path, document)


def _own(path: Path) -> ForeignModel:
    """A cameras.json, as docs/conventions.md has it."""
    table = read_cameras(path)
    size = (table.width, table.height)
    model = without_points(table.names, table.model, size, table.K, table.distortion, table.cam2world)
    return ForeignModel("cameras.json", model, metric=table.units == "metres")


def _file(path: Path) -> Path | None:
    """The file to read, None for a COLMAP model's folder."""
    if path.is_file():
        return path
    for name in ("transforms.json", "sfm_data.json", "cameras.xml", "predictions.npz"):
        if (path / name).is_file():
            return path / name
    return None
