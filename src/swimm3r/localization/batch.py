"""Many images placed in the map of a finished run, and the record of it.

OUT/poses.json       per image: its pose and what speaks for it, or why it could not be placed
OUT/poses.tum        timestamp tx ty tz qx qy qz qw, camera to world, of the images that were placed
OUT/matches/NAME.png the query beside the rendering, a line per inlier
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from swimm3r import devices
from swimm3r.cameras import Cameras, cameras_of
from swimm3r.errors import InputError, RegistrationError
from swimm3r.imaging.rectification import Rectification
from swimm3r.io import cameras_json, images
from swimm3r.io.files.atomic import write_text
from swimm3r.io.image_header import read_header
from swimm3r.io.trajectory import write_tum
from swimm3r.localization.lenses import has_several_lenses, lens_of_camera, unnamed_camera
from swimm3r.localization.localizer import STAGES, Evidence, Localization, Localizer
from swimm3r.localization.settings import LocalizationSettings
from swimm3r.progress import Progress, silent
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.run_folder import open_run
from swimm3r.sfm.rectified.run import run_frames, run_rectification
from swimm3r.splat.map_file import load_map
from swimm3r.splat.settings import MapDevice

_LINES = 60  # inliers drawn, spread over all of them


@dataclass(frozen=True)
class Query:
    """One image that asks where it was taken."""

    name: str
    time: float  # seconds; the number of the image where it has none
    image: Float[Tensor, "h w 3"]
    mask: Bool[Tensor, "h w"] | None = None
    clip_time: float | None = None  # seconds of the map's clip, where the image is part of it
    frame: str | None = None  # its name there


@dataclass(frozen=True)
class Answer:
    """The result of a query."""

    name: str
    time: float
    found: Localization | None
    reason: str = ""  # why nothing was found


def localize_run(
    folder: Path,
    image_files: Sequence[Path] = (),
    lens: Path | None = None,
    out: Path | None = None,
    settings: LocalizationSettings | None = None,
    progress: Progress = silent,
    *,
    map_device: MapDevice = "auto",
    rig_camera: str | None = None,
) -> tuple[list[Answer], Path]:
    """Places images, by default the run's test frames, in the run's map; the record goes to `out`.

    Poses are in the axes and unit of RUN/sfm. `rig_camera` is the one of the run's rig that took the images. Answers
    come without evidence, which the match images show.

    Raises InputError where the run has no map, an image cannot be read or is of another shape than its lens, or a rig
    has several lenses and `rig_camera` is not given, UsageError where the rig has no such camera, RegistrationError
    where not one image could be placed.
    """
    own = None if lens is None else cameras_of(cameras_json.read_cameras(lens))[0]
    _check_files(image_files)
    open_run(folder, "splat")
    frames = run_frames(folder)
    names = [path.name for path in image_files] or list(frames.test.names)
    if not names:
        raise InputError(
            f"the run in {folder} has no test frames to place",
            cause="stills that overlap by half or less are all needed for the map: none is held back",
            hint=f"images of the place: swimm3r localize {folder} IMAGE",
        )
    rec = load_reconstruction(folder / "sfm", frames)
    own = own if rig_camera is None else lens_of_camera(rec, frames, rig_camera)
    if image_files and own is None and has_several_lenses(rec, frames):
        raise unnamed_camera()
    scene = load_map(folder / "splat" / "map.safetensors").to(devices.for_maps(map_device))
    localizer = Localizer(scene, rec, rec.still(frames), settings, progress=progress)
    out = out or folder / "localization"
    rectification = run_rectification(folder) if lens is None else None
    answers = []
    for i, name in enumerate(names):
        progress("localizing", i, len(names))
        if image_files:
            query = Query(name, float(i), _image(image_files[i], rectification))
        else:
            f = frames.index(name)
            time = frames.frames[f].time
            query = Query(name, time, frames.image(f), frames.mask(f), time, name)
        answers.append(with_match_image(_in_axes_of_sfm(answer(localizer, query, own), localizer), out))
        _write(out, answers, localizer.matcher.name, rec.metric)
    progress("localizing", len(names), len(names))
    if all(a.found is None for a in answers):
        raise RegistrationError(
            f"none of the {len(answers)} images could be placed in the map",
            cause="they show other places than the map, or it was made in very different water",
            hint="images from nearer to the dive's path",
        )
    return answers, out


def _check_files(paths: Sequence[Path]) -> None:
    """Raises InputError where an image cannot be read, or two have one name: before minutes of matching."""
    for path in paths:
        read_header(path)
    if len({path.name for path in paths}) < len(paths):
        raise InputError(
            "two of the images have the same name",
            cause="they lie in different folders",
            hint="one folder at a time, each with its own --out",
        )


def answer(localizer: Localizer, query: Query, lens: Cameras | None = None) -> Answer:
    """The query's place, or the reason why none was found. Raises InputError that names an image of another shape."""
    try:
        found = localizer.locate(query.image, query.mask, lens, query.clip_time, query.frame)
        return Answer(query.name, query.time, found)
    except RegistrationError as failure:
        return Answer(query.name, query.time, None, failure.what)
    except InputError as error:
        raise InputError(f"{query.name}: {error.what}", cause=error.cause, hint=error.hint) from error


def with_match_image(a: Answer, out: Path) -> Answer:
    """The answer without its evidence, which OUT/matches/NAME.png shows; one of an earlier call goes."""
    path = out / "matches" / f"{a.name}.png"
    if a.found is None or a.found.evidence is None:
        path.unlink(missing_ok=True)
        return a
    images.write_rgb(path, match_image(a.found.evidence))
    return replace(a, found=replace(a.found, evidence=None))


def match_image(evidence: Evidence) -> UInt8[np.ndarray, "h w2 3"]:
    """Query and rendering side by side, with inliers joined."""
    import cv2

    both = torch.cat([evidence.query, evidence.rendering], 1).clamp(0, 1)
    canvas = np.ascontiguousarray((both * 255).round().to(torch.uint8).numpy())
    width = evidence.query.shape[1]
    inliers = evidence.inlier.nonzero()[:, 0]
    for k in inliers[:: max(1, len(inliers) // _LINES)].tolist():
        left = [round(float(v)) for v in evidence.xy_query[k]]
        right = [round(float(v)) for v in evidence.xy_rendering[k]]
        cv2.line(canvas, left, (right[0] + width, right[1]), (255, 220, 60), 1, cv2.LINE_AA)
    return canvas


def _in_axes_of_sfm(a: Answer, localizer: Localizer) -> Answer:
    if a.found is None:
        return a
    return replace(a, found=replace(a.found, cam2world=localizer.in_axes_of_sfm(a.found.cam2world)))


def _image(path: Path, rectification: Rectification | None) -> Float[Tensor, "h w 3"]:
    stored = images.read_rgb(path)
    if rectification is not None:
        stored = rectification.any_image(stored)
    return torch.from_numpy(stored.astype(np.float32) / np.iinfo(stored.dtype).max)


def _write(out: Path, answers: Sequence[Answer], matcher: str, metric: bool) -> None:
    placed = [(a, a.found) for a in answers if a.found is not None]
    document = {
        "matcher": matcher,
        "unit": "metres" if metric else "scene units",
        "convention": "OpenCV camera axes, camera-to-world",
        "located": len(placed),
        "seconds": {stage: sum(found.seconds[stage] for _, found in placed) / max(1, len(placed)) for stage in STAGES},
        "images": [_described(a) for a in answers],
    }
    write_text(out / "poses.json", json.dumps(document, indent=1) + "\n")
    poses = np.stack([found.cam2world.numpy() for _, found in placed]) if placed else np.empty((0, 4, 4))
    write_tum(out / "poses.tum", [a.time for a, _ in placed], poses)


def _described(a: Answer) -> dict[str, object]:
    if a.found is None:
        return {"name": a.name, "time": a.time, "c2w": None, "reason": a.reason}
    return {
        "name": a.name,
        "time": a.time,
        "c2w": a.found.cam2world.tolist(),
        "stage": a.found.stage,
        "candidates": list(a.found.candidates),
        "coarse_inliers": a.found.coarse_inliers,
        "matches": a.found.matches,
        "inliers": a.found.inliers,
        "reprojection_px": a.found.reprojection_px,
        "seconds": a.found.seconds,
        **({} if a.found.turn is None else {"turn": a.found.turn.tolist()}),
    }
