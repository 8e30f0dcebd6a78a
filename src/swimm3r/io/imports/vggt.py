"""VGGT's predictions.npz (its demo writes it beside the folder images/): cameras, depth and confidence per image.

    extrinsic [s, 3, 4]: world to camera, OpenCV axes;   intrinsic [s, 3, 3]
    depth [s, h, w, 1],  depth_conf [s, h, w] >= 1,  images [s, 3, h, w]

of images resized to a width of 518 and to a height in whole patches of 14, of which more than 518 rows are cropped
evenly. The file does not name its images: they are those of images/ in the order of their names.
"""

from pathlib import Path

import numpy as np

from swimm3r.errors import InputError
from swimm3r.io.files.array_file import Layout, read_arrays
from swimm3r.io.images import image_size
from swimm3r.io.imports.record import REMEDY, ForeignDepth, ForeignModel, one_size, without_points

_SIZE, _PATCH = 518, 14
_LAYOUTS = {
    "extrinsic": Layout("images 3 4"),
    "intrinsic": Layout("images 3 3"),
    "depth": Layout("images rows columns 1", finite=False),
    "depth_conf": Layout("images rows columns"),
    "images": Layout("images 3 rows columns"),
}


def read(path: Path) -> ForeignModel:
    """Poses, lens and dense depth. Raises InputError or ValueError where file and images do not belong together."""
    stored = read_arrays(path, _LAYOUTS, REMEDY)
    extrinsic, intrinsic = (stored[name].astype(np.float64) for name in ("extrinsic", "intrinsic"))
    depth, confidence = stored["depth"][..., 0].astype(np.float32), stored["depth_conf"].astype(np.float32)
    images = stored["images"].astype(np.float32)
    folder = path.parent / "images"
    files = sorted(p for p in folder.glob("*") if p.is_file()) if folder.is_dir() else []
    if len(files) != len(extrinsic):
        raise InputError(
            f"{path} speaks of {len(extrinsic)} images, {folder} holds {len(files)}",
            cause="the file does not name its images: it is read together with the folder they came from",
            hint="put the file back beside its images/, as VGGT's demo left them",
        )
    width, height = one_size({image_size(p) for p in files})
    resized = round(height * _SIZE / width / _PATCH) * _PATCH
    h, w = depth.shape[1:]
    if (w, h) != (_SIZE, min(resized, _SIZE)):
        raise ValueError(f"its maps have {w}x{h} pixels; images of {width}x{height} give {_SIZE}x{min(resized, _SIZE)}")
    back = np.diag([width / _SIZE, height / resized, 1.0])
    back[1, 2] = max(resized - _SIZE, 0) // 2 * height / resized
    world2cam = np.tile(np.eye(4), (len(extrinsic), 1, 1))
    world2cam[:, :3] = extrinsic
    names = tuple(p.name for p in files)
    flat = np.zeros((len(names), 0))
    model = without_points(names, "PINHOLE", (width, height), back @ intrinsic, flat, np.linalg.inv(world2cam))
    share = np.where(depth > 0, 1 - 1 / np.maximum(confidence, 1), 0.0).astype(np.float32)
    gray = np.tensordot(images, np.array([0.299, 0.587, 0.114], np.float32), axes=([1], [0]))
    dense = ForeignDepth(intrinsic, np.where(np.isfinite(depth), np.maximum(depth, 0), 0.0), share, gray)
    return ForeignModel("VGGT", model, depth=dense)
