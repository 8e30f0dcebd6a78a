"""Agisoft Metashape's cameras.xml (File > Export > Export Cameras).

Camera axes and pixel centers are ours; cx and cy count from the image's center; p1 and p2 are OpenCV's p2 and p1:

    x' = x (1 + k1 r^2 + ... + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y,    u = w/2 + cx + x' (f + b1) + y' b2
    y' = y (...)                       + p2 (r^2 + 2 y^2) + 2 p1 x y,    v = h/2 + cy + y' f

Poses are in the chunk's inner unit; the scale of its transform, or of the camera's component, makes them metres. Place
and orientation on the globe are left out: coordinates of millions of metres would cost the points their millimetres.
"""

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from swimm3r.io.imports.opencv_fit import nearest_opencv, radial
from swimm3r.io.imports.record import ForeignModel, one_size, without_points

_NAMES = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")


def read(path: Path) -> ForeignModel:
    """Poses, lens and scale of the placed cameras of the first chunk. Raises ValueError for a file that is not one."""
    try:
        chunk = ET.fromstring(path.read_bytes()).find("chunk")
    except ET.ParseError as error:
        raise ValueError(str(error)) from error
    if chunk is None:
        raise ValueError("it holds no Metashape chunk")
    sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    scales = {part.get("id"): _scale(part) for part in chunk.iterfind("components/component")}
    whole = _scale(chunk)
    names, K, distortion, poses, sizes, kinds, metric = [], [], [], [], set(), set(), True
    for camera in chunk.iterfind("cameras//camera"):
        transform = camera.findtext("transform")
        if transform is None:  # not placed
            continue
        label, sensor = camera.get("label") or "", sensors.get(camera.get("sensor_id"))
        if sensor is None:
            raise ValueError(f"the camera {label} has a sensor that is not in it")
        lens = sensor_lens(sensor)
        scale = whole if whole is not None else scales.get(camera.get("component_id"))
        pose = np.array(transform.split(), np.float64).reshape(4, 4)
        pose[:3, 3] *= 1.0 if scale is None else scale
        metric = metric and scale is not None
        names.append(PurePosixPath(label.replace("\\", "/")).name)
        K.append(lens.K)
        distortion.append(lens.distortion)
        poses.append(pose)
        sizes.add(lens.size)
        kinds.add(lens.model)
    if not names:
        raise ValueError("no camera in it has been placed")
    if len(kinds) > 1:
        raise ValueError("it mixes frame and fisheye sensors")
    model = without_points(
        tuple(names), kinds.pop(), one_size(sizes), np.stack(K), np.stack(distortion), np.stack(poses)
    )
    return ForeignModel("Metashape", model, metric=metric)


def _scale(element: ET.Element) -> float | None:
    text = element.findtext("transform/scale")
    scale = None if text is None else _number(text)
    if scale is not None and scale <= 0:
        raise ValueError(f"its scale is {scale:g}")
    return scale


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"it has {text} where a finite number is expected")
    return value


@dataclass(frozen=True)
class SensorLens:
    """The lens of a sensor."""

    model: str
    size: tuple[int, int]
    K: np.ndarray
    distortion: np.ndarray
    error: float = 0.0  # pixels that it is from the file's lens, at most


def sensor_lens(sensor: ET.Element) -> SensorLens:
    """The adjusted lens of a sensor, else the one that it began with. Raises ValueError where it has none."""
    calibrations = sensor.findall("calibration")
    adjusted = [c for c in calibrations if c.get("class") == "adjusted"]
    if not calibrations:
        raise ValueError(f"the sensor {sensor.get('label')} was not calibrated")
    calibration = (adjusted or calibrations)[0]
    resolution = calibration.find("resolution")
    if resolution is None:
        raise ValueError("a calibration has no resolution")
    size = int(resolution.attrib["width"]), int(resolution.attrib["height"])
    return calibrated_lens(
        calibration, calibration.get("type", sensor.get("type", "frame")), size, sensor.get("label") or ""
    )


def calibrated_lens(calibration: ET.Element, kind: str, size: tuple[int, int], label: str) -> SensorLens:
    """The lens that the elements f, cx, cy, b1, b2, k1 to k4, p1 and p2 describe.

    Raises ValueError, and InputError where it is more than half a pixel away from any that is supported.
    """
    width, height = size
    value = {name: _number(calibration.findtext(name) or "0") for name in _NAMES}
    K = np.array(
        [[value["f"] + value["b1"], 0, width / 2 + value["cx"]], [0, value["f"], height / 2 + value["cy"]], [0, 0, 1]]
    )
    if not min(K[0, 0], K[1, 1]) > 0:
        raise ValueError(f"the sensor {label} has a focal length of {value['f']:g} px")
    k = tuple(value[f"k{i}"] for i in (1, 2, 3, 4))
    p1, p2, skew = value["p1"], value["p2"], value["b2"] / K[0, 0]
    if kind in ("fisheye", "equidistant_fisheye"):
        if p1 or p2 or skew:
            raise ValueError("its fisheye lens has tangential distortion or skew, which no supported lens has")
        return SensorLens("OPENCV_FISHEYE", size, K, np.array(k))
    if kind != "frame":
        raise ValueError(f"its sensor is of type {kind}; supported are frame and fisheye")

    def distort(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r2 = x * x + y * y
        dx = x * radial(k, r2) + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
        dy = y * radial(k, r2) + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
        return dx + skew * dy, dy

    fit = nearest_opencv(distort, K, width, height)
    return SensorLens("OPENCV", size, K, fit.distortion, fit.error)
