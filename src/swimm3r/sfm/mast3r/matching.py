"""Matches of two views: reciprocal nearest neighbors of dense descriptors (MASt3R, sec. 3.3).

From a grid of seeds in view 1, walk to the nearest descriptor in view 2 and back until the walk stands still; it then
stands on a reciprocal pair. Costs a hundredth of comparing every pixel with every pixel and finds the pairs with the
largest basins, which are the reliable ones. Pixels are (x, y), whole numbers: 0 is the first pixel.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from swimm3r.sfm.mast3r.settings import MatchingSettings


@dataclass(frozen=True)
class DescriptorMap:
    """Unit descriptors of one view's pixels in one pass of the network."""

    descriptors: Float[Tensor, "h w d"]
    confidence: Float[Tensor, "h w"]  # > 0
    mask: Bool[Tensor, "h w"] | None = None  # pixels that may match; None: all


@dataclass(frozen=True)
class PixelMatches:
    """Pixels of two views that show the same point."""

    xy1: Int64[Tensor, "m 2"]
    xy2: Int64[Tensor, "m 2"]
    confidence: Float[Tensor, " m"]


@dataclass(frozen=True)
class ReciprocalPairs:
    """End points of the walks of one search, as flat pixel numbers y * w + x, sorted by the first."""

    index1: Int64[Tensor, " m"]
    index2: Int64[Tensor, " m"]
    basins: Int64[Tensor, " pixels"]  # of view 1: where the walk went next from here; -1 where none passed


def match_views(
    view11: DescriptorMap,
    view21: DescriptorMap,
    view12: DescriptorMap,
    view22: DescriptorMap,
    settings: MatchingSettings = MatchingSettings(),  # noqa: B008  frozen
) -> PixelMatches:
    """Matches of two views from both passes of the network: view 1 in pass 1 and 2, view 2 in pass 1 and 2.

    (`view21` is view 2 in the pass where view 1 comes first.) The confidence of a match is the geometric mean of both
    pixels' in the pass that found it first.
    """
    forth = _both_ways(view11, view21, settings.subsample)
    back = _both_ways(view12, view22, settings.subsample)
    index1, index2, confidence = (torch.cat([f, b]) for f, b in zip(forth, back, strict=True))
    matches = _merged(index1, index2, confidence, view11, view21)
    return drop_border(matches, view11.confidence.shape, view21.confidence.shape, settings.border)


def match_pass(
    view1: DescriptorMap, view2: DescriptorMap, subsample: int = 8, pixel_tolerance: float | int = 0
) -> PixelMatches:
    """Matches from one pass of the network only; the confidence is the smaller of the two pixels'.

    With a tolerance (pixels) the seeds themselves are matched if their walk comes back that near: an even cover of the
    view, for localization.
    """
    grids = [None, None]
    if pixel_tolerance > 0:
        grids = [_grid(view, subsample) for view in (view1, view2)]
    forth = reciprocal_pairs(view1, view2, subsample, grids[0], pixel_tolerance)
    back = reciprocal_pairs(view2, view1, subsample, grids[1], pixel_tolerance)
    index1 = torch.cat([forth.index1, back.index2])
    index2 = torch.cat([forth.index2, back.index1])
    confidence = torch.minimum(view1.confidence.flatten()[index1], view2.confidence.flatten()[index2])
    return _merged(index1, index2, confidence, view1, view2)


def reciprocal_pairs(
    view1: DescriptorMap,
    view2: DescriptorMap,
    subsample: int = 8,
    seeds: Int64[Tensor, " s"] | None = None,
    pixel_tolerance: float | int = 0,
) -> ReciprocalPairs:
    """Walks from seeds in view 1 (a grid, or flat pixel numbers) and keeps those that come to stand still.

    With a tolerance, one round trip counts if it ends less than that many pixels from where it began; given seeds are
    then returned instead of where the walk ended.
    """
    h1, w1 = view1.confidence.shape
    one, two = _Searchable.of(view1), _Searchable.of(view2)
    start = _grid(view1, subsample) if seeds is None else seeds
    if view1.mask is not None:
        start = start[view1.mask.flatten()[start]]
    start = start.unique()
    rounds = 10 if seeds is None and pixel_tolerance == 0 else 1
    at1, at2 = start.clone(), torch.full_like(start, -1)
    basins = torch.full((h1 * w1,), -1, dtype=torch.int64, device=start.device)
    walking = torch.arange(len(start), device=start.device)
    if len(one) == 0 or len(two) == 0:
        return ReciprocalPairs(start[:0], start[:0], basins)
    for _ in range(rounds):
        before1, before2 = at1[walking], at2[walking]
        at2[walking] = two.nearest(one.at(before1))
        still = at2[walking] == before2
        basins[before1[still]] = before1[still]  # the same partner leads back to the same pixel
        walking, before1 = walking[~still], before1[~still]
        at1[walking] = one.nearest(two.at(at2[walking]))
        basins[before1] = at1[walking]
        walking = walking[at1[walking] != before1]
        if len(walking) == 0:
            break
    stands = torch.ones_like(start, dtype=torch.bool)
    stands[walking] = False
    if pixel_tolerance > 0:
        stands = (_pixels(start, w1) - _pixels(at1, w1)).float().norm(dim=1) < pixel_tolerance
        at1 = at1 if seeds is None else start
    index1, index2, _ = unique_pairs(at1[stands], at2[stands])
    return ReciprocalPairs(index1, index2, basins)


def unique_pairs(
    index1: Int64[Tensor, " m"], index2: Int64[Tensor, " m"]
) -> tuple[Int64[Tensor, " k"], Int64[Tensor, " k"], Int64[Tensor, " k"]]:
    """Each pair once, sorted by the first index, then the second; and where it first stood in the input."""
    pairs, inverse = torch.unique(torch.stack([index1, index2], dim=1), dim=0, return_inverse=True)
    order = torch.arange(len(index1), device=index1.device)
    first = torch.full((len(pairs),), len(index1), device=index1.device).scatter_reduce(0, inverse, order, "amin")
    return pairs[:, 0], pairs[:, 1], first


def nearest(queries: Float[Tensor, "q d"], candidates: Float[Tensor, "n d"], block: int = 1024) -> Int64[Tensor, " q"]:
    """For each query the candidate with the largest inner product, the first of equals; blocks fit the cache."""
    best = torch.full((len(queries),), -torch.inf, device=queries.device, dtype=queries.dtype)
    index = torch.zeros(len(queries), dtype=torch.int64, device=queries.device)
    for q in range(0, len(queries), block):
        part = queries[q : q + block]
        for c in range(0, len(candidates), block):
            value, at = (part @ candidates[c : c + block].T).max(dim=1)
            better = value > best[q : q + block]
            best[q : q + block] = torch.where(better, value, best[q : q + block])
            index[q : q + block] = torch.where(better, at + c, index[q : q + block])
    return index


def drop_border(
    matches: PixelMatches, size1: tuple[int, int] | torch.Size, size2: tuple[int, int] | torch.Size, border: int
) -> PixelMatches:
    """Without the matches that lie within `border` pixels of an edge of either view; sizes are (height, width)."""
    keep = torch.ones(len(matches.xy1), dtype=torch.bool, device=matches.xy1.device)
    for xy, (height, width) in ((matches.xy1, size1), (matches.xy2, size2)):
        x, y = xy.T
        keep &= (x >= border) & (x < width - border) & (y >= border) & (y < height - border)
    return PixelMatches(matches.xy1[keep], matches.xy2[keep], matches.confidence[keep])


@dataclass(frozen=True)
class _Searchable:
    """Descriptors of a view, flat, and the pixel numbers that may be found."""

    all: Float[Tensor, "pixels d"]
    allowed: Float[Tensor, "n d"]
    pixels: Int64[Tensor, " n"] | None

    @staticmethod
    def of(view: DescriptorMap) -> "_Searchable":
        flat = view.descriptors.flatten(0, 1)
        if view.mask is None:
            return _Searchable(flat, flat, None)
        pixels = view.mask.flatten().nonzero()[:, 0]
        return _Searchable(flat, flat[pixels], pixels)

    def __len__(self) -> int:
        return len(self.allowed)

    def at(self, index: Int64[Tensor, " q"]) -> Float[Tensor, "q d"]:
        return self.all[index]

    def nearest(self, queries: Float[Tensor, "q d"]) -> Int64[Tensor, " q"]:
        index = nearest(queries, self.allowed)
        return index if self.pixels is None else self.pixels[index]


def _both_ways(view1: DescriptorMap, view2: DescriptorMap, subsample: int) -> tuple[Tensor, Tensor, Tensor]:
    forth = reciprocal_pairs(view1, view2, subsample)
    back = reciprocal_pairs(view2, view1, subsample)
    index1 = torch.cat([forth.index1, back.index2])
    index2 = torch.cat([forth.index2, back.index1])
    confidence = (view1.confidence.flatten()[index1] * view2.confidence.flatten()[index2]).sqrt()
    return index1, index2, confidence


def _merged(
    index1: Tensor, index2: Tensor, confidence: Tensor, view1: DescriptorMap, view2: DescriptorMap
) -> PixelMatches:
    index1, index2, first = unique_pairs(index1, index2)
    w1, w2 = view1.confidence.shape[1], view2.confidence.shape[1]
    return PixelMatches(_pixels(index1, w1), _pixels(index2, w2), confidence[first])


def _grid(view: DescriptorMap, subsample: int) -> Int64[Tensor, " s"]:
    height, width = view.confidence.shape
    device = view.confidence.device
    y = torch.arange(subsample // 2, height, subsample, device=device)
    x = torch.arange(subsample // 2, width, subsample, device=device)
    return (y[:, None] * width + x).flatten()


def _pixels(index: Int64[Tensor, " m"], width: int) -> Int64[Tensor, "m 2"]:
    return torch.stack([index % width, index // width], dim=1)
