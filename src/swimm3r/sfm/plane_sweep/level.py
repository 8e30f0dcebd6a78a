"""A view and its sources at one size, as the kernels of every processor read them."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Level:
    """One size of a sweep; images of sources hold two pixels per integer (`kernels.packed`)."""

    reference: np.ndarray  # [h, w] float32, gray without slow changes, in the integers' unit
    guide: np.ndarray  # [h, w] float32, gray 0..1
    usable: np.ndarray  # [h, w] bool, inside the image and its mask
    flat: np.ndarray  # [s, h, w] int32
    seen: np.ndarray  # [s, h, w] bool, a window lies wholly in what the source shows
    lenses: np.ndarray  # [s, 12] float32, H row by row and e


@dataclass(frozen=True)
class SweepNumbers:
    """Constants of one sweep, in the units of the kernels."""

    planes: np.ndarray  # inverse depths, evenly spaced
    radius: int  # half width of the coarse windows, pixels of half size
    noise: float  # variance below which a window is too uniform
    edge: float  # change of gray that makes a depth edge likely
    keep: int  # sources that count
    smooth: float  # semi-global: one plane of disagreement
    smooth_fine: float  # refinement: one source pixel of disagreement


@dataclass(frozen=True)
class Round:
    """One round of refinement."""

    offsets: np.ndarray  # `refinement.window`
    step: float  # trial move, source pixels
    reach: int  # distance of the neighbors asked; 0: the surface is only judged
