"""COLMAP models on disk <-> arrays: cameras, poses, points and tracks of registered images.

COLMAP's pixel grid is ours: the center of the first pixel is (0.5, 0.5). It stores world-to-camera; here poses are
cam2world.
"""

import signal
import threading
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from swimm3r.cameras import cameras_of, check_cameras
from swimm3r.errors import InputError
from swimm3r.io.colmap.cameras import common_model, from_pycolmap_camera, to_pycolmap_camera
from swimm3r.io.colmap.integrity import damaged_file
from swimm3r.io.files.atomic import atomic_folder
from swimm3r.io.files.damage import Remedy, first_line, guard
from swimm3r.io.files.safe_names import check_names

if TYPE_CHECKING:
    import pycolmap

_FILES = ("cameras", "images", "points3D")
_REMEDY = Remedy(
    "open it with COLMAP itself, or write it again with its model_converter",
    cause="a file is truncated or was written by an incompatible version",
    fault="is not a readable COLMAP model",
)
_NOT_FOUND = Remedy(
    "give the folder that COLMAP wrote, for example my_dive/sparse/0",
    cause="cameras, images and points3D (.bin or .txt) are not all in it, nor in its 0/ or sparse/0/",
)


def silence_log() -> None:
    """Have COLMAP report errors alone, and to stderr rather than into files of the folder for temporary files.

    Its import also makes SIGTERM print a stack trace; the process ends by that signal as it did before.
    """
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    pycolmap.logging.logtostderr = True
    handler = signal.getsignal(signal.SIGTERM)
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)  # Python does not know of the other one


@dataclass(frozen=True)
class ColmapModel:
    """Registered images of one size under one camera model, in the order of their COLMAP image ids.

    Raises ValueError where an index points nowhere or a number is none.
    """

    names: tuple[str, ...]
    model: str  # PINHOLE, SIMPLE_RADIAL, OPENCV or OPENCV_FISHEYE
    width: int
    height: int
    K: np.ndarray  # [c, 3, 3] pixels
    distortion: np.ndarray  # [c, d]
    cam2world: np.ndarray  # [c, 4, 4]
    xyz: np.ndarray  # [p, 3]
    rgb: np.ndarray  # [p, 3] uint8
    error: np.ndarray  # [p] mean reprojection error, pixels
    track_point: np.ndarray  # [o] index into the points
    track_frame: np.ndarray  # [o] index into names
    track_xy: np.ndarray  # [o, 2] pixels

    def __post_init__(self) -> None:
        check_names(self.names)
        if not len(self.names) == len(self.K) == len(self.distortion) == len(self.cam2world):
            raise ValueError("each image has one name, one lens and one pose")
        check_cameras(cameras_of(self))
        if not (np.isfinite(self.xyz).all() and np.isfinite(self.track_xy).all()) or np.isnan(self.error).any():
            raise ValueError("positions of points and of their observations are finite numbers")
        for index, length, what in (
            (self.track_point, len(self.xyz), "points"),
            (self.track_frame, len(self.names), "images"),
        ):
            if len(index) and not 0 <= int(index.min()) <= int(index.max()) < length:
                raise ValueError(f"its tracks point beyond its {length} {what}")


def read_model(folder: Path, remedy: Remedy | None = None) -> ColmapModel:
    """Read the binary or text model in `folder`, `folder/0`, `folder/sparse` or `folder/sparse/0`, the first found.

    Raises InputError where there is none, or one that mixes image sizes or has a lens `cameras` cannot express.
    """
    import pycolmap

    found = find_model(folder, remedy or _NOT_FOUND)
    with guard(found, remedy or _REMEDY):
        if (damaged := damaged_file(found)) is not None:  # pycolmap would hang on some of them
            raise ValueError(f"{damaged} is not whole")
        try:
            model = pycolmap.Reconstruction(str(found))
        except RuntimeError as error:  # pycolmap on a damaged file
            raise ValueError(first_line(error)) from error
        return from_pycolmap(model)


def find_model(folder: Path, remedy: Remedy = _NOT_FOUND) -> Path:
    """The folder that holds the model's files. Raises InputError where none does."""
    for candidate in (folder, folder / "0", folder / "sparse", folder / "sparse" / "0"):
        for suffix in (".bin", ".txt"):
            if all((candidate / f"{name}{suffix}").is_file() for name in _FILES):
                return candidate
    raise remedy.error(f"{folder} holds no COLMAP model", cause=remedy.cause, hint=remedy.hint)


def write_model(folder: Path, model: ColmapModel) -> None:
    """Write a binary model; the folder appears, or is replaced, only once it is whole."""
    reconstruction = to_pycolmap(model)
    with atomic_folder(folder) as draft:
        reconstruction.write_binary(str(draft))


def from_pycolmap(model: "pycolmap.Reconstruction") -> ColmapModel:
    """The arrays of a pycolmap reconstruction. Raises InputError as `read_model` does."""
    images = [model.image(i) for i in sorted(model.reg_image_ids())]
    if not images:
        raise InputError(
            "the COLMAP model has no registered images",
            cause="its reconstruction did not start, or its images file is empty",
            hint="use another sub-model (sparse/0, sparse/1, ...)",
        )
    cameras = [model.cameras[image.camera_id] for image in images]
    width, height = _one_size(cameras)
    lens = common_model({camera.model.name for camera in cameras})
    intrinsics = [from_pycolmap_camera(camera, lens) for camera in cameras]
    points = [model.points3D[i] for i in sorted(model.point3D_ids())]
    track_point, track_frame, track_xy = _observations(points, images)
    return ColmapModel(
        names=tuple(image.name for image in images),
        model=lens,
        width=width,
        height=height,
        K=np.stack([K for K, _ in intrinsics]),
        distortion=np.stack([distortion for _, distortion in intrinsics]),
        cam2world=np.stack([_pose(image) for image in images]),
        xyz=np.array([point.xyz for point in points], np.float64).reshape(-1, 3),
        rgb=np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        error=np.array([point.error for point in points], np.float64),
        track_point=track_point,
        track_frame=track_frame,
        track_xy=track_xy,
    )


def _one_size(cameras: "list[pycolmap.Camera]") -> tuple[int, int]:
    """The width and height of all cameras."""
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if len(sizes) > 1:
        raise InputError(
            f"the COLMAP model mixes image sizes: {', '.join(f'{w}x{h}' for w, h in sizes)}",
            cause="images of several cameras or crops were reconstructed together",
            hint="reconstruct the images of one size, or resize them first",
        )
    return sizes[0]


def _pose(image: "pycolmap.Image") -> Float[np.ndarray, "4 4"]:
    """cam2world of an image."""
    world2cam = image.cam_from_world()
    if not np.linalg.norm(world2cam.rotation.quat) > 0.5:  # zero would be taken for no rotation
        raise ValueError(f"the rotation of {image.name} is a quaternion of zeros")
    return np.vstack([world2cam.inverse().matrix(), [0.0, 0.0, 0.0, 1.0]])


def _observations(
    points: "list[pycolmap.Point3D]", images: "list[pycolmap.Image]"
) -> tuple[Int[np.ndarray, " o"], Int[np.ndarray, " o"], Float[np.ndarray, "o 2"]]:
    """Point, frame and pixel of every observation in the images, the points in order."""
    frame_of = {image.image_id: frame for frame, image in enumerate(images)}
    seen = {image.image_id: np.array([p.xy for p in image.points2D]).reshape(-1, 2) for image in images}
    most = sum(point.track.length() for point in points)
    point_rows, frame_rows, xy = np.zeros(most, np.int64), np.zeros(most, np.int64), np.zeros((most, 2))
    count = 0
    for row, point in enumerate(points):
        for element in point.track.elements:
            if element.image_id in frame_of:
                point_rows[count], frame_rows[count] = row, frame_of[element.image_id]
                xy[count] = seen[element.image_id][element.point2D_idx]
                count += 1
    return point_rows[:count].copy(), frame_rows[:count].copy(), xy[:count].copy()


def to_pycolmap(model: ColmapModel) -> "pycolmap.Reconstruction":
    """The pycolmap reconstruction of the arrays: one camera if all frames share intrinsics, else one per frame."""
    import pycolmap

    out = pycolmap.Reconstruction()
    shared = bool(np.ptp(model.K, axis=0).max() == 0 and np.all(np.ptp(model.distortion, axis=0) == 0))
    for i in range(1 if shared else len(model.names)):
        out.add_camera_with_trivial_rig(to_pycolmap_camera(model, i))

    order = np.argsort(model.track_frame, kind="stable")
    starts = np.searchsorted(model.track_frame[order], np.arange(len(model.names) + 1))
    for i, name in enumerate(model.names):
        rows = order[starts[i] : starts[i + 1]]
        image = pycolmap.Image(
            name=name, keypoints=model.track_xy[rows], camera_id=1 if shared else i + 1, image_id=i + 1
        )
        world2cam = np.linalg.inv(model.cam2world[i])
        out.add_image_with_trivial_frame(
            image, pycolmap.Rigid3d(pycolmap.Rotation3d(world2cam[:3, :3]), world2cam[:3, 3])
        )
    add_points(out, model)
    return out


def add_points(out: "pycolmap.Reconstruction", model: ColmapModel) -> None:
    """Add the points of the arrays to a reconstruction whose images have ids from 1 and their pixels in order."""
    import pycolmap

    order = np.argsort(model.track_frame, kind="stable")
    starts = np.searchsorted(model.track_frame[order], np.arange(len(model.names) + 1))
    point2d = np.empty(len(order), np.int64)
    for first, last in pairwise(starts):
        point2d[order[first:last]] = np.arange(last - first)
    by_point = np.argsort(model.track_point, kind="stable")
    starts = np.searchsorted(model.track_point[by_point], np.arange(len(model.xyz) + 1))
    for p, (xyz, rgb, error) in enumerate(zip(model.xyz, model.rgb, model.error, strict=True)):
        track = pycolmap.Track()
        for row in by_point[starts[p] : starts[p + 1]]:
            track.add_element(int(model.track_frame[row]) + 1, int(point2d[row]))
        point = pycolmap.Point3D()
        point.xyz, point.color, point.error, point.track = xyz, rgb, error, track
        out.add_point3D_with_id(p + 1, point)
