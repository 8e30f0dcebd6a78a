"""Masks: found by name, checked against their images, prepared at the size of the frames."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from swimm3r.errors import InputError
from swimm3r.io import image_folder, images
from swimm3r.prepare.candidates import SelectedImages, SourceImage, some_names
from swimm3r.scene.frames import MASKS
from swimm3r.scene.settings import FrameSettings


@dataclass(frozen=True)
class PreparedMasks:
    """The masks of a dive as written into the draft folder."""

    places: dict[str, str]  # relative paths by the frames' names
    covered: set[str]  # names of the frames that a mask covers wholly
    unused: int  # masks that belong to no frame


def check_masks(settings: FrameSettings) -> None:
    """Raise InputError where the folder of masks that was asked for is not there."""
    if settings.masks is not None and not settings.masks.is_dir():
        raise InputError(
            f"there is no folder of masks {settings.masks}", cause="a slip in the name", hint="check --masks"
        )


def prepare_masks(
    dive: SelectedImages, draft: Path, size: tuple[int, int], settings: FrameSettings, warnings: list[str]
) -> PreparedMasks:
    """Write the masks of the frames; says in `warnings` which masks or frames are left without their counterpart."""
    found, unused = _find(dive, settings)
    if not found and settings.masks is not None:
        raise InputError(
            f"no mask in {settings.masks} belongs to a frame",
            cause=f"the names differ; a mask of {dive.originals[0]} would be {dive.originals[0].with_suffix('.png')}",
            hint="name masks NAME.png, NAME.jpg.png or NAME_mask.png after the frames",
        )
    places, covered = {}, set()
    for image in dive.images:
        if image.original not in found:
            continue
        usable = _read(found[image.original], image, size)
        if not usable.any():
            covered.add(image.name)
        places[image.name] = f"{MASKS}/{image.name}.png"  # COLMAP's way of naming
        images.write_mask(draft / places[image.name], usable)
    if unused or (found and len(places) < len(dive.images)):
        names = f" ({some_names(unused, unused[0].parent)})" if unused else ""
        matched = f"Masks: {len(places)} of {len(dive.images)} frames have one"
        warnings.append(f"{matched}; {len(unused)} masks match no frame{names}.")
    return PreparedMasks(places, covered, len(unused))


def _find(dive: SelectedImages, settings: FrameSettings) -> tuple[dict[Path, Path], list[Path]]:
    """The masks of the originals, from the first folder that has one, and the masks that belong to none."""
    check_masks(settings)
    folders = [folder.resolve() for folder in dive.mask_folders if folder.is_dir()]
    found: dict[Path, Path] = {}
    masks: set[Path] = set()
    for folder in folders:
        within = image_folder.MaskFolder(folder, dive.files, [other for other in folders if other != folder])
        masks.update(within.paths)
        for original in dive.originals:
            mask = within.mask_of(original)
            if mask is not None:
                found.setdefault(original, mask)
    return found, sorted(masks - set(found.values()))


def _read(path: Path, image: SourceImage, size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """A mask at the size of the frames, where it is of the image's size or of that. Raises InputError."""
    import cv2

    usable = images.read_mask(path)
    given = usable.shape[::-1]
    if given not in (image.size, size):
        raise InputError(
            f"the mask {path} is {given[0]}x{given[1]}, its image {image.original} is {image.size[0]}x{image.size[1]}",
            cause="the mask was made for a resized, cropped or turned image",
            hint="make the masks at the size of the images",
        )
    return cv2.resize(usable.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool)
