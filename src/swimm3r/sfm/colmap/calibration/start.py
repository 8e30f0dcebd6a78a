"""The lens that frames are placed under: what the user knows, what pairs of frames agree on, or a guess.

Also what can be a lens at all.
"""

from typing import TYPE_CHECKING

import torch

from swimm3r.cameras import distort
from swimm3r.errors import UsageError
from swimm3r.io.colmap.cameras import from_pycolmap_camera, to_pycolmap_camera, under_model
from swimm3r.sfm.colmap.calibration.pair_focal import focal_of_pairs
from swimm3r.sfm.features.database import FeatureDatabase
from swimm3r.sfm.lens import check_lens_settings, lens_of, model_of
from swimm3r.sfm.settings import ColmapSettings

if TYPE_CHECKING:
    import pycolmap

_MAX_TANGENTIAL = 0.1  # a lens some 10 degrees askew behind its port, or an image cut off-center by a tenth


def first_camera(width: int, height: int, settings: ColmapSettings) -> "pycolmap.Camera":
    """The lens to begin with: what the user knows, else the first rung of the ladder.

    Raises UsageError where the settings contradict themselves.
    """
    name = model_of(settings)
    check_lens_settings(settings, name, width, height)
    if settings.intrinsics == "fixed" and settings.focal is None:
        raise UsageError(
            "fixed intrinsics need a focal length",
            cause="--intrinsics fixed was given without --focal or --calibration",
            hint="add --calibration, or --focal (and --k1), or leave --intrinsics at prior",
        )
    return ladder(width, height, settings)[0]


def ladder(width: int, height: int, settings: ColmapSettings) -> "list[pycolmap.Camera]":
    """The lenses to try in turn, likelier ones first."""
    name = model_of(settings)
    if settings.focal is not None:
        focals = [settings.focal]
    elif name == "OPENCV_FISHEYE":
        port = settings.port.water if settings.housing == "flat" else 1.0
        focals = [f * width * port for f in (0.45, 0.33, 0.6)]  # 110, 170 and 90 degrees across
    else:
        focals = [f * width for f in settings.mapping.focal_ladder]
        if settings.housing == "flat":
            focals.sort(key=lambda f: abs(f / width - 1.0))  # 0.75 in air is a common lens
    assumed = settings.mapping.k1 if name != "OPENCV_FISHEYE" and settings.focal is None else 0.0
    out = []
    for f in focals:
        camera = to_pycolmap_camera(lens_of(settings, name, width, height, f, assumed))
        camera.has_prior_focal_length = settings.focal is not None or name == "OPENCV_FISHEYE"
        out.append(camera)
    return out


def lenses_to_try(store: FeatureDatabase, settings: ColmapSettings) -> "list[pycolmap.Camera]":
    """The lenses to try in turn, likelier ones first: the database's where that is held, else the ladder."""
    with store.open() as database:
        camera = database.read_camera(1)
    return [camera] if settings.intrinsics == "fixed" else ladder(camera.width, camera.height, settings)


def lenses_of_pairs(store: FeatureDatabase, settings: ColmapSettings) -> "list[pycolmap.Camera]":
    """The likeliest lens with the focal length that the pairs agree on.

    Where they do not, or it is known, `lenses_to_try`.
    """
    likely = lenses_to_try(store, settings)
    focal = None if likely[0].has_prior_focal_length else focal_of_pairs(store)
    if focal is None:
        return likely
    lens = likely[0]
    lens.params = [focal if i in lens.focal_length_idxs() else value for i, value in enumerate(lens.params)]
    return [lens]


def is_lens(camera: "pycolmap.Camera") -> bool:
    """Return whether the intrinsics can belong to a lens: field of view, pixel shape, distortion that grows to the
    corners."""
    name, width, height = camera.model.name, camera.width, camera.height
    fx, fy = camera.focal_length_x, camera.focal_length_y
    if not (0.3 < fx / width < 4 and 0.5 < fx / fy < 2):
        return False
    k = torch.from_numpy(from_pycolmap_camera(camera, name)[1])
    corner = torch.tensor([width / 2 / fx, height / 2 / fy], dtype=torch.float64)
    # along every half diagonal the image radius must grow with the ray's angle, by a share a lens can have
    reach = torch.linspace(0, 1, 50, dtype=torch.float64)[1:, None, None]
    signs = torch.tensor([[1.0, 1], [1, -1], [-1, 1], [-1, -1]], dtype=torch.float64)
    rays = reach * corner * signs
    radius = distort(rays, k, name).norm(dim=-1)
    ratio = radius / rays.norm(dim=-1)
    if name == "OPENCV" and k[2:].abs().max() > _MAX_TANGENTIAL:
        return False
    return bool((radius.diff(dim=0) > 0).all() and (ratio > 0.4).all() and (ratio < 2.5).all())


def set_camera(store: FeatureDatabase, camera: "pycolmap.Camera") -> None:
    """Make a lens the one that the mapper reads from the database."""
    known = under_model(camera, camera.model.name)
    known.has_prior_focal_length = True  # else the mapper guesses its own from the first pair
    with store.open() as database:
        database.update_camera(known)
