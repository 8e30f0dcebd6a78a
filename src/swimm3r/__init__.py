"""Swimm3R: underwater video in; camera poses, the water, a restored point cloud and a map that renders out.

    fast = swimm3r.PRESETS["fast"]  # to start from; dataclasses.replace(fast.splat, iterations=5000) changes it

    frames = swimm3r.read_frames("dive.mp4", fast.frames, fps=5)
    rec = swimm3r.reconstruct(frames, fast.sfm)
    scene = swimm3r.train(rec, frames, fast.splat)
    out = scene.render(rec.cameras[0].pinhole())  # out.rgb with the water, out.clear without
    pose = swimm3r.localize(frames.image(0), scene, rec, frames)

    scene.save("dive.safetensors")  # and load_map; every record is saved and loaded so
    rec.cameras.save("cameras.json", rec.names)

Progress is shown in a terminal or a notebook, and notebooks show frames, rec, rec.medium, scene and out. Names load on
first use, so that importing the package, and every --help, is instant.
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from swimm3r.cameras import Cameras
    from swimm3r.errors import Swimm3rError
    from swimm3r.io.cameras_json import load_cameras
    from swimm3r.io.medium_json import load_medium
    from swimm3r.localization import localize
    from swimm3r.localization.settings import LocalizationSettings
    from swimm3r.medium import Medium, MediumFit, add_water, remove_water
    from swimm3r.pipeline.presets import PRESETS, RunSettings
    from swimm3r.pipeline.run import run_pipeline
    from swimm3r.prepare import load_frames, read_frames
    from swimm3r.progress import Progress, silent
    from swimm3r.scene.frames import Frames
    from swimm3r.scene.reconstruction import Reconstruction
    from swimm3r.scene.reconstruction_io import load_reconstruction
    from swimm3r.scene.settings import FrameSettings
    from swimm3r.sfm import reconstruct
    from swimm3r.sfm.rectified.frames import RectifiableError, rectify_frames
    from swimm3r.sfm.rectified.run import rectify_run, run_frames
    from swimm3r.sfm.settings import ColmapSettings, Mast3rSettings
    from swimm3r.splat import train
    from swimm3r.splat.map_file import load_map
    from swimm3r.splat.rendering import SplatMap
    from swimm3r.splat.settings import UwbsSettings, uwbs, with_recipe
    from swimm3r.synthetic import DiveSettings, write_dive

_HOME = {
    "Cameras": "cameras",
    "load_cameras": "io.cameras_json",
    "load_frames": "prepare",
    "load_medium": "io.medium_json",
    "load_reconstruction": "scene.reconstruction_io",
    "Frames": "scene.frames",
    "Swimm3rError": "errors",
    "FrameSettings": "scene.settings",
    "LocalizationSettings": "localization.settings",
    "localize": "localization",
    "Medium": "medium",
    "MediumFit": "medium",
    "add_water": "medium",
    "remove_water": "medium",
    "read_frames": "prepare",
    "PRESETS": "pipeline.presets",
    "RunSettings": "pipeline.presets",
    "Reconstruction": "scene.reconstruction",
    "run_pipeline": "pipeline.run",
    "Progress": "progress",
    "silent": "progress",
    "reconstruct": "sfm",
    "RectifiableError": "sfm.rectified.frames",
    "rectify_frames": "sfm.rectified.frames",
    "rectify_run": "sfm.rectified.run",
    "run_frames": "sfm.rectified.run",
    "ColmapSettings": "sfm.settings",
    "Mast3rSettings": "sfm.settings",
    "SplatMap": "splat.rendering",
    "UwbsSettings": "splat.settings",
    "load_map": "splat.map_file",
    "train": "splat",
    "uwbs": "splat.settings",
    "with_recipe": "splat.settings",
    "DiveSettings": "synthetic",
    "write_dive": "synthetic",
}

__all__ = [
    "PRESETS",
    "Cameras",
    "ColmapSettings",
    "DiveSettings",
    "FrameSettings",
    "Frames",
    "LocalizationSettings",
    "Mast3rSettings",
    "Medium",
    "MediumFit",
    "Progress",
    "Reconstruction",
    "RectifiableError",
    "RunSettings",
    "SplatMap",
    "Swimm3rError",
    "UwbsSettings",
    "add_water",
    "load_cameras",
    "load_frames",
    "load_map",
    "load_medium",
    "load_reconstruction",
    "localize",
    "read_frames",
    "reconstruct",
    "rectify_frames",
    "rectify_run",
    "remove_water",
    "run_frames",
    "run_pipeline",
    "silent",
    "train",
    "uwbs",
    "with_recipe",
    "write_dive",
]


def __getattr__(name: str) -> object:
    if name == "__version__":
        return version("swimm3r")
    if name not in _HOME:
        raise AttributeError(f"module 'swimm3r' has no attribute {name!r}")
    return getattr(import_module(f"swimm3r.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
