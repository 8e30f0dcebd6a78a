"""The lens that settings describe: one camera at the origin, principal point in the middle of the image."""

import torch

from swimm3r.cameras import DISTORTION_PARAMETERS, Cameras
from swimm3r.errors import UsageError
from swimm3r.sfm.settings import LensSettings

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


def check_lens_settings(settings: LensSettings, model: str, width: int) -> None:
    """Raise UsageError where the numbers are not those of a lens of this model in images of this width."""
    names = DISTORTION_PARAMETERS[model]
    if foreign := [k for k in DISTORTION if getattr(settings, k) is not None and k not in names]:
        raise UsageError(
            f"{model} has no {', '.join(foreign)}",
            cause=f"its distortion is {', '.join(names) or 'none'}",
            hint="choose the camera model that the numbers were calibrated with (--camera)",
        )
    if settings.focal is not None and not 0.1 * width < settings.focal < 20 * width:
        raise UsageError(
            f"a focal length of {settings.focal:g} px does not fit images {width} px wide",
            cause="it may be in millimetres, or belong to another image size",
            hint="give it in pixels of the prepared frames: millimetres / sensor width in millimetres * image width",
        )


def lens_of(settings: LensSettings, model: str, width: int, height: int, focal: float, k1: float = 0.0) -> Cameras:
    """A lens of this focal length (pixels) with the distortion that is given; `k1` where that one is not."""
    K = torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]], dtype=torch.float64)
    assumed = {"k1": k1}
    given = {name: getattr(settings, name) for name in DISTORTION_PARAMETERS[model]}
    distortion = [assumed.get(name, 0.0) if value is None else value for name, value in given.items()]
    origin = torch.eye(4, dtype=torch.float64)[None]
    return Cameras(K, torch.tensor([distortion], dtype=torch.float64), origin, width, height, model)
