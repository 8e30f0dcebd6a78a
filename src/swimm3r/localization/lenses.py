"""The lens that an image was taken through: its own at the image's size, or that of the map's frames.

The cameras of a rig have lenses of their own. Images do not tell which of them it was: from above flat ground a longer
lens and a larger distance look alike.
"""

from dataclasses import replace

import torch

from swimm3r.cameras import Cameras, resized
from swimm3r.errors import InputError, UsageError
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap.rig.lenses import stated_lens

_SAME_SHAPE = 0.01  # of the ratio of width to height


def lens_at_size(lens: Cameras, width: int, height: int) -> Cameras:
    """A lens (one camera) for an image of this size, larger or smaller. Raises InputError for another shape."""
    if abs(width / height - lens.width / lens.height) > _SAME_SHAPE * lens.width / lens.height:
        raise InputError(
            f"the image is {width} x {height}, its lens is of images of {lens.width} x {lens.height}",
            cause="it comes from another camera, or was cropped or turned",
            hint="its own lens: --lens with a cameras.json that has it",
        )
    return resized(lens, width, height)


def has_several_lenses(rec: Reconstruction, frames: Frames | None = None) -> bool:
    """Return whether the reconstruction is of a rig whose cameras have different lenses."""
    numbers = torch.cat([rec.cameras.K.flatten(1), rec.cameras.distortion], 1)
    of_rig = rec.rig is not None or (frames is not None and frames.rig is not None)
    return of_rig and len(torch.unique(numbers, dim=0)) > 1


def unnamed_camera() -> InputError:
    """The error of an image of a rig with several lenses that is not told which camera took it."""
    return InputError(
        "the cameras of the rig have lenses of their own, and it is not known which of them took the image",
        cause="only the test frames of a run name their cameras",
        hint="--rig-camera with the name of the one that did, as in `rig` of RUN/summary.json; or --lens with its own",
    )


def lens_of_camera(rec: Reconstruction, frames: Frames, camera: str) -> Cameras:
    """The lens of a camera of the rig (its pose unused): that of its registered frames, else the calibrated one.

    Raises UsageError where the clip has no such camera, InputError where its lens is not known.
    """
    rig = frames.rig
    if rig is None or camera not in rig.names:
        raise UsageError(
            f"there is no camera {camera} in the run: it has " + ("no rig" if rig is None else ", ".join(rig.names)),
            cause="a slip in --rig-camera, or another run",
            hint="--rig-camera with one of the rig's cameras; none where the run has no rig",
        )
    name = next((name for name in rec.names if frames.frames[frames.index(name)].camera == camera), None)
    stated = stated_lens(next(each for each in rig.cameras if each.name == camera), frames)
    found = stated if name is None else rec.cameras[rec.index(name)]
    if found is None:
        raise InputError(
            f"the lens of {camera} is not known",
            cause="none of its frames is registered, and the rig is not calibrated",
            hint="its own lens: --lens with a cameras.json that has it",
        )
    return replace(found, cam2world=torch.eye(4, dtype=torch.float64)[None])
