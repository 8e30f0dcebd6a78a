"""Image retrieval by VLAD descriptors over a vocabulary learned from the clip itself; nothing is downloaded.

VLAD sums, per visual word, what separates a frame's descriptors from the word (Jegou et al. 2010); each word's sum is
normalized, so that one repeated texture cannot drown the rest (Arandjelovic and Zisserman 2013).
"""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

_WORDS = 64
_SAMPLES = 20_000  # descriptors the vocabulary is learned from
_ROUNDS = 10  # of k-means
_ROWS = 256  # frames that are compared with all others at a time


def describe_frames(
    count: int, descriptors_of: Callable[[int], Float[Tensor, "_ 128"]], generator: torch.Generator
) -> Float[Tensor, "c d"]:
    """VLAD descriptors of frames 0..count-1, of unit length or zero, given each frame's descriptors when asked for."""
    share = max(1, _SAMPLES // max(1, count))
    sampled = []
    for i in range(count):
        own = descriptors_of(i)
        sampled.append(own[torch.randperm(len(own), generator=generator)[:share]])
    words = vocabulary(sampled, generator)
    return torch.stack([summed(descriptors_of(i), words) for i in range(count)])


def alike_pairs(described: Float[Tensor, "c d"], count: int, apart: int = 0) -> list[tuple[int, int]]:
    """Each frame with the `count` most similar ones that are more than `apart` frames away, as (i < j), sorted."""
    n = len(described)
    index = torch.arange(n)
    pairs: set[tuple[int, int]] = set()
    for start in range(0, n, _ROWS):
        rows = index[start : start + _ROWS]
        far = (rows[:, None] - index).abs() > apart
        best = (described[rows] @ described.mT).masked_fill(~far, -torch.inf).topk(min(count, n)).indices
        for row, i in enumerate(rows.tolist()):
            pairs |= {(min(i, j), max(i, j)) for j in best[row].tolist() if far[row, j]}
    return sorted(pairs)


def vocabulary(descriptors: Sequence[Float[Tensor, "_ 128"]], generator: torch.Generator) -> Float[Tensor, "k 128"]:
    """Visual words: spherical k-means over a sample of all frames' descriptors; one of zeros where there are none."""
    share = max(1, _SAMPLES // len(descriptors))
    samples = torch.cat([d[torch.randperm(len(d), generator=generator)[:share]] for d in descriptors])
    if len(samples) == 0:
        return samples.new_zeros(1, samples.shape[1])
    words = samples[torch.randperm(len(samples), generator=generator)[:_WORDS]]
    for _ in range(_ROUNDS):
        nearest = (samples @ words.mT).argmax(1)
        sums = torch.zeros_like(words).index_add_(0, nearest, samples)
        words = torch.where(sums.norm(dim=1, keepdim=True) > 0, normalize(sums, dim=1), words)
    return words


def summed(descriptors: Float[Tensor, "n 128"], words: Float[Tensor, "k 128"]) -> Float[Tensor, " d"]:
    """A frame's VLAD descriptor of unit length: per word the normalized sum of what its descriptors differ from it."""
    nearest = (descriptors @ words.mT).argmax(1)
    sums = torch.zeros_like(words).index_add_(0, nearest, descriptors - words[nearest])
    return normalize(normalize(sums, dim=1).flatten(), dim=0)
