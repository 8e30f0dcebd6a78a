"""Masks: found by name, checked against their pictures, prepared at the size of the frames."""

from pathlib import Path

import numpy as np

from swimm3r.errors import InputError
from swimm3r.frame_settings import FrameSettings
from swimm3r.io import images, stills
from swimm3r.prepare.pictures import Dive, some_names

FOLDER = "masks"  # of the prepared ones, within the folder of the frames


def prepare_masks(
    dive: Dive, draft: Path, size: tuple[int, int], settings: FrameSettings, cautions: list[str]
) -> tuple[dict[str, str], set[str]]:
    """The masks' places by the frames' names, and the frames that a mask covers wholly."""
    import cv2

    folders = [folder for folder in dive.mask_folders if folder.is_dir()]
    if settings.masks is not None and not folders:
        raise InputError(
            f"there is no folder of masks {settings.masks}", cause="a slip in the name", hint="check --masks"
        )
    pictures = {folder / original for folder in folders for original in dive.originals}
    found: dict[Path, Path] = {}
    for original in dive.originals:
        mask = next((m for folder in folders if (m := stills.find_mask(original, folder, pictures))), None)
        if mask is not None:
            found[original] = mask
    if not found and settings.masks is not None:
        raise InputError(
            f"no mask in {settings.masks} belongs to a frame",
            cause=f"the names differ; a mask of {dive.originals[0]} would be {dive.originals[0].with_suffix('.png')}",
            hint="name masks NAME.png, NAME.jpg.png or NAME_mask.png after the frames",
        )
    places, covered = {}, set()
    for picture in dive.pictures:
        if picture.original not in found:
            continue
        usable = images.read_mask(found[picture.original])
        given = usable.shape[::-1]
        if given not in (picture.size, size):
            raise InputError(
                f"the mask {found[picture.original]} is {given[0]}x{given[1]}, "
                f"its picture {picture.original} is {picture.size[0]}x{picture.size[1]}",
                cause="the mask was made for a resized, cropped or turned picture",
                hint="make the masks at the size of the pictures",
            )
        if not usable.any():
            covered.add(picture.name)
        scaled = cv2.resize(usable.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool)
        places[picture.name] = f"{FOLDER}/{picture.name}.png"  # COLMAP's way of naming
        images.write_mask(draft / places[picture.name], scaled)
    if found:
        strangers = {mask for folder in folders for mask in _mask_files(folder, pictures)} - set(found.values())
        names = f" ({some_names(sorted(strangers), folders[-1])})" if strangers else ""
        matched = f"Masks: {len(places)} of {len(dive.pictures)} frames have one"
        cautions.append(f"{matched}; {len(strangers)} masks match no frame{names}.")
    return places, covered


def _mask_files(folder: Path, pictures: set[Path]) -> list[Path]:
    """What a folder of masks holds; nothing where the frames' own pictures lie there."""
    if any(picture.is_file() for picture in pictures if picture.is_relative_to(folder)):
        return []
    return [path for path in folder.rglob("*") if path.suffix.lower() in images.SUFFIXES]
