"""Image retrieval by VLAD descriptors over a vocabulary learned from the clip itself; nothing is downloaded.

VLAD sums, per visual word, what separates a frame's descriptors from the word (Jegou et al. 2010); each word's sum is
normalized, so that one repeated texture cannot drown the rest (Arandjelovic and Zisserman 2013).
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

_WORDS = 64
_SAMPLES = 20_000  # descriptors the vocabulary is learned from
_ROUNDS = 10  # of k-means


def similarity(descriptors: Sequence[Float[Tensor, "_ 128"]], generator: torch.Generator) -> Float[Tensor, "c c"]:
    """Cosine similarity of all frames, -1..1, given each frame's descriptors."""
    words = vocabulary(descriptors, generator)
    v = torch.stack([summed(d, words) for d in descriptors])
    return v @ v.mT


def alike_pairs(similarity: Float[Tensor, "c c"], count: int, apart: int = 0) -> list[tuple[int, int]]:
    """Each frame with the `count` most similar ones that are more than `apart` frames away, as (i < j), sorted."""
    n = len(similarity)
    index = torch.arange(n)
    far = (index[:, None] - index).abs() > apart
    ranked = similarity.masked_fill(~far, -torch.inf)
    best = ranked.topk(min(count, n)).indices
    return sorted({(min(i, j), max(i, j)) for i in range(n) for j in best[i].tolist() if far[i, j]})


def vocabulary(descriptors: Sequence[Float[Tensor, "_ 128"]], generator: torch.Generator) -> Float[Tensor, "k 128"]:
    """Visual words: spherical k-means over a sample of all frames' descriptors."""
    share = max(1, _SAMPLES // len(descriptors))
    samples = torch.cat([d[torch.randperm(len(d), generator=generator)[:share]] for d in descriptors])
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
