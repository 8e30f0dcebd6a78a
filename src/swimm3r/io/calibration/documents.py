"""Calibrations in YAML and XML documents: Kalibr's camchain, ROS's camera_info, OpenCV's FileStorage.

All three count pixels and order coefficients as OpenCV does (`models.of_opencv`). A FileStorage is a mapping of names
that every program chooses; the names below are those of OpenCV's own samples and of the calibration tools around it.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml

from swimm3r.io.calibration.models import of_opencv, unknown_model
from swimm3r.io.calibration.record import Calibration

_KALIBR, _ROS, _OPENCV = "Kalibr", "ROS camera_info", "OpenCV FileStorage"
_MATRIX = ("camera_matrix", "cameramatrix", "k", "m", "mtx", "intrinsic_matrix", "intrinsics", "intrinsic")
_DISTORTION = (
    *("distortion_coefficients", "dist_coeffs", "distcoeffs", "dist_coeff", "distortion_coeffs", "distortion"),
    *("d", "dist"),
)
_WIDTH, _HEIGHT, _SIZE = ("image_width", "width"), ("image_height", "height"), ("image_size", "imagesize", "size")
_SUFFIX = re.compile(r"(?:_?([12]|left|right|l|r))?", re.IGNORECASE)


class _Loader(yaml.SafeLoader):
    """YAML with OpenCV's matrices, which are mappings of rows, cols and data."""


def _matrix_mapping(loader: _Loader, node: yaml.Node) -> dict:
    if not isinstance(node, yaml.MappingNode):
        raise ValueError("a matrix in it is no mapping of rows, cols and data")
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix_mapping)


def from_yaml(text: str) -> Mapping[str, Any]:
    """The mapping of the first document of a YAML file. Raises ValueError."""
    text = re.sub(r"\A\s*%YAML:?\s*[\d.]+\s*\n", "", text)  # OpenCV's is no directive that YAML knows
    try:
        documents = [document for document in yaml.load_all(text, _Loader) if document is not None]
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f" in line {mark.line + 1}"
        raise ValueError(f"it is no YAML{where}: {getattr(error, 'problem', None) or 'wrong syntax'}") from error
    if not documents or not isinstance(documents[0], dict):
        raise ValueError("it holds no calibration that is known")
    return documents[0]


def from_opencv_xml(root: ET.Element) -> dict[str, Any]:
    """The mapping of an OpenCV FileStorage in XML; matrices as mappings of rows, cols and data."""
    found: dict[str, Any] = {}
    for element in root:
        if element.get("type_id") == "opencv-matrix":
            found[element.tag] = {
                "rows": int(element.findtext("rows") or 0),
                "cols": int(element.findtext("cols") or 0),
                "data": (element.findtext("data") or "").split(),
            }
        else:
            words = (element.text or "").split()
            found[element.tag] = words[0] if len(words) == 1 else words
    return found


def read_document(document: Mapping[str, Any]) -> list[Calibration]:
    """The cameras of a document. Raises InputError for unknown models, ValueError for anything else."""
    cameras = {
        name: camera
        for name, camera in document.items()
        if isinstance(camera, dict) and "intrinsics" in camera and "camera_model" in camera
    }
    if cameras:
        return [_kalibr(str(name), camera) for name, camera in cameras.items()]
    return _matrices(document)


def _kalibr(name: str, camera: Mapping[str, Any]) -> Calibration:
    model = str(camera["camera_model"])
    distortion = str(camera.get("distortion_model", "none"))
    if model != "pinhole":
        raise unknown_model(name, model, _KALIBR)
    intrinsics = _numbers(camera["intrinsics"], f"the intrinsics of {name}")
    if len(intrinsics) != 4:
        raise ValueError(f"{name} has {len(intrinsics)} intrinsics, and fu, fv, pu, pv are expected")
    fx, fy, cx, cy = intrinsics
    given = [] if distortion == "none" else camera["distortion_coeffs"]
    coefficients = _numbers(given, f"the distortion of {name}")
    size = _pair(camera["resolution"], f"the resolution of {name}") if "resolution" in camera else None
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return of_opencv(name, _KALIBR, size, K, distortion, coefficients)


def _matrices(document: Mapping[str, Any]) -> list[Calibration]:
    """The cameras of camera_info or of a FileStorage: one, or those whose names end in a number or a side."""
    values = {str(name).lower(): value for name, value in document.items()}
    ros = "distortion_model" in values
    size = _size(values)
    if any(_in(values, "roi", side) for side in ("width", "height", "x_offset", "y_offset")):
        raise ValueError("it is of a part of the image (roi), which is not supported")
    found = []
    for name, value in values.items():
        suffix = _suffix(name, _MATRIX)
        if suffix is None:
            continue
        K = _matrix(value, f"the camera matrix {name}")
        given = next((other for other in values if _suffix(other, _DISTORTION) == suffix), None)
        if given is None:
            raise ValueError(f"there are no distortion coefficients beside {name}; a lens without has zeros there")
        coefficients = _numbers(_data(values[given]), f"the distortion {given}")
        model = str(values["distortion_model"]) if ros else _opencv_model(values)
        camera = str(values.get("camera_name") or suffix or "camera")
        found.append(of_opencv(camera, _ROS if ros else _OPENCV, size, K, model, coefficients))
    if not found:
        raise ValueError("it has no camera matrix under a name that is known (camera_matrix, K, M1 ...)")
    return found


def _opencv_model(values: Mapping[str, Any]) -> str | None:
    """The model that OpenCV's calibration sample and others name; None where the coefficients tell it."""
    if str(values.get("fisheye_model", "0")).lower() in ("1", "true"):
        return "fisheye"
    named = values.get("camera_model", values.get("model"))
    return None if named is None or str(named).lower() in ("pinhole", "standard") else str(named)


def _suffix(name: str, stems: tuple[str, ...]) -> str | None:
    """ "" or the number or side that follows one of the stems; None for another name."""
    for stem in stems:
        rest = _SUFFIX.fullmatch(name.removeprefix(stem)) if name.startswith(stem) else None
        if rest is not None:
            return rest.group(1) or ""
    return None


def _size(values: Mapping[str, Any]) -> tuple[int, int] | None:
    for width, height in zip(_WIDTH, _HEIGHT, strict=True):
        if width in values and height in values:
            return _pair([values[width], values[height]], "its image size")
    named = next((name for name in _SIZE if name in values), None)
    return None if named is None else _pair(_data(values[named]), "its image size")


def _in(values: Mapping[str, Any], group: str, name: str) -> bool:
    inner = values.get(group)
    return isinstance(inner, dict) and bool(inner.get(name))


def _data(value: Any) -> Any:
    return value["data"] if isinstance(value, dict) and "data" in value else value


def _matrix(value: Any, what: str) -> np.ndarray:
    rows = _data(value)
    if isinstance(rows, list) and rows and all(isinstance(row, list) for row in rows):
        rows = [number for row in rows for number in row]
    numbers = _numbers(rows, what)
    if len(numbers) != 9:
        raise ValueError(f"{what} has {len(numbers)} numbers, and 9 are expected")
    return np.array(numbers).reshape(3, 3)


def _numbers(value: Any, what: str) -> list[float]:
    if isinstance(value, list) and len(value) == 1 and isinstance(value[0], list):  # one row of a matrix
        value = value[0]
    if isinstance(value, list) and all(isinstance(row, list) and len(row) == 1 for row in value):  # one column
        value = [row[0] for row in value]
    if not isinstance(value, list):
        raise ValueError(f"{what} is no list of numbers")
    try:
        return [float(number) for number in value]
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what} has something else than numbers") from error


def _pair(value: Any, what: str) -> tuple[int, int]:
    numbers = _numbers(value, what)
    if len(numbers) != 2 or any(number != round(number) for number in numbers if np.isfinite(number)):
        raise ValueError(f"{what} is not two whole numbers")
    if not np.isfinite(numbers).all():
        raise ValueError(f"{what} has a number that is not finite")
    return int(numbers[0]), int(numbers[1])
