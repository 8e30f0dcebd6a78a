"""Pairs of views as training sees them: the network's images of one crop, clear and raw, with ray depth.

    teacher: the clear image       student: the raw one, or with probability p the clear one through drawn water

Both come from one framing, so that every token shows the same piece of the scene to both. Water of the augmentation
acts at ray depth. Where depth is unknown no loss looks, but the student sees it: the open water's Binf where the clear
image is black, because nothing is there, and else water at the nearest known depth.
"""

from collections.abc import Sequence as Items
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r import water_types
from swimm3r.cameras import Cameras, image_directions
from swimm3r.datasets.pairs import Pair
from swimm3r.datasets.sequences import Sequence, load
from swimm3r.errors import InputError
from swimm3r.geometry import relative_poses
from swimm3r.io.files.cache_key import cache_key
from swimm3r.io.images import image_size
from swimm3r.medium import Medium
from swimm3r.sfm.distillation.water_augmentation import with_sampled_water
from swimm3r.sfm.mast3r.preprocess import Framing, K_to_network, framing, to_network


@dataclass(frozen=True)
class PairItem:
    """Two views of one dive, on the CPU."""

    clean: Float[Tensor, "2 3 h w"]  # -1..1
    raw: Float[Tensor, "2 3 h w"]
    ray_depth: Float[Tensor, "2 h w"]  # m, 0 where unknown
    valid: Bool[Tensor, "2 h w"]  # where the water's losses look
    sampled_medium: Float[
        Tensor, "2 3 3"
    ]  # Binf, beta_D, beta_B of the augmentation's water; NaN for an image taken in water


@dataclass(frozen=True)
class PairData:
    """The pairs of a training or validation set; every item is loaded when asked for."""

    sequences: tuple[Sequence, ...]
    pairs: tuple[tuple[int, Pair], ...]  # index of the sequence, and the pair in it
    size: int  # long side of the network's images
    patch: int = 16

    def __len__(self) -> int:
        return len(self.pairs)

    def item(self, index: int, water_probability: float, generator: torch.Generator) -> PairItem:
        """Pair `index`, with water of one draw for both views. Raises InputError where a file is damaged."""
        s, pair = self.pairs[index]
        sequence = self.sequences[s]
        in_air = any(sequence.shots[k].raw is None for k in (pair.i, pair.j))
        water = water_types.draw(generator, 1.0 if in_air else water_probability)
        views = [self._view(sequence, k, water) for k in (pair.i, pair.j)]
        if views[0].clean.shape != views[1].clean.shape:
            one, two = (sequence.shots[k].name for k in (pair.i, pair.j))
            raise InputError(
                f"{one} and {two} of {sequence.name} differ in shape",
                cause="the sequence mixes upright and lying images, or sizes",
                hint="put images of each size into a folder of their own",
            )
        return PairItem(*(torch.stack([getattr(v, name) for v in views]) for name in PairItem.__annotations__))

    def fingerprint(self) -> str:
        """Of the pairs, by name: two sets of the same fingerprint have the same pairs in the same order."""
        names = [(self.sequences[s].name, p.i, p.j, len(self.sequences[s])) for s, p in self.pairs]
        return cache_key(names, self.size)

    def two_views(self, index: int) -> "TwoViews | None":
        """Intrinsics of the network's images and the true pose of a pair; None where they are not known."""
        s, pair = self.pairs[index]
        sequence = self.sequences[s]
        first, second = (sequence.shots[k] for k in (pair.i, pair.j))
        path = first.clean or first.raw
        if path is None or not {first.name, second.name} <= sequence.cam2world.keys():
            return None
        width, height = image_size(path)
        camera = sequence.camera(width, height)
        if camera is None:
            return None
        K = K_to_network(camera.K, framing(width, height, self.size, patch=self.patch))[0]
        pose1, pose2 = (torch.from_numpy(sequence.cam2world[shot.name]).double() for shot in (first, second))
        return TwoViews(replace(camera, K=K[None]), relative_poses(pose2, pose1))

    def z_rays(self, sequence: Sequence, frame: Framing) -> Float[Tensor, "h w"]:
        """Ray depth per z depth of the network's pixels; 1 where the lens is not known."""
        camera = sequence.camera(frame.width, frame.height)
        if camera is None:
            return torch.ones(frame.network_height, frame.network_width)
        seen = Cameras(
            K_to_network(camera.K, frame), camera.distortion, camera.cam2world, frame.network_width,
            frame.network_height, camera.model,
        )  # fmt: skip
        return torch.linalg.vector_norm(image_directions(seen), dim=-1).float()

    def _view(self, sequence: Sequence, k: int, water: Medium | None) -> "_ViewItem":
        view = load(sequence, k)
        if view.clean is None:
            raise ValueError(f"{sequence.shots[k].name} has no clean image; trainable() leaves such shots out")
        height, width = view.clean.shape[:2]
        frame = framing(width, height, self.size, patch=self.patch)
        clean = to_network(view.clean, frame)
        depth = torch.zeros(clean.shape[1:])
        if view.z_depth is not None:
            depth = depth_to_network(view.z_depth, frame) * self.z_rays(sequence, frame)
        known = depth > 0
        sampled_medium = torch.full((3, 3), torch.nan)
        if water is not None and bool(known.any()):
            sampled_medium = torch.stack([water.Binf, water.beta_D, water.beta_B])
            raw = with_sampled_water(clean, depth, water)
        elif view.raw is not None:
            raw = to_network(view.raw, frame)
        else:
            raise ValueError(f"{sequence.shots[k].name} has neither a raw image nor any depth")
        return _ViewItem(clean, raw, depth, known, sampled_medium)


@dataclass(frozen=True)
class TwoViews:
    """The known geometry of a pair."""

    camera: Cameras  # one, with K of the network's images; its size is that of the files
    second_from_first: Float[Tensor, "4 4"]  # float64; the unit is the sequence's


@dataclass(frozen=True)
class _ViewItem:
    clean: Float[Tensor, "3 h w"]
    raw: Float[Tensor, "3 h w"]
    ray_depth: Float[Tensor, "h w"]
    valid: Bool[Tensor, "h w"]
    sampled_medium: Float[Tensor, "3 3"]


def trainable(sequences: Items[Sequence], pairs: Items[Items[Pair]], augmented: bool = True) -> list[tuple[int, Pair]]:
    """The pairs of the training shots that have what training needs: a clean image, and a raw one.

    Where training is `augmented`, depth stands for the raw image, which is then drawn.
    """
    found = []
    for s, (sequence, own) in enumerate(zip(sequences, pairs, strict=True)):
        fit = [
            shot.split == "train"
            and shot.clean is not None
            and (shot.raw is not None or (augmented and shot.depth is not None))
            for shot in sequence.shots
        ]
        found += [(s, pair) for pair in own if fit[pair.i] and fit[pair.j]]
    return found


def split_data(
    sequences: Items[Sequence],
    pairs: Items[Items[Pair]],
    size: int,
    validation: int,
    max_pairs: int,
    patch: int = 16,
    augmented: bool = True,
) -> tuple[PairData, PairData]:
    """Training and validation pairs, both spread evenly over all sequences. Raises InputError where none is trainable.

    At most a fifth of the pairs is held back. Validation pairs come from the same dives as the training pairs: they
    tell when training stops helping, not how it generalizes, for which the data sets have test sequences.
    """
    found = trainable(sequences, pairs, augmented)
    held = set(_evenly(len(found), min(validation, len(found) // 5)))
    kept = [i for i in range(len(found)) if i not in held]
    if max_pairs:
        kept = [kept[k] for k in _evenly(len(kept), min(max_pairs, len(kept)))]
    if not kept:
        raise InputError(
            "no pair of shots can be trained on",
            cause="training needs a clean image per shot, a raw one (or, with the water augmentation, depth), and "
            "two shots of one training sequence",
            hint="swimm3r datasets ROOT shows what was found",
        )

    def data(indices: Items[int]) -> PairData:
        return PairData(tuple(sequences), tuple(found[i] for i in indices), size, patch)

    return data(kept), data(sorted(held))


def depth_to_network(z_depth: Float[Tensor, "h w"], frame: Framing) -> Float[Tensor, "H W"]:
    """Depth on the network's pixels, by its nearest value: nothing is averaged across an edge."""
    resized = torch.nn.functional.interpolate(
        z_depth[None, None], (frame.resized_height, frame.resized_width), mode="nearest-exact"
    )[0, 0]
    return resized[frame.top : frame.top + frame.network_height, frame.left : frame.left + frame.network_width]


def _evenly(count: int, wanted: int) -> list[int]:
    """`wanted` different ones of `count` indices, evenly spread."""
    return [int(i) for i in np.floor((np.arange(wanted) + 0.5) * count / max(wanted, 1))]
