"""A lens per camera of a rig, for mapping that places frames under one lens.

Where the calibrated lenses of a rig differ, keypoints of every other camera stand in the database where the first one's
lens has their rays: u' = pi_1(pi_k^-1(u)). The model and the matches are moved back, to pixels of the images. A focal
length that mapping refined by a factor is that of every camera by this factor, until the adjustment of the rig
(`sfm.colmap.rig.adjustment`) refines each lens by itself.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras, cameras_of, directions, project
from swimm3r.errors import InputError
from swimm3r.io.calibration.colmap_text import read
from swimm3r.io.calibration.record import lens_at
from swimm3r.io.colmap.cameras import from_pycolmap_camera, to_pycolmap_camera
from swimm3r.io.colmap.model import ColmapModel
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Matches
from swimm3r.scene.rig import RigCamera
from swimm3r.sfm.features.sift import Features
from swimm3r.sfm.lens import gives_lens
from swimm3r.sfm.settings import ColmapSettings

if TYPE_CHECKING:
    import pycolmap

_SAME = 1e-6  # relative difference of the numbers of one lens
_LOST = 0.01  # px off after there and back: a ray beyond those that the first lens has


@dataclass(frozen=True)
class RigLenses:
    """The calibrated lenses of a rig's cameras, under the model of the first, and which frame has which."""

    lenses: tuple[Cameras, ...]  # of each camera; the first is the one that mapping begins with
    camera: tuple[int, ...]  # of each frame of the clip

    @property
    def numbers(self) -> list[list[float]]:
        """K and distortion of every lens."""
        return [[*lens.K.flatten().tolist(), *lens.distortion.flatten().tolist()] for lens in self.lenses]

    def under_first(self, frame: int, found: Features) -> Features:
        """Features of a frame of the clip where the first lens has their rays; without those that it cannot have."""
        if self.camera[frame] == 0:
            return found
        pixels = torch.from_numpy(found.keypoints[:, :2].astype(np.float64))
        moved = self.first_pixels(frame, pixels)
        back = torch.linalg.vector_norm(self._own_pixels(moved, self.camera[frame]) - pixels, dim=1)
        held = (back < _LOST).numpy()
        keypoints = np.column_stack([moved.numpy(), found.keypoints[:, 2:]]).astype(np.float32)
        return Features(keypoints[held], found.descriptors[held])

    def first_pixels(self, frame: int, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
        """Pixels of a frame of the clip where the first lens has their rays."""
        own = self.camera[frame]
        return pixels if own == 0 else _moved(pixels, self.lenses[own], self.lenses[0])

    def own_model(self, table: ColmapModel, frames: list[int]) -> ColmapModel:
        """A model of these frames of the clip with its observations in the images' pixels, and each frame's lens."""
        first, rows = self.lenses[0], [self.camera[i] for i in frames]
        found = cameras_of(table)
        padded = [under_model_of(found[i], first.model) for i in range(len(frames))]
        track_xy = table.track_xy.copy()
        K, distortion = ([getattr(lens, name)[0] for lens in padded] for name in ("K", "distortion"))
        for i, k in enumerate(rows):
            if k:
                seen = table.track_frame == i
                track_xy[seen] = self._own_pixels(torch.from_numpy(track_xy[seen]), k).numpy()
                K[i] = self.lenses[k].K[0].clone()
                for axis in (0, 1):
                    K[i][axis, axis] *= padded[i].K[0, axis, axis] / first.K[0, axis, axis]
                distortion[i] = self.lenses[k].distortion[0]
        lenses = {"K": torch.stack(K).numpy(), "distortion": torch.stack(distortion).numpy()}
        return replace(table, model=first.model, track_xy=track_xy, **lenses)

    def own_matches(self, matches: Matches, frames: list[int]) -> Matches:
        """Matches of these frames of the clip in the images' pixels."""
        rows = torch.tensor([self.camera[i] for i in frames])
        xy_i, xy_j = matches.xy_i.clone(), matches.xy_j.clone()
        for k in range(1, len(self.lenses)):
            for frame, xy in ((matches.i, xy_i), (matches.j, xy_j)):
                seen = rows[frame] == k
                xy[seen] = self._own_pixels(xy[seen].double(), k).to(xy)
        return replace(matches, xy_i=xy_i, xy_j=xy_j)

    def _own_pixels(self, pixels: Float[Tensor, "n 2"], camera: int) -> Float[Tensor, "n 2"]:
        return _moved(pixels, self.lenses[0], self.lenses[camera])


def lenses_of_rig(frames: Frames, settings: ColmapSettings, first: "pycolmap.Camera") -> RigLenses | None:
    """The lenses of a calibrated rig beside the first, which mapping begins with.

    None where all are the same, where that of the first camera is not known, and where the settings give a lens or a
    port: these are of all cameras. Raises InputError where one is a fisheye lens and another is not, or a calibration
    is of images of another shape.
    """
    rig = frames.rig
    if rig is None or frames.calibration is None or gives_lens(settings) or settings.housing != "none":
        return None
    model = "OPENCV_FISHEYE" if first.model.name == "OPENCV_FISHEYE" else "OPENCV"
    K, distortion = (torch.from_numpy(values)[None] for values in from_pycolmap_camera(first, model))
    begin = Cameras(K, distortion, torch.eye(4, dtype=torch.float64)[None], first.width, first.height, model)
    lenses = [begin]
    for camera in rig.cameras[1:]:
        stated = stated_lens(camera, frames) or begin
        if (stated.model == "OPENCV_FISHEYE") != (model == "OPENCV_FISHEYE"):
            raise InputError(
                f"the lens of {camera.name} is {stated.model}, and that of {rig.names[0]} {first.model.name}",
                cause="one camera of the rig is calibrated as a fisheye lens and another is not",
                hint="calibrate all cameras of the rig under one model",
            )
        lenses.append(under_model_of(stated, model))
    if all(_same(lens, begin) for lens in lenses):
        return None
    return RigLenses(tuple(lenses), tuple(rig.names.index(frame.camera or "") for frame in frames))


def stated_lens(camera: RigCamera, frames: Frames) -> Cameras | None:
    """The calibrated lens of a rig's camera in frames of this size; None without one. Raises as `lens_at` does."""
    return None if camera.lens is None else lens_at(read(camera.lens)[0], frames.width, frames.height).camera


def under_model_of(lens: Cameras, model: str) -> Cameras:
    """One camera written as a model that has its own as a special case."""
    K, distortion = (torch.from_numpy(v)[None] for v in from_pycolmap_camera(to_pycolmap_camera(lens), model))
    return replace(lens, K=K, distortion=distortion, model=model)


def _same(a: Cameras, b: Cameras) -> bool:
    return torch.allclose(a.K, b.K, rtol=_SAME) and torch.allclose(a.distortion, b.distortion, rtol=_SAME)


def _moved(pixels: Float[Tensor, "n 2"], source: Cameras, target: Cameras) -> Float[Tensor, "n 2"]:
    """Pixels of one lens where another has the same rays."""
    return project(target, directions(source, pixels[None]))[0][0]
