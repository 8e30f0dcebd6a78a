"""The lens that settings describe: one camera at the origin, in pixels of the prepared frames.

The principal point is in the middle of the image unless it is given. A lens that is known in air becomes the central
one of its port (`swimm3r.refraction.central`).
"""

import logging
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import torch

from swimm3r.cameras import DISTORTION_PARAMETERS, Cameras
from swimm3r.errors import UsageError
from swimm3r.io.calibration.read import read_calibration, read_lens
from swimm3r.io.calibration.record import CalibratedLens, lens_at
from swimm3r.io.calibration.run import calibration_of_run, run_with_lens
from swimm3r.refraction.central import CameraInWater, camera_in_water
from swimm3r.refraction.ports import port_of
from swimm3r.sfm.rectified.run import run_rectification
from swimm3r.sfm.settings import (
    LENS_NUMBERS,
    ColmapModelSettings,
    ColmapSettings,
    LensSettings,
    Mast3rSettings,
    SfmSettings,
)

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")

_SPECIAL_CASES = {  # of a model, those that it has with zeros
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("PINHOLE",),
    "OPENCV": ("PINHOLE", "SIMPLE_RADIAL"),
    "OPENCV_FISHEYE": (),
}

_TOLD = (0.5, 1.0, 2.0, 5.0)  # m from the port

log = logging.getLogger(__name__)

Given = TypeVar("Given", bound=ColmapSettings | Mast3rSettings)


def check_calibration(settings: LensSettings) -> None:
    """Raise InputError or UsageError where the calibration file or the run that the settings name cannot be used, and
    UsageError where parts of a lens are given without the whole.
    """
    _check_whole(settings)
    if settings.calibration is not None:
        read_calibration(settings.calibration, settings.calibration_camera, settings.calibration_size)
    if settings.lens_from is not None:
        calibration_of_run(settings.lens_from)


def with_calibration(settings: Given, width: int, height: int, stated: Path | None = None) -> Given:
    """The settings with the numbers of their calibration file or run, in pixels of frames of this size, in its place.

    Settings without a lens take the one of the file that the frames' source states. The lens of a run is held. Raises
    InputError where the file or run cannot be used or is of images of another shape, and UsageError where the settings
    ask for another camera model.
    """
    _check_whole(settings)
    path = settings.lens_from or (settings.calibration if gives_lens(settings) else stated)
    if path is None:
        return settings
    read = _read(path, settings, width, height)
    lens = read.camera
    model = _chosen_model(settings, lens.model)
    (fx, _, cx), (_, fy, cy), _ = lens.K[0].tolist()
    found = dict(zip(DISTORTION_PARAMETERS[lens.model], lens.distortion[0].tolist(), strict=True))
    numbers = {name: found.get(name, 0.0) for name in DISTORTION_PARAMETERS[model]}
    said = ", ".join(f"{name} {value:.6g}" for name, value in numbers.items())
    log.info(
        "lens of %s in frames of %dx%d: %s, fx %.2f, fy %.2f, cx %.2f, cy %.2f px%s%s",
        *(path, width, height, model, fx, fy, cx, cy, f", {said}" if said else ""),
        f"; within {read.error:.2g} px of the file's" if read.error > 1e-6 else "",
    )
    blank = dict.fromkeys(("calibration", "calibration_camera", "calibration_size", "lens_from"))
    changed = replace(settings, **blank, focal=fx, fy=fy, cx=cx, cy=cy, **numbers)
    if settings.lens_from is not None and isinstance(changed, ColmapSettings):
        changed = replace(changed, intrinsics="fixed")
    undecided = isinstance(settings, ColmapSettings) and model != "OPENCV_FISHEYE"  # auto goes by the numbers
    return changed if undecided else replace(changed, camera=model)


def _read(path: Path, settings: LensSettings, width: int, height: int) -> CalibratedLens:
    if settings.lens_from is not None:
        return lens_at(calibration_of_run(path), width, height)
    return read_lens(path, width, height, settings.calibration_camera, settings.calibration_size)


def known_lens(settings: SfmSettings, width: int, height: int, stated: Path | None = None) -> Cameras | None:
    """The lens in water of frames of this size, by the settings or the file that their source states; None unknown.

    Raises InputError and UsageError as `with_calibration` and `behind_port` do.
    """
    if isinstance(settings, ColmapModelSettings):  # its model has lenses of its own
        return None
    if settings.lens_from is not None and run_rectification(run_with_lens(settings.lens_from)) is not None:
        return None  # that of rectified frames
    found, _ = behind_port(with_calibration(settings, width, height, stated), width, height)
    if found.focal is None:
        return None
    model = model_of(found)
    check_lens_settings(found, model, width, height)
    return lens_of(found, model, width, height, found.focal)


def gives_lens(settings: LensSettings) -> bool:
    """Return whether the settings themselves say something of the lens."""
    files = settings.calibration, settings.lens_from
    return any(part is not None for part in (*files, *(getattr(settings, name) for name in LENS_NUMBERS)))


def behind_port(settings: Given, width: int, height: int) -> tuple[Given, CameraInWater | None]:
    """The settings with the lens that a known one in air becomes behind its port, and this lens; unchanged without.

    Raises UsageError where the numbers are not those of a lens, or its light does not get through the port.
    """
    port = port_of(settings.housing, settings.port)
    if port is None or settings.focal is None:
        return settings, None
    model = model_of(settings)
    check_lens_settings(settings, model, width, height)
    try:
        housed = camera_in_water(lens_of(settings, model, width, height, settings.focal), port, settings.port.range)
    except ValueError as error:
        raise UsageError(
            f"there is no image through this {settings.housing} port: {error}",
            cause="the dome is small or far ahead of the lens, or the lens in air has another focal length",
            hint="check --port.distance and --port.radius, in meters, and --focal, in pixels of the prepared frames",
        ) from error
    lens = housed.central
    (fx, _, cx), (_, fy, cy), _ = lens.K[0].tolist()
    numbers = dict(zip(DISTORTION_PARAMETERS[lens.model], lens.distortion[0].tolist(), strict=True))
    log.info(
        "central lens behind the %s port: %s, fx %.2f, fy %.2f px, %s; its error is %s",
        *(settings.housing, lens.model, fx, fy, ", ".join(f"{name} {value:.4g}" for name, value in numbers.items())),
        ", ".join(f"{e.rms:.2g} px at {e.distance:g} m" for e in housed.errors(torch.tensor(_TOLD))),
    )
    return replace(settings, camera=lens.model, focal=fx, fy=fy, cx=cx, cy=cy, **numbers), housed


def at_scale(settings: ColmapSettings, width: int, height: int, scale: float) -> ColmapSettings:
    """The settings of frames of this size for frames that are enlarged by a factor: a lens in their pixels."""
    if scale == 1:
        return settings
    cx, cy = (half if own is None else own for own, half in ((settings.cx, width / 2), (settings.cy, height / 2)))
    focal, fy = (None if f is None else f * scale for f in (settings.focal, settings.fy))
    return replace(settings, focal=focal, fy=fy, cx=cx * scale, cy=cy * scale)


def model_of(settings: ColmapSettings | Mast3rSettings) -> str:
    """The camera model of the lens that settings begin with."""
    if settings.camera != "auto":
        return settings.camera
    return "SIMPLE_RADIAL" if settings.k2 is settings.p1 is settings.p2 is None else "OPENCV"


def _check_whole(settings: LensSettings) -> None:
    beside = [name for name in ("calibration_camera", "calibration_size") if getattr(settings, name) is not None]
    if settings.calibration is None and beside:
        raise UsageError(
            f"--{beside[0].replace('_', '-')} needs --calibration FILE",
            cause="it says how a calibration file is read, and none was given",
            hint="add --calibration FILE, or leave it out",
        )
    alone = [name for name in ("fy", "cx", "cy") if getattr(settings, name) is not None]
    if settings.focal is None and alone:
        raise UsageError(
            f"--{alone[0]} needs --focal",
            cause="a principal point and a second focal length say little without the first",
            hint="add --focal, in pixels of the prepared frames",
        )


def _chosen_model(settings: ColmapSettings | Mast3rSettings, model: str) -> str:
    """The camera model under which a lens of this one is written."""
    asked = settings.camera
    if asked in ("auto", "PINHOLE", model):
        return "SIMPLE_RADIAL" if isinstance(settings, ColmapSettings) and model == "PINHOLE" else model
    if model in _SPECIAL_CASES[asked]:
        return asked
    raise UsageError(
        f"the calibration is of a lens of the model {model}, and --camera says {asked}",
        cause="the file decides the model of its lens",
        hint="leave out --camera; or --no-camera-info, where the lens is that of a bag",
    )


def check_lens_settings(settings: LensSettings, model: str, width: int, height: int) -> None:
    """Raise UsageError where the numbers are not those of a lens of this model in images of this size."""
    names = DISTORTION_PARAMETERS[model]
    if foreign := [k for k in DISTORTION if getattr(settings, k) is not None and k not in names]:
        raise UsageError(
            f"{model} has no {', '.join(foreign)}",
            cause=f"its distortion is {', '.join(names) or 'none'}",
            hint="choose the camera model that the numbers were calibrated with (--camera)",
        )
    focal = next((f for f in (settings.focal, settings.fy) if f is not None and not 0.1 * width < f < 20 * width), None)
    if focal is not None:
        raise UsageError(
            f"a focal length of {focal:g} px does not fit images {width} px wide",
            cause="it may be in millimetres, or belong to another image size",
            hint="give it in pixels of the prepared frames: millimetres / sensor width in millimetres * image width",
        )
    cx, cy = settings.cx, settings.cy
    if (cx is not None and cx >= width) or (cy is not None and cy >= height):
        raise UsageError(
            f"a principal point at ({'middle' if cx is None else cx}, {'middle' if cy is None else cy}) is outside"
            f" images of {width}x{height}",
            cause="it may belong to another image size",
            hint="give it in pixels of the prepared frames, from the upper left corner",
        )


def lens_of(settings: LensSettings, model: str, width: int, height: int, focal: float, k1: float = 0.0) -> Cameras:
    """A lens of this focal length (pixels) with the distortion that is given; `k1` where that one is not."""
    tall = 1.0 if settings.fy is None or settings.focal is None else settings.fy / settings.focal
    cx, cy = (half if own is None else own for own, half in ((settings.cx, width / 2), (settings.cy, height / 2)))
    K = torch.tensor([[[focal, 0, cx], [0, focal * tall, cy], [0, 0, 1]]], dtype=torch.float64)
    assumed = {"k1": k1}
    given = {name: getattr(settings, name) for name in DISTORTION_PARAMETERS[model]}
    distortion = [assumed.get(name, 0.0) if value is None else value for name, value in given.items()]
    origin = torch.eye(4, dtype=torch.float64)[None]
    return Cameras(K, torch.tensor([distortion], dtype=torch.float64), origin, width, height, model)
