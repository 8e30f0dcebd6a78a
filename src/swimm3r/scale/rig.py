"""The scale that a rig tells: known distances of its cameras by those of the reconstruction."""

from collections.abc import Sequence

import numpy as np

from swimm3r.errors import InputError
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scale.solve import ScaleEstimate
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.rig import PlacedCamera

_DEPTHS = (0.1, 30.0)  # metres between a camera and the ground that it sees under water


def has_known_baseline(rec: Reconstruction) -> bool:
    """Return whether the rig of a reconstruction is rigid and calibrated."""
    return rec.rig is not None and rec.rig.rigid and any(camera.known_baseline for camera in rec.rig.cameras)


def rig_estimates(rec: Reconstruction, settings: ScaleSettings) -> list[ScaleEstimate]:
    """A scale for every known baseline. Raises InputError where one is given and there is no rigid rig."""
    rig = rec.rig
    if rig is None or not rig.rigid:
        if settings.baseline is None:
            return []
        raise InputError(
            "a baseline is given, and the run has no rigid rig" + ("" if rig is None else ": its cameras moved apart"),
            cause="the frames are of one camera, or poses are not of COLMAP's mapping, which alone fits rigs"
            if rig is None
            else "the images of the cameras are not synchronized",
            hint="images in left/ and right/, or --rig with the names of the cameras; without --baseline the run is"
            " as it was",
        )
    first, second = rig.names[:2]
    out = []
    for camera in rig.cameras[1:]:
        given = settings.baseline if camera.name == second else None
        for length, kind in ((given, "baseline"), (camera.known_baseline, "calibrated baseline")):
            if length is not None:
                out.append(_estimate(f"{kind} {first} to {camera.name}", camera, length, settings))
    return out


def rig_notes(rec: Reconstruction, estimates: Sequence[ScaleEstimate]) -> list[str]:
    """Doubts about baselines that put the ground where no camera sees it under water: centimetres for metres."""
    depths = rec.point_depths()
    if not len(depths):
        return []
    middle = float(depths.median())
    return [
        f"The {each.source} puts the scene {each.scale * middle:.3g} m from the cameras, where"
        f" {_DEPTHS[0]:g} to {_DEPTHS[1]:g} m are usual under water: check that it is in metres."
        for each in estimates
        if not _DEPTHS[0] <= each.scale * middle <= _DEPTHS[1]
    ]


def _estimate(name: str, camera: PlacedCamera, length: float, settings: ScaleSettings) -> ScaleEstimate:
    relative = (camera.baseline_std, settings.baseline_std / length, settings.minimum_std)
    return ScaleEstimate(
        name,
        length / camera.baseline,
        float(np.sqrt(np.sum(np.square(relative)))),
        f"{length:g} m at {camera.instants} instants",
    )
