"""A nerfstudio data set: transforms.json, the sparse points as sparse_pc.ply, and images.

Poses are camera to world with OpenGL's camera axes (x right, y up, z back). As nerfstudio's own converter does, the
world is turned so that a camera held level has z up: (x, y, z) -> (x, z, -y). `applied_transform` says so, and the
points are turned, too. Instant-NGP takes a fisheye by `is_fisheye`, others by `camera_model`.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from swimm3r.cameras import Cameras
from swimm3r.export.dataset import contents, image_names, write_images
from swimm3r.export.result import Exported
from swimm3r.export.settings import NerfstudioSettings
from swimm3r.io.files.atomic import atomic_folder, write_text
from swimm3r.io.files.outputs import check_empty
from swimm3r.io.ply import write_points
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.run_folder import open_run
from swimm3r.sfm.rectified.run import run_frames

_APPLIED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
_OPENGL = np.diag([1.0, -1, -1, 1])
_PARAMETERS = {
    "PINHOLE": (), "SIMPLE_RADIAL": ("k1",), "OPENCV": ("k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}  # fmt: skip


def export_run(folder: Path, path: Path, settings: NerfstudioSettings) -> Exported:
    """Write a run with finished structure from motion into a folder that is new or empty."""
    check_empty(path)
    open_run(folder, "sfm")
    frames = run_frames(folder)
    rec = load_reconstruction(folder / "sfm", frames)
    names = image_names(rec, settings.with_images)
    with atomic_folder(path) as draft:
        write_images(folder, rec, frames, settings.with_images, draft / "images")
        xyz = rec.points.xyz.numpy() @ _APPLIED[:, :3].T
        write_points(draft / "sparse_pc.ply", xyz, rec.points.rgb.numpy())
        write_text(draft / "transforms.json", json.dumps(transforms(rec.cameras, names), indent=1) + "\n")
    return Exported(path, contents(rec, settings.with_images))


def transforms(cameras: Cameras, names: tuple[str, ...]) -> dict[str, Any]:
    """The document. A lens that all frames share is said once."""
    lenses = [_lens(cameras, i) for i in range(len(cameras))]
    shared = lenses[0] if all(lens == lenses[0] for lens in lenses) else {}
    applied = np.concatenate([_APPLIED, [[0, 0, 0, 1]]])
    poses = applied @ cameras.cam2world.numpy() @ _OPENGL
    frames = [
        {"file_path": f"images/{name}", **({} if shared else lens), "transform_matrix": pose.tolist()}
        for name, lens, pose in zip(names, lenses, poses, strict=True)
    ]
    model = {"SIMPLE_RADIAL": "OPENCV"}.get(cameras.model, cameras.model)  # with k2 = p1 = p2 = 0
    return {
        "camera_model": model,
        **({"is_fisheye": True} if model == "OPENCV_FISHEYE" else {}),
        "w": cameras.width,
        "h": cameras.height,
        **shared,
        "applied_transform": _APPLIED.tolist(),
        "ply_file_path": "sparse_pc.ply",
        "frames": frames,
    }


def _lens(cameras: Cameras, i: int) -> dict[str, float]:
    K, distortion = cameras.K[i].tolist(), cameras.distortion[i].tolist()
    bent = dict(zip(_PARAMETERS[cameras.model], distortion, strict=True))
    if cameras.model == "SIMPLE_RADIAL":
        bent |= {"k2": 0.0, "p1": 0.0, "p2": 0.0}
    return {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2], **bent}
