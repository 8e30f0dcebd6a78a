"""SIFT for hazy images: where the keypoints are, what they look like, and which of two images' keypoints agree.

It looks at luma, as is usual, or where the water leaves hardly any texture there, at the channels that show it
(`imaging.gray`). Haze lowers contrast, not shape, so the detector's threshold is lowered and, where asked, local
contrast is equalized (CLAHE) before detection. Two keypoints match if each is the other's nearest in angle between
descriptors, and nearer than `max_ratio` times the second nearest from both sides (Lowe 2004).
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, no_type_check

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from swimm3r.imaging.gray import gray_levels, weights_for_features
from swimm3r.sfm.features.settings import FeatureSettings

if TYPE_CHECKING:
    import pycolmap

_MAX_ANGLE = 0.7  # radians between descriptors beyond which the nearest neighbor is no match (COLMAP's limit)
_ROWS = 128  # whose similarities stay in the processor's cache
_UPSAMPLE_BELOW = 700  # long side in pixels; small images have their detail at half a pixel's blur, large ones do not


@dataclass(frozen=True)
class Features:
    """The keypoints of one image, as COLMAP stores them."""

    keypoints: np.ndarray  # [n, 4] float32: x, y, scale, orientation; pixels of the full image
    descriptors: np.ndarray  # [n, 128] uint8


def extract_features(
    image: Float[Tensor, "h w 3"], usable: Bool[Tensor, "h w"], settings: FeatureSettings, *, upsample: bool = True
) -> Features:
    """Keypoints of an image outside its mask.

    Small images are enlarged to twice their size first, unless `upsample` is off: that takes four times as long.
    """
    import cv2
    import pycolmap

    gray = gray_levels(image, weights_for_features(image, usable))
    height, width = gray.shape
    scale = min(1.0, settings.long_side / max(height, width))
    if scale < 1:
        gray = cv2.resize(gray, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)
    if settings.equalize > 0:
        gray = cv2.createCLAHE(settings.equalize, (8, 8)).apply(gray)

    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    options.sift.max_num_features = settings.count
    options.sift.peak_threshold = settings.peak_threshold
    options.sift.first_octave = -1 if upsample and max(gray.shape) < _UPSAMPLE_BELOW else 0
    gray = np.ascontiguousarray(gray)
    found, described = _detect(gray, options)
    if len(found) < settings.count and settings.faint_threshold < settings.peak_threshold:
        # water this murky leaves little else than faint keypoints
        options.sift.peak_threshold = settings.faint_threshold
        found, described = _detect(gray, options)
    if len(found) == 0:
        return Features(np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8))
    keypoints = pycolmap.keypoints_to_matrix(found).astype(np.float32)
    keypoints[:, 0] *= width / gray.shape[1]
    keypoints[:, 1] *= height / gray.shape[0]
    keypoints[:, 2] /= scale
    x = np.clip(keypoints[:, 0].astype(int), 0, width - 1)
    y = np.clip(keypoints[:, 1].astype(int), 0, height - 1)
    kept = usable.numpy()[y, x]
    return Features(keypoints[kept], described.data[kept])


def match_descriptors(a: Float[Tensor, "m 128"], b: Float[Tensor, "n 128"], max_ratio: float) -> Int[Tensor, "k 2"]:
    """Pairs of rows that agree; descriptors have unit length."""
    if len(a) < 2 or len(b) < 2:
        return torch.zeros(0, 2, dtype=torch.int64)
    return _agreeing(a, b, max_ratio, None)


def match_nearby(
    a: Float[Tensor, "m 128"],
    b: Float[Tensor, "n 128"],
    xy_a: Float[Tensor, "m 2"],
    xy_b: Float[Tensor, "n 2"],
    radius: float,
    max_ratio: float,
) -> Int[Tensor, "k 2"]:
    """Pairs of rows that agree among those whose pixels lie within `radius`; descriptors have unit length."""
    if not len(a) or not len(b):
        return torch.zeros(0, 2, dtype=torch.int64)
    return _agreeing(a, b, max_ratio, torch.cdist(xy_a.float(), xy_b.float()) > radius)


def _agreeing(
    a: Float[Tensor, "m 128"], b: Float[Tensor, "n 128"], max_ratio: float, apart: Bool[Tensor, "m n"] | None
) -> Int[Tensor, "k 2"]:
    """Pairs of rows that agree; those `apart` count as opposite."""
    nearest = _Nearest.none(len(a), len(b))
    block = torch.empty(min(_ROWS, len(a)), len(b))
    for start in range(0, len(a), _ROWS):
        rows = a[start : start + _ROWS]
        similarity = torch.mm(rows, b.mT, out=block[: len(rows)])
        if apart is not None:
            similarity.masked_fill_(apart[start : start + _ROWS], -1.0)
        _look(similarity.numpy(), start, nearest)
    row, column = _mutual(nearest, max_ratio, _MAX_ANGLE)
    return torch.from_numpy(np.stack([row, column], 1))


def unit_descriptors(descriptors: np.ndarray) -> Float[Tensor, "n 128"]:
    """Stored descriptors as float unit vectors."""
    d = torch.from_numpy(descriptors.astype(np.float32))
    return d / d.norm(dim=1, keepdim=True).clamp(min=1e-6)


def _detect(
    gray: np.ndarray, options: "pycolmap.FeatureExtractionOptions"
) -> "tuple[pycolmap.FeatureKeypoints, pycolmap.FeatureDescriptors]":
    import pycolmap

    return pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu).extract_from_uint8_array(gray)


class _Nearest(NamedTuple):
    """Similarities of the two nearest rows of each column and the reverse, and which is the nearest."""

    row_of: np.ndarray  # [n]
    first: np.ndarray  # [n]
    second: np.ndarray  # [n]
    column_of: np.ndarray  # [m]
    best: np.ndarray  # [m]
    next_best: np.ndarray  # [m]

    @classmethod
    def none(cls, rows: int, columns: int) -> "_Nearest":
        """As it is before any row was looked at."""

        def side(count: int) -> tuple[np.ndarray, ...]:
            return np.zeros(count, np.int64), np.full(count, -1, np.float32), np.full(count, -1, np.float32)

        return cls(*side(columns), *side(rows))


@numba.njit(cache=True, nogil=True)
@no_type_check  # the tests' shape checks would wrap what Numba must compile
def _look(similarity, start, nearest):  # one pass over memory: four reductions of it take three times as long
    m, n = similarity.shape
    row_of, first, second = nearest.row_of, nearest.first, nearest.second
    for i in range(m):
        s1, s2, k = np.float32(-1), np.float32(-1), 0
        for j in range(n):
            s = similarity[i, j]
            if s > s2:
                if s > s1:
                    s2, s1, k = s1, s, j
                else:
                    s2 = s
            if s > second[j]:
                if s > first[j]:
                    second[j], first[j], row_of[j] = first[j], s, start + i
                else:
                    second[j] = s
        nearest.column_of[start + i], nearest.best[start + i], nearest.next_best[start + i] = k, s1, s2


@numba.njit(cache=True, nogil=True)
@no_type_check
def _mutual(nearest, max_ratio, max_angle):
    m = len(nearest.column_of)
    rows, columns = np.zeros(m, np.int64), np.zeros(m, np.int64)
    count = 0
    for i in range(m):
        j = nearest.column_of[i]
        angle = np.arccos(min(nearest.best[i], np.float32(1)))
        if (
            nearest.row_of[j] == i
            and angle <= max_angle
            and angle <= max_ratio * np.arccos(min(nearest.next_best[i], np.float32(1)))
            and angle <= max_ratio * np.arccos(min(nearest.second[j], np.float32(1)))
        ):
            rows[count], columns[count] = i, j
            count += 1
    return rows[:count], columns[:count]
