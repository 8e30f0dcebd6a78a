"""Restored images for a data set that has none: Sea-Thru's water estimate per scene, once, kept and marked as made.

Sea-Thru has linear images and metric depth, but no poses. Of the evidence that `sfm/medium/seathru.py` uses, dark
pixels and the averages of each range are left; they determine the water only roughly: on made scenes the red channel's
error halves, green and blue gain little. All results stay within the training's folder, never beside the data:

    FOLDER/SEQUENCE/NAME.png     the image without water, 16 bits, in the encoding of the scene's own images
    FOLDER/SEQUENCE/made.json    what made it, from which images, and the water: written last
"""

import json
from collections.abc import Sequence as Items
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.datasets.sequences import Sequence, Shot, load
from swimm3r.errors import InputError
from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.damage import remake
from swimm3r.io.files.json_file import read_json
from swimm3r.io.images import write_rgb
from swimm3r.medium import MediumFit, linear_from_srgb, remove_water
from swimm3r.progress import Progress, silent
from swimm3r.sfm.distillation.water_augmentation import nearest_known
from swimm3r.sfm.medium.samples import WaterSamples
from swimm3r.sfm.medium.seathru import fit_medium
from swimm3r.sfm.medium.settings import SeathruSettings

_MARK = "made.json"


@dataclass(frozen=True)
class _Mark:
    """made.json, the last file of a folder of targets."""

    images: tuple[str, ...]


_KIND = "Sea-Thru"


def with_made_targets(sequences: Items[Sequence], folder: Path, progress: Progress = silent) -> tuple[Sequence, ...]:
    """The sequences, those of Sea-Thru with restored images made now or found in `folder` from before."""
    return tuple(_made(s, folder / s.name, progress) if s.kind == _KIND else s for s in sequences)


def scene_water(sequence: Sequence, settings: SeathruSettings) -> MediumFit:
    """The water of a scene from all of its images with depth, on sRGB values; z stands for ray depth without a lens.

    Raises InputError where too few pixels have a depth.
    """
    shots = [i for i, shot in enumerate(sequence.shots) if shot.depth is not None]
    most = max(1, settings.max_pixels // max(1, len(shots)))
    colors, depths, frames = [], [], []
    for i in shots:
        view = load(sequence, i)
        if view.raw is None or view.z_depth is None:
            raise ValueError(f"{sequence.shots[i].name} has no raw image or no depth")
        known = torch.nonzero(view.z_depth.flatten() > 0)[:, 0]
        known = known[:: max(1, -(-len(known) // most))]
        colors.append(view.raw.reshape(-1, 3)[known])
        depths.append(view.z_depth.flatten()[known])
        frames.append(torch.full_like(known, i))
    if not shots:
        colors, depths, frames = [torch.zeros(0, 3)], [torch.zeros(0)], [torch.zeros(0, dtype=torch.int64)]
    frame = torch.cat(frames)
    alone = torch.full_like(frame, -1)
    samples = WaterSamples(torch.cat(colors), torch.cat(depths), frame, alone, torch.zeros(0, 3))
    return fit_medium(samples, settings, "srgb")


def restored(raw: Float[Tensor, "h w 3"], z_depth: Float[Tensor, "h w"], water: MediumFit) -> Float[Tensor, "h w 3"]:
    """An image without the water, 0..1; where depth is unknown the nearest known one stands in."""
    depth = nearest_known(z_depth)
    return remove_water(raw, depth, water.at(depth)).clamp(0, 1)


def _made(sequence: Sequence, folder: Path, progress: Progress) -> Sequence:
    names = [shot.name for shot in sequence.shots if shot.depth is not None]
    mark = folder / _MARK
    if not (mark.is_file() and list(read_json(mark, _Mark, remake(folder)).images) == names):
        try:
            water = scene_water(sequence, SeathruSettings())
        except InputError as error:  # one scene without water must not stop the training on all others
            return replace(sequence, notes=(*sequence.notes, f"not for training: {error.what}"))
        _make(sequence, water, folder, progress)
        medium = {name: value.tolist() for name, value in vars(water.constant()).items()}
        about = {
            "made_by": "swimm3r sfm/distillation/seathru_targets.py, after Sea-Thru",
            "images": names,
            "medium": medium,
        }
        write_text(mark, json.dumps(about, indent=2) + "\n")

    def with_clean(shot: Shot) -> Shot:
        return replace(shot, clean=folder / f"{shot.name}.png") if shot.name in names else shot

    return replace(
        sequence,
        shots=tuple(with_clean(shot) for shot in sequence.shots),
        notes=(*sequence.notes, f"restored images were made, not photographed: {mark}"),
    )


def _make(sequence: Sequence, water: MediumFit, folder: Path, progress: Progress) -> None:
    shots = [i for i, shot in enumerate(sequence.shots) if shot.depth is not None]
    for done, i in enumerate(shots):
        progress(f"restoring {sequence.name}", done, len(shots))
        view = load(sequence, i)
        if view.raw is None or view.z_depth is None or not bool((view.z_depth > 0).any()):
            raise InputError(
                f"{sequence.shots[i].depth} knows no depth at all",
                cause="the file is damaged, or its values are beyond the data set's range",
                hint="take the image out of the scene",
            )
        J = restored(view.raw, view.z_depth, water)
        if sequence.encoding == "linear":
            J = linear_from_srgb(J)
        write_rgb(folder / f"{sequence.shots[i].name}.png", (J.numpy() * 65535 + 0.5).astype("uint16"))
    progress(f"restoring {sequence.name}", len(shots), len(shots))
