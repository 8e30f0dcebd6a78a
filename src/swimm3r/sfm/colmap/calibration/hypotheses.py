"""Families of lenses that a clip may have, and the one that holds on frames that it was not fitted to.

Films are squeezed: 4:3 shown as 16:9 and cut, or 16:9 shown as 4:3, has pixels 4/3 or 3/4 times as wide as high. Such a
lens is a radial one in pixels of that shape, with no parameter more than one of square pixels. OPENCV's free fx, fy and
tangential terms follow it, too, but also everything that is no lens: drift, moving things, mismatches.

So each half of the frames, in their order, judges what the other half says. A family's lens is fitted to one half and
held while poses and points of the other half are adjusted; its error there is the mean reprojection error, where
observations that the lens loses, and another family's explains, count as COLMAP's limit of 4 px:

    e = (sum of errors + 4 (N - n)) / N,    n observations kept, N the most that any family keeps

A family later in the list must beat the best before it by a share of its error.
"""

import logging
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from swimm3r.io.colmap.cameras import under_model
from swimm3r.progress import Progress
from swimm3r.sfm.colmap.calibration.adjust import adjusted, settled
from swimm3r.sfm.features.database import FeatureDatabase

if TYPE_CHECKING:
    import pycolmap

_LOST = 4.0  # px, where COLMAP drops observations
_SQUEEZES = (3 / 4, 4 / 3)
_SAME = 1e-6

log = logging.getLogger(__name__)

ModelAdjustment = Callable[["pycolmap.Reconstruction"], "pycolmap.Reconstruction"]
Adjustment = Callable[[FeatureDatabase, "pycolmap.Reconstruction"], "pycolmap.Reconstruction"]


@dataclass(frozen=True)
class LensFamily:
    """The lenses of one of COLMAP's models in pixels of one shape."""

    model: str  # COLMAP's name; SIMPLE_RADIAL where pixels are no squares
    shape: float = 1.0  # width by height of a pixel that the model sees as a square: fy / fx as filmed

    def __str__(self) -> str:
        """The family as messages name it."""
        return self.model if self.shape == 1 else f"{self.model} in pixels of {self.shape:.3g}:1"


def family_of(camera: "pycolmap.Camera") -> LensFamily:
    """The family that a lens is refined in: a squeezed one stays squeezed, any other has the freedom of its model."""
    if camera.model.name == "OPENCV":
        fx, fy, _, _, _, *others = camera.params
        for shape in _SQUEEZES:
            if not any(others) and abs(fy / fx - shape) < _SAME:
                return LensFamily("SIMPLE_RADIAL", shape)
    return LensFamily(camera.model.name)


def squeezed_like(camera: "pycolmap.Camera", model: str) -> list[LensFamily]:
    """The squeezed lenses of a model whose fy / fx is nearer to that of a camera than 1 is."""
    ratio = np.log(camera.focal_length_y / camera.focal_length_x)
    return [LensFamily(model, shape) for shape in _SQUEEZES if abs(ratio - np.log(shape)) < abs(ratio)]


def likeliest(
    store: FeatureDatabase,
    model: "pycolmap.Reconstruction",
    families: Sequence[LensFamily],
    gain: float,
    progress: Progress,
) -> LensFamily:
    """The family whose lenses hold on frames that they were not fitted to; `gain` is the share that a later one needs.

    The first where the frames are too few to tell.
    """
    ids = sorted(model.reg_image_ids())
    halves = [_part(model, half) for half in (ids[: len(ids) // 2], ids[len(ids) // 2 :])]
    judged = []
    for done, family in enumerate(families):
        progress("comparing lenses", done, len(families))
        judged.append([_held_out(store, halves[k], halves[1 - k], family) for k in range(2)])
    progress("comparing lenses", len(families), len(families))
    errors = held_out_errors(judged)
    best = 0
    for k in range(1, len(families)):
        if errors[k] < (1 - gain) * errors[best]:
            best = k
    told = ", ".join(f"{family} {error:.2f} px" for family, error in zip(families, errors, strict=True))
    log.info("error of lenses on frames that they were not fitted to: %s; taken: %s", told, families[best])
    return families[best]


def held_out_errors(judged: "Sequence[Sequence[Kept]]") -> list[float]:
    """The e of each family, over all halves: `judged` has what each keeps of each half."""
    most = [max(kept.observations for kept in half) for half in zip(*judged, strict=True)]
    total = max(sum(most), 1)
    return [
        sum(kept.error * kept.observations + _LOST * (n - kept.observations) for kept, n in zip(own, most, strict=True))
        / total
        for own in judged
    ]


def fitted(
    store: FeatureDatabase, model: "pycolmap.Reconstruction", family: LensFamily, adjust: Adjustment
) -> "pycolmap.Reconstruction":
    """`within_family` of an adjustment that also reads the database, whose keypoints are in the same pixels."""
    if family.shape == 1:
        return adjust(store, model)

    def adjust_stretched(stretched: "pycolmap.Reconstruction") -> "pycolmap.Reconstruction":
        with _stretched(store, stretched.cameras[1], family) as own_store:
            return adjust(own_store, stretched)

    return within_family(model, family, adjust_stretched)


def within_family(
    model: "pycolmap.Reconstruction", family: LensFamily, adjust: ModelAdjustment
) -> "pycolmap.Reconstruction":
    """A model after an adjustment that sees pixels of the family's shape; its lens is of pixels as filmed."""
    if family.shape == 1:
        return adjust(model)
    lens = under_model(model.cameras[1], "OPENCV")
    fx, fy, cx, cy, k = lens.params[:5]
    tall = 1 / family.shape
    stretched = _in_other_rows(model, model, tall)
    focal = float(np.sqrt(fx * fy * tall))
    _set_lens(stretched, family.model, [focal, cx, cy * tall, k], round(lens.height * tall))
    stretched.update_point_3d_errors()
    out = _in_other_rows(adjust(stretched), model, 1.0)
    f, cx, cy, k = out.cameras[1].params  # of SIMPLE_RADIAL
    _set_lens(out, "OPENCV", [f, f * family.shape, cx, cy * family.shape, k, 0, 0, 0], model.cameras[1].height)
    out.update_point_3d_errors()
    return out


@dataclass(frozen=True)
class Kept:
    """Observations that a lens keeps of frames that it was not fitted to."""

    observations: int
    error: float  # mean, px


_NOTHING = Kept(0, 0.0)


def _held_out(
    store: FeatureDatabase, own: "pycolmap.Reconstruction", other: "pycolmap.Reconstruction", family: LensFamily
) -> Kept:
    """Observations of other frames that the lens fitted to some keeps; none where it loses frames."""
    lens = fitted(store, own, family, _free(family)).cameras[1]  # no real one, perhaps: then it errs on other frames
    held = _with_lens(other, lens)
    held = settled(lambda model: adjusted(store, model, lens.model.name), held)
    if held.num_reg_images() < other.num_reg_images():
        return _NOTHING
    return Kept(held.compute_num_observations(), held.compute_mean_reprojection_error())


def _free(family: LensFamily) -> Adjustment:
    """The adjustment of poses, points and a lens of the family until the error stands still."""

    def adjust(store: FeatureDatabase, model: "pycolmap.Reconstruction") -> "pycolmap.Reconstruction":
        return settled(lambda m: adjusted(store, m, family.model, focal=True, distortion=True), model)

    return adjust


def _part(model: "pycolmap.Reconstruction", images: Sequence[int]) -> "pycolmap.Reconstruction":
    """The model of some of its images."""
    import pycolmap

    part = pycolmap.Reconstruction(model)
    for image in set(part.reg_image_ids()) - set(images):
        part.deregister_frame(part.images[image].frame_id)
    return part


def _with_lens(model: "pycolmap.Reconstruction", lens: "pycolmap.Camera") -> "pycolmap.Reconstruction":
    import pycolmap

    out = pycolmap.Reconstruction(model)
    _set_lens(out, lens.model.name, lens.params.tolist(), lens.height)
    return out


def _set_lens(model: "pycolmap.Reconstruction", name: str, params: Sequence[float], height: int) -> None:
    import pycolmap

    camera = model.cameras[1]
    camera.model = getattr(pycolmap.CameraModelId, name)
    camera.params = list(map(float, params))
    camera.height = height


@contextmanager
def _stretched(store: FeatureDatabase, camera: "pycolmap.Camera", family: LensFamily) -> Iterator[FeatureDatabase]:
    """A copy of the database in which a pixel of the family's shape is a square, and the lens that of a camera."""
    with tempfile.TemporaryDirectory(dir=store.path.parent, prefix=".mapping.") as folder:
        own = replace(store, path=Path(folder) / "database.db")
        shutil.copyfile(store.path, own.path)
        with own.open() as database:
            database.update_camera(camera)
            for i in range(1, own.frames + 1):
                keypoints = database.read_keypoints(i)
                keypoints[:, 1] *= 1 / family.shape
                database.update_keypoints(i, keypoints)
        yield own


def _in_other_rows(
    model: "pycolmap.Reconstruction", rows_of: "pycolmap.Reconstruction", factor: float
) -> "pycolmap.Reconstruction":
    """The model with the keypoints of another one, their rows times a factor."""
    import pycolmap

    out = pycolmap.Reconstruction(model)
    for i, image in out.images.items():
        for point, same in zip(image.points2D, rows_of.images[i].points2D, strict=True):
            point.xy = same.xy * (1.0, factor)
    return out
