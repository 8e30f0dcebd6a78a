"""Small patches of depth that nothing around them bears out.

A few frames can agree on a wrong depth: a match along the epipolar line leads back to where it came from, though it
shows other ground. Further frames would contradict. At the borders of a strip no further frame sees the ground, nor the
wrong patches, which lie beside it at up to several times its distance.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import find_objects

from swimm3r.sfm.plane_sweep.consistency import patches

_SAME_SURFACE = 0.03  # relative difference of neighbors
_MOSTLY = 0.5  # share of a patch that enough frames must see alike, else it has to fit its surroundings ..
_LARGE = 8  # .. unless it is as many times as large as a speck
_AROUND = 1 / 8  # of the image's longer side
_FITS = 0.2  # of inverse depth, that a patch may lie beyond nine tenths of its surroundings


def without_specks(
    q: Float[np.ndarray, "h w"], certain: Bool[np.ndarray, "h w"], area: int
) -> Float[np.ndarray, "h w"]:
    """Inverse depth, 0 = unknown, without connected patches smaller than `area` pixels.

    Patches of less than 8 times that, most of which is not `certain`, also go where their median is beyond what else is
    known around them, or in the whole image where nothing is known around them, by more than 20 %.
    """
    label = patches(q, _SAME_SURFACE)
    size = np.bincount(label.ravel())
    kept = size >= area
    kept[0] = False
    is_certain = np.bincount(label.ravel(), certain.ravel()) >= _MOSTLY * size
    unsure = kept & ~is_certain & (size < _LARGE * area)
    solid = (kept & ~unsure)[label]
    reach = round(_AROUND * max(q.shape))
    for number, box in enumerate(find_objects(np.where(unsure[label], label, 0)), start=1):
        if box is None:
            continue
        around = tuple(slice(max(0, side.start - reach), side.stop + reach) for side in box)
        beside = q[around][solid[around]] if solid[around].any() else q[solid]
        if len(beside):
            low, high = np.quantile(beside, [0.05, 0.95])
            kept[number] = (1 - _FITS) * low <= np.median(q[box][label[box] == number]) <= (1 + _FITS) * high
    return np.where(kept[label], q, 0).astype(q.dtype)
