"""The images of a run beside cameras that another program trains on."""

import shutil
from pathlib import Path

from swimm3r.errors import InputError
from swimm3r.export.settings import ImagesBeside
from swimm3r.io.view_names import view_stems
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction


def image_names(rec: Reconstruction, images: ImagesBeside) -> tuple[str, ...]:
    """The names of the image files: those of the frames, or with .png for restored ones."""
    stems = view_stems(rec.names)
    return tuple(f"{stems[name]}.png" for name in rec.names) if images == "restored" else rec.names


def write_images(folder: Path, rec: Reconstruction, frames: Frames, images: ImagesBeside, into: Path) -> None:
    """Copy the images of the registered frames, under `image_names`. Raises InputError where one was not restored."""
    if images == "none":
        return
    for name, target in zip(rec.names, image_names(rec, images), strict=True):
        restored = folder / "sfm" / "restored" / f"{name}.png"
        source = restored if images == "restored" else frames.frames[frames.index(name)].path
        if images == "restored" and not restored.is_file():
            raise InputError(
                f"{restored} is missing: this frame was not restored",
                cause="it has no depth, or the water was not estimated",
                hint="--with-images filmed",
            )
        (into / target).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, into / target)


def contents(rec: Reconstruction, images: ImagesBeside) -> str:
    """The data set in words."""
    seen = {"filmed": "images as filmed", "restored": "restored images", "none": "no images"}[images]
    return f"{len(rec.names)} cameras, {len(rec.points.xyz):,} points, {seen}"
