"""COLMAP models whose images belong to rigs: frames with one pose for all of their images.

A rig has a reference sensor; `sensor_from_rig` takes points of its axes to those of another sensor, and the pose of an
image is sensor_from_rig * rig_from_world of its frame.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from swimm3r.io.colmap.cameras import to_pycolmap_camera
from swimm3r.io.colmap.model import ColmapModel, add_points

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True)
class RigLayout:
    """The images of a model by the sensors and the frames of one rig; the first sensor gives the axes."""

    sensor: Int[np.ndarray, " c"]  # of each image, from 0
    frame: Int[np.ndarray, " c"]  # of each image, from 0 without gaps
    sensor_from_rig: Float[np.ndarray, "s 4 4"]
    rig_from_world: Float[np.ndarray, "f 4 4"]


def rigged(model: ColmapModel, layout: RigLayout) -> "pycolmap.Reconstruction":
    """The pycolmap reconstruction of a model with the poses of a rig: a camera per sensor, ids from 1.

    The lens of a sensor is that of its first image.
    """
    import pycolmap

    out, rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
    for s, pose in enumerate(layout.sensor_from_rig):
        camera = to_pycolmap_camera(model, int(np.flatnonzero(layout.sensor == s)[0]))
        camera.camera_id = s + 1
        out.add_camera(camera)
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, s + 1)
        if s == 0:
            rig.add_ref_sensor(sensor)
        else:
            rig.add_sensor(sensor, rigid(pose))
    out.add_rig(rig)
    for f, pose in enumerate(layout.rig_from_world):
        frame = pycolmap.Frame(frame_id=f + 1)
        frame.rig_id = 1
        for row in np.flatnonzero(layout.frame == f):
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, int(layout.sensor[row]) + 1)
            frame.add_data_id(pycolmap.data_t(sensor, int(row) + 1))
        frame.rig_from_world = rigid(pose)
        out.add_frame(frame)
    order = np.argsort(model.track_frame, kind="stable")
    starts = np.searchsorted(model.track_frame[order], np.arange(len(model.names) + 1))
    for row, name in enumerate(model.names):
        seen = model.track_xy[order[starts[row] : starts[row + 1]]]
        image = pycolmap.Image(name=name, keypoints=seen, camera_id=int(layout.sensor[row]) + 1, image_id=row + 1)
        image.frame_id = int(layout.frame[row]) + 1
        out.add_image(image)
    for f in range(len(layout.rig_from_world)):
        out.register_frame(f + 1)
    add_points(out, model)
    return out


def rigid(matrix: Float[np.ndarray, "4 4"]) -> "pycolmap.Rigid3d":
    """A 4 x 4 matrix as pycolmap has it."""
    import pycolmap

    return pycolmap.Rigid3d(pycolmap.Rotation3d(matrix[:3, :3]), matrix[:3, 3])


def sensor_poses(model: "pycolmap.Reconstruction") -> Float[np.ndarray, "s 4 4"]:
    """sensor_from_rig of the cameras of a model that `rigged` made, in the order of their ids."""
    import pycolmap

    out = np.tile(np.eye(4), (len(model.cameras), 1, 1))
    for camera_id in sorted(model.cameras)[1:]:
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
        pose = model.rigs[1].sensor_from_rig(sensor)
        assert pose is not None  # `rigged` gave it one
        out[camera_id - 1, :3] = pose.matrix()
    return out
