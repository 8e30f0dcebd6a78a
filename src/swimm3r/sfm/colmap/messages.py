"""Warnings and errors of mapping, for users."""

from swimm3r.errors import RegistrationError
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import QualityWarning
from swimm3r.sfm.colmap.plausibility import FOCAL_BOUNDS
from swimm3r.sfm.colmap.record import PARTS
from swimm3r.sfm.settings import ColmapSettings

LOST_SCALE = 1000.0  # change of the frames' median depth beyond which nothing of a model is right


def registration_warnings(placed: int, sizes: list[int], frames: Frames) -> list[QualityWarning]:
    """Warnings of frames left out; `sizes` are those of all models that were kept, the largest first."""
    if placed == len(frames):
        return []
    left = len(frames) - placed
    others = [size for size in sizes[1:] if size >= 3]
    if others:
        parts = " + ".join(str(size) for size in (placed, *others))
        return [
            QualityWarning(
                f"The frames fall into parts that did not join ({parts} of {len(frames)}); only the largest is used;"
                f" the others are COLMAP models in sfm/{PARTS}.",
                "Record lines that overlap by half, cross them with one line, and keep a slow turn between them; "
                "a higher --fps helps where the parts follow each other.",
            )
        ]
    return [
        QualityWarning(
            f"{left} of {len(frames)} frames could not be placed and are left out.",
            "They are blurred, show open water, or overlap too little with the rest: raise --fps, or swim slower.",
        )
    ]


def assumed_lens(focal: float) -> QualityWarning:
    """The warning of a lens that the images do not determine; its focal length in pixels."""
    return QualityWarning(
        f"The lens could not be calibrated from this clip; {focal:.0f} px was assumed as its focal length.",
        "Shapes may be stretched in depth. Give --focal and --k1 of the camera, calibrated in water.",
    )


def unknown_port() -> QualityWarning:
    """The warning of a flat port before a lens that is not known in air."""
    return QualityWarning(
        "The refraction at the flat port is not modeled, as the lens in air is unknown; the focal length and"
        " radial distortion found in water stand for it.",
        "Give --focal or --calibration of the lens in air, and --port.distance and --port.thickness.",
    )


def too_few(placed: int, frames: Frames, settings: ColmapSettings) -> RegistrationError:
    """The error of a model that holds too small a share of the frames."""
    what = f"only {placed} of {len(frames)} frames could be placed relative to each other" + (
        ", and on too few points to be trusted" if placed > settings.mapping.min_share * len(frames) else ""
    )
    low, high = (share * frames.width for share in FOCAL_BOUNDS)
    if settings.focal is None or settings.camera == "OPENCV_FISHEYE" or low <= settings.focal <= high:
        return _not_placed(what)
    return RegistrationError(
        what,
        cause=f"the given focal length, {settings.focal:.0f} px in frames {frames.width} px wide, is that of no common"
        f" lens ({low:.0f} to {high:.0f} px): the calibration failed, or was made at another image size",
        hint="leave out --calibration or --focal, which estimates the lens; of a bag, --no-camera-info",
    )


def lens_not_told(frames: Frames) -> RegistrationError:
    """The error of frames that overlap in pairs alone, none of which can be placed while their lens is open."""
    seen = "" if len(frames) == 2 else ", and hardly any feature is seen in three"
    return RegistrationError(
        f"none of {len(frames)} frames could be placed: they cannot tell the lens, which is not held",
        cause=f"two frames fit any lens{seen}; placed under a guess, they may be many degrees off",
        hint="hold a lens that is known: --lens-from RUN, or --calibration or --focal (and --k1) with --intrinsics "
        "fixed; or give more frames, so that most of the ground is seen in three or more (a higher --fps)",
    )


def scale_lost(placed: int, frames: int) -> RegistrationError:
    """The error of a model whose depths contradict each other beyond all measure."""
    return _not_placed(
        f"{placed} of {frames} frames were placed, but not in one scale: the same scene is more than"
        f" {LOST_SCALE:,.0f} times as far in one frame as in another"
    )


def _not_placed(what: str) -> RegistrationError:
    return RegistrationError(
        what,
        cause="the frames share too little that stands still: open water, moving animals or divers fill the view, "
        "visibility is too poor, or the camera moved too fast or only turned",
        hint="film reef, rock or wreck slowly, from several sides, with 60 % overlap and within 3 m; "
        "mask out what moves (--masks); give a part of the clip where the bottom is in view; or raise --fps",
    )
