"""Runs the network over a pair graph: every image encoded once while memory lasts, both passes per pair, one pair held.

A pair (i, j) takes two decoder passes, because the network treats its views differently: with i first both pointmaps
are in camera i, with j first in camera j. `view_ij` is view i in the pass where view j comes first.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.progress import Progress, silent
from swimm3r.sfm.mast3r.network import Encoded, Mast3r


@dataclass(frozen=True)
class ViewPrediction:
    """Maps of one view in one pass, on the network's device; None where the head was not asked for."""

    points: Float[Tensor, "h w 3"] | None = None  # in the camera of the pass's first view, metres
    confidence: Float[Tensor, "h w"] | None = None  # >= 1
    descriptors: Float[Tensor, "h w d"] | None = None
    descriptor_confidence: Float[Tensor, "h w"] | None = None  # > 0


@dataclass(frozen=True)
class PairPrediction:
    """Everything the network says about frames i and j."""

    i: int
    j: int
    view_ii: ViewPrediction
    view_ji: ViewPrediction
    view_ij: ViewPrediction
    view_jj: ViewPrediction


class EncodingCache:
    """Encodings of the images used last, within a bound of memory; a missing one is made anew."""

    def __init__(self, encode: Callable[[int], Encoded], max_bytes: int) -> None:
        self._encode = encode
        self._max_bytes = max_bytes
        self._held: OrderedDict[int, Encoded] = OrderedDict()

    def __getitem__(self, i: int) -> Encoded:
        if i not in self._held:
            self._held[i] = self._encode(i)
            while len(self._held) > 1 and self.bytes > self._max_bytes:
                self._held.popitem(last=False)
        self._held.move_to_end(i)
        return self._held[i]

    @property
    def bytes(self) -> int:
        """Memory of the held tokens on the network's device."""
        return sum(e.tokens.nbytes + e.positions.nbytes for e in self._held.values())


def predict_pairs(
    network: Mast3r,
    image: Callable[[int], Float[Tensor, "3 h w"]],
    pairs: Sequence[tuple[int, int]],
    heads: tuple[bool, bool] = (True, True),
    cache_bytes: int = 1 << 30,
    progress: Progress = silent,
) -> Iterator[PairPrediction]:
    """The pairs' predictions one after another, in the order given.

    `image` gives the network's image (-1..1, see `preprocess.to_network`) of a frame; `heads` says whether pointmaps
    and descriptors are wanted. 1 GiB holds 340 encodings of 512 x 384 pixels in float32.
    """

    def encode(i: int) -> Encoded:
        return network.encode(image(i)[None].to(network.device))

    cache = EncodingCache(encode, cache_bytes)
    for done, (i, j) in enumerate(pairs):
        progress("two-view network", done, len(pairs))
        with torch.no_grad():  # not inference_mode: its tensors could never meet a gradient
            prediction = predict_pair(network, (i, cache[i]), (j, cache[j]), heads)
        yield prediction
    progress("two-view network", len(pairs), len(pairs))


def predict_pair(
    network: Mast3r, first: tuple[int, Encoded], second: tuple[int, Encoded], heads: tuple[bool, bool] = (True, True)
) -> PairPrediction:
    """Both passes over two encoded frames, each given with its number."""
    (i, one), (j, two) = first, second
    view_ii, view_ji = _one_pass(network, one, two, heads)
    view_jj, view_ij = _one_pass(network, two, one, heads)
    return PairPrediction(i, j, view_ii, view_ji, view_ij, view_jj)


def _one_pass(
    network: Mast3r, one: Encoded, two: Encoded, heads: tuple[bool, bool]
) -> tuple[ViewPrediction, ViewPrediction]:
    wants_points, wants_descriptors = heads
    predictions = []
    for which, view in enumerate(network.decode(one, two), start=1):
        maps = {}
        if wants_points:
            points = network.pointmap(view, which)
            maps |= {"points": points.points[0], "confidence": points.confidence[0]}
        if wants_descriptors:
            found = network.descriptors(view, which)
            maps |= {"descriptors": found.descriptors[0], "descriptor_confidence": found.confidence[0]}
        predictions.append(ViewPrediction(**maps))
    return predictions[0], predictions[1]
