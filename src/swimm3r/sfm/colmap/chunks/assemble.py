"""Parts in common axes made one model: every frame with the pose of the part that holds it best, points anew, adjusted.

Points are triangulated from all verified matches, those between parts and around loops among them, and everything is
adjusted together, the lens of all frames, too.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from swimm3r.progress import Progress
from swimm3r.sfm.colmap.calibration.adjust import SEED
from swimm3r.sfm.colmap.calibration.start import set_camera
from swimm3r.sfm.colmap.chunks.join import Joined
from swimm3r.sfm.colmap.chunks.parts import Part
from swimm3r.sfm.features.database import MIN_INLIERS, FeatureDatabase
from swimm3r.sim3 import Sim3

if TYPE_CHECKING:
    import pycolmap

_STEP = "joining the chunks"


def assemble(
    store: FeatureDatabase, parts: Sequence[Part], joined: Joined, camera: "pycolmap.Camera", progress: Progress
) -> "pycolmap.Reconstruction":
    """The model of all frames of some parts under one lens, points triangulated and not yet adjusted."""
    import pycolmap

    poses = best_poses(parts, joined)
    set_camera(store, camera)
    options = pycolmap.DatabaseCacheOptions()
    options.min_num_matches = MIN_INLIERS
    options.image_names = {f"{image - 1:06d}" for image in poses}
    with store.open() as database:
        cache = pycolmap.DatabaseCache.create(database, options)
    model = pycolmap.Reconstruction()
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    for image, (R, t) in poses.items():
        frame = model.frames[model.images[image].frame_id]
        frame.set_cam_from_world(model.images[image].camera_id, pycolmap.Rigid3d(pycolmap.Rotation3d(R), t))
        model.register_frame(frame.frame_id)
    triangulation = pycolmap.IncrementalTriangulatorOptions()
    triangulation.random_seed = SEED
    triangulation.ignore_two_view_tracks = not store.little_overlap
    for done, image in enumerate(sorted(poses)):
        progress(_STEP, done, len(poses))
        mapper.triangulate_image(triangulation, image)
    progress(_STEP, len(poses), len(poses))
    mapper.complete_and_merge_tracks(triangulation)
    mapper.end_reconstruction(False)
    model.update_point_3d_errors()
    return model


def best_poses(parts: Sequence[Part], joined: Joined) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """R and t (camera from world) of every frame, from the part that observes the most points in it."""
    best: dict[int, tuple[int, np.ndarray, np.ndarray]] = {}
    for k, world_from_part in joined.from_part.items():
        for image in parts[k].images:
            seen = parts[k].observations(image)
            if image not in best or seen > best[image][0]:
                best[image] = (seen, *moved(parts[k].cam_from_world[image], world_from_part))
    return {image: (R, t) for image, (_, R, t) in best.items()}


def moved(cam_from_part: np.ndarray, world_from_part: Sim3) -> tuple[np.ndarray, np.ndarray]:
    """R and t of a camera in the world's axes and unit."""
    R = cam_from_part[:, :3] @ world_from_part.R.T
    center = world_from_part(-cam_from_part[:, :3].T @ cam_from_part[:, 3])
    return R, -R @ center
