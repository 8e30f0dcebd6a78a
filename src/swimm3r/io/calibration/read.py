"""Calibration files recognized by their content, and the choice of one of their cameras."""

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from swimm3r.errors import UsageError
from swimm3r.io.calibration import colmap_text
from swimm3r.io.calibration.documents import from_opencv_xml, from_yaml, read_document
from swimm3r.io.calibration.record import REMEDY, CalibratedLens, Calibration, lens_at, with_size
from swimm3r.io.files.damage import guard
from swimm3r.io.files.json_file import decode
from swimm3r.io.files.regular_file import require_regular_file
from swimm3r.io.imports import metashape, nerfstudio

_LARGEST = 256 << 20  # bytes: a transforms.json of a million frames
_AGISOFT = "Agisoft Metashape"


def read_calibrations(path: Path) -> list[Calibration]:
    """Every camera of a calibration file; lenses that are the same appear once.

    Raises InputError for a file that is none, is damaged, or has a lens that no camera model here can express.
    """
    require_regular_file(path, "a calibration")
    with guard(path, REMEDY):
        if path.stat().st_size > _LARGEST:
            raise ValueError("it is far larger than a calibration")
        return list(_distinct(_read(path.read_bytes().decode("utf-8-sig"))))


def read_calibration(path: Path, camera: str | None = None, size: tuple[int, int] | None = None) -> Calibration:
    """One camera of a file: the one of that name, or the only one. `size` is that of images which the file lacks.

    Raises UsageError where there is a choice, no camera of that name, or no size; else as `read_calibrations`.
    """
    found = read_calibrations(path)
    named = found if camera is None else [one for one in found if one.name == camera]
    if len(named) != 1:
        names = ", ".join(one.name for one in found[:10]) + (" ..." if len(found) > 10 else "")
        raise UsageError(
            f"{path} holds {len(found)} cameras: {names}"
            if camera is None
            else f"{path} has no camera {camera}, but {names}",
            cause="the lens of a dive is that of one of them" if camera is None else "a slip in the name",
            hint=f"--calibration-camera {found[0].name}, or another of these names",
        )
    with_size(named[0], size)
    return named[0]


def read_lens(
    path: Path, width: int, height: int, camera: str | None = None, size: tuple[int, int] | None = None
) -> CalibratedLens:
    """The lens of one camera of a file in images of this size. Raises as `read_calibration` and `lens_at` do."""
    calibration = read_calibration(path, camera, size)
    with guard(path, REMEDY):
        return lens_at(calibration, width, height, size)


def _read(text: str) -> list[Calibration]:
    start = text.lstrip()[:1]
    if not start:
        raise ValueError("it is empty")
    if start == "<":
        return _xml(text)
    if start == "{":
        document = decode(text)
        return _nerfstudio(document) if _is_nerfstudio(document) else read_document(document)
    return colmap_text.read(text) if colmap_text.is_colmap(text) else read_document(from_yaml(text))


def _xml(text: str) -> list[Calibration]:
    try:
        root = ET.fromstring(text.encode())
    except ET.ParseError as error:
        raise ValueError(f"it is no XML: {error}") from error
    if root.tag == "opencv_storage":
        return read_document(from_opencv_xml(root))
    if root.tag == "calibration":
        sides = root.findtext("width"), root.findtext("height")
        if root.find("f") is None or None in sides:
            raise ValueError("it has no f, width or height; older Agisoft lenses (fx, fy) are not supported")
        size = int(sides[0] or 0), int(sides[1] or 0)
        return [_agisoft("lens", metashape.calibrated_lens(root, root.findtext("projection") or "frame", size, "lens"))]
    sensors = root.findall("chunk/sensors/sensor") if root.tag == "document" else root.findall("sensors/sensor")
    calibrated = [sensor for sensor in sensors if sensor.find("calibration") is not None]
    if not calibrated:
        raise ValueError("it is neither an OpenCV FileStorage nor a lens or cameras of Agisoft")
    return [
        _agisoft(sensor.get("label") or f"sensor {i}", metashape.sensor_lens(sensor))
        for i, sensor in enumerate(calibrated)
    ]


def _agisoft(name: str, lens: metashape.SensorLens) -> Calibration:
    k, p = tuple(map(float, lens.distortion)), (0.0, 0.0)
    if lens.model == "OPENCV_FISHEYE":
        return Calibration(name, _AGISOFT, lens.size, lens.K, fisheye=True, k=k)
    k, p = k[:2], (k[2], k[3])
    return Calibration(name, _AGISOFT, lens.size, lens.K, k=k, p=p, error=lens.error)


def _is_nerfstudio(document: Any) -> bool:
    return isinstance(document, dict) and any(key in document for key in ("frames", "fl_x", "camera_angle_x"))


def _nerfstudio(document: dict[str, Any]) -> list[Calibration]:
    found = []
    for name, lens in nerfstudio.lenses_of(document).items():
        fisheye, values = lens.model == "OPENCV_FISHEYE", lens.distortion
        k, p = (values, (0.0, 0.0)) if fisheye or not values else (values[:2], (values[2], values[3]))
        found.append(Calibration(name, "nerfstudio", lens.size, lens.K, fisheye=fisheye, k=k, p=p))
    return found


def _distinct(cameras: Iterable[Calibration]) -> Iterable[Calibration]:
    """The first of the cameras that have the same lens; further ones of a name get a number."""
    seen, names = set(), set()
    for camera in cameras:
        key = (camera.size, np.asarray(camera.K).tobytes(), camera.fisheye, camera.k, camera.p, camera.divisor)
        if key in seen:
            continue
        seen.add(key)
        if camera.name in names:
            raise ValueError(f"two of its cameras have the name {camera.name} and different lenses")
        names.add(camera.name)
        yield camera
