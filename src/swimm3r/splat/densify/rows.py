"""Rows of primitives that come, go and change place: one record of a round, and the optimizer's memory after it."""

from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from swimm3r.splat.optimizer import Moments
from swimm3r.splat.primitives.beta import BetaPrimitives, select, trained
from swimm3r.splat.primitives.gaussian import GaussianPrimitives

P = TypeVar("P", BetaPrimitives, GaussianPrimitives)


@dataclass(frozen=True)
class Round(Generic[P]):
    """The primitives after a round of densification, each row traced to the rows before it."""

    primitives: P
    source: Int[Tensor, " n"]  # the row whose values it took
    memory: Int[Tensor, " n"]  # the row whose moments it keeps
    restarted: Int[Tensor, " m"]  # rows whose moments are zeroed
    relocated: int = 0
    added: int = 0

    @property
    def numbers(self) -> dict[str, float]:
        """The counts, for the record of the training."""
        return {"relocated": float(self.relocated), "added": float(self.added)}

    @property
    def changed(self) -> Int[Tensor, " k"]:
        """Rows that start anew or hold what another row held: no gradient from before the round is theirs."""
        rows = torch.arange(len(self.source), device=self.source.device)
        return torch.cat([self.restarted, (self.source != rows).nonzero()[:, 0]]).unique()


def unchanged(p: P) -> Round[P]:
    """A round that has done nothing yet."""
    rows = torch.arange(len(p.xyz), device=p.xyz.device)
    return Round(p, rows, rows, rows[:0])


def in_place(
    p: P, source: Int[Tensor, " n"], before: int, restarted: Int[Tensor, " m"], relocated: int = 0
) -> Round[P]:
    """A round in which rows keep their places, and the moments of those, and new ones follow the `before` there were.

    The new ones are among the `restarted`.
    """
    rows = torch.arange(len(source), device=source.device)
    return Round(p, source, rows.clamp(max=before - 1), restarted, relocated, len(source) - before)


def appended(p: P, more: P) -> Round[P]:
    """Further primitives behind those there are, which are as they were."""
    n = len(p.xyz)
    both: P = p._make(torch.cat(pair) for pair in zip(p, more, strict=True))
    rows = torch.arange(len(both.xyz), device=both.xyz.device)
    return in_place(both, rows, n, rows[n:])


def only(done: Round[P], kept: Bool[Tensor, " n"]) -> Round[P]:
    """The rows that are kept."""
    place = kept.cumsum(0) - 1
    restarted = place[done.restarted[kept[done.restarted]]]
    kept_rows = select(done.primitives, kept)
    return Round(kept_rows, done.source[kept], done.memory[kept], restarted, done.relocated, done.added)


def moments_after(moments: dict[str, Moments], done: Round[P]) -> dict[str, Moments]:
    """The optimizer's memory of the primitives after a round; that of everything else is as it was."""
    kept = dict(moments)
    for name in trained(done.primitives):
        m = moments[name]
        first, second = m.first[done.memory], m.second[done.memory]
        first[done.restarted], second[done.restarted] = 0, 0
        kept[name] = Moments(first, second, m.steps)
    return kept
