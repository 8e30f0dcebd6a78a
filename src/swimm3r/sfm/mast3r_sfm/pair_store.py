"""The network's results on disk: matches per pair, one canonical view per frame.

Pointmaps are 6 MB each and every pair has four, so none is kept: they are added to their frame's running sums
(`canonical`) and forgotten. Sums of frames whose pairs are not all done are held in memory up to a bound, then on disk;
they carry the names of the partners already added, so that a killed run adds nothing twice and leaves nothing out.
"""

import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.io.files.cache_key import cache_key
from swimm3r.io.files.damage import guard, remake
from swimm3r.io.files.tensor_file import read_tensors, write_tensors
from swimm3r.sfm.alignment.canonical import (
    AnchoredFrame,
    CanonicalSums,
    CanonicalView,
    add_pass,
    anchored_frame,
    canonical_view,
)
from swimm3r.sfm.alignment.problem import Predicted
from swimm3r.sfm.mast3r.matching import PixelMatches

_FLUSH_SECONDS = 60.0  # of work that a kill may cost


@dataclass(frozen=True)
class PairRecord:
    """The stored record of a pair; predicted anchors only where its matches are too weak for the alignment."""

    matches: PixelMatches
    i_in_j: Predicted | None = None
    j_in_i: Predicted | None = None


@dataclass(frozen=True)
class FrameRecord:
    """The stored record of a frame once all its pairs are done."""

    anchored: AnchoredFrame
    view: CanonicalView  # its points are not kept: zero


@dataclass(frozen=True)
class _ViewHeader:
    focal: float
    mean_confidence: float


@dataclass(frozen=True)
class _SumsHeader:
    done: tuple[str, ...]  # names of the partners already added


class PairStore:
    """Matches of pairs, by the names of both frames."""

    def __init__(self, folder: Path, settings_key: str) -> None:
        self.folder = folder
        self.settings_key = settings_key  # of everything but the frames that decides the matches

    def path(self, name_i: str, name_j: str) -> Path:
        """File of the record of a pair."""
        return self.folder / f"{cache_key(name_i, name_j, self.settings_key)}.safetensors"

    def has(self, name_i: str, name_j: str) -> bool:
        """Return whether a pair is done."""
        return self.path(name_i, name_j).is_file()

    def write(self, name_i: str, name_j: str, record: PairRecord) -> None:
        """Keep a pair."""
        m = record.matches
        kept = {"xy1": m.xy1.to(torch.uint16), "xy2": m.xy2.to(torch.uint16), "confidence": m.confidence.float()}
        for side in ("i_in_j", "j_in_i"):
            predicted = getattr(record, side)
            if predicted is not None:
                kept[f"{side}_points"] = predicted.points.float()
                kept[f"{side}_confidence"] = predicted.confidence.float()
        write_tensors(self.path(name_i, name_j), kept, {})

    def read(self, name_i: str, name_j: str) -> PairRecord:
        """A pair that is done."""
        path = self.path(name_i, name_j)
        with guard(path, remake(path)):
            kept = read_tensors(path, dict[str, str], remake(path), None).tensors
            sides = [
                Predicted(kept[f"{side}_points"], kept[f"{side}_confidence"]) if f"{side}_points" in kept else None
                for side in ("i_in_j", "j_in_i")
            ]
            matches = PixelMatches(kept["xy1"].long(), kept["xy2"].long(), kept["confidence"])
        return PairRecord(matches, *sides)


class FrameStore:
    """Running sums of frames until all their partners have been added, then their canonical views."""

    def __init__(
        self,
        folder: Path,
        names: Sequence[str],
        partners: Sequence[set[int]],
        max_bytes: int,
        subsample: int = 8,
        pixel_center: float = 0.5,
    ) -> None:
        self.folder = folder
        self.names = names
        self.partners = partners
        self.subsample, self.pixel_center = subsample, pixel_center
        self._max_bytes = max_bytes
        self._held: OrderedDict[int, CanonicalSums] = OrderedDict()
        self._done: dict[int, set[int]] = {}  # of frames looked at, the partners already added
        self._unsaved: set[int] = set()
        self._finished: set[int] = set()
        self._saved_at = time.monotonic()

    def has(self, i: int, partner: int) -> bool:
        """Return whether the pass of frame i with a partner has been added."""
        if i in self._finished or self._view_path(i).is_file():
            self._finished.add(i)
            return True
        if i not in self._done:
            self._sums(i)
            self._make_room()
        return partner in self._done[i]

    def add(self, i: int, partner: int, points: Float[Tensor, "h w 3"], confidence: Float[Tensor, "h w"]) -> None:
        """Add a pass of frame i, once. Raises WeightsError for a pointmap that is not finite."""
        if self.has(i, partner):
            return
        self._held[i] = add_pass(self._sums(i), points, confidence, self.subsample)
        self._done[i].add(partner)
        self._held.move_to_end(i)
        self._unsaved.add(i)
        if self._done[i] >= self.partners[i]:
            self._finish(i)
        self._make_room()
        if time.monotonic() - self._saved_at > _FLUSH_SECONDS:
            self.flush()

    def flush(self) -> None:
        """Write what is only in memory."""
        for i in list(self._unsaved):
            self._save(i)
        self._saved_at = time.monotonic()

    def read(self, i: int) -> FrameRecord:
        """A frame all of whose partners were added."""
        path = self._view_path(i)
        with guard(path, remake(path)):
            stored = read_tensors(path, _ViewHeader, remake(path), None)
            names = ("relative_depth", "confidence", "anchor_depth")
            relative, confidence, anchors = (stored.tensors[name] for name in names)
        focal, mean = stored.about.focal, stored.about.mean_confidence
        view = CanonicalView(torch.zeros(1, 1, 1).expand(*confidence.shape, 3), relative, confidence)
        height, width = confidence.shape
        return FrameRecord(AnchoredFrame(height, width, focal, anchors, mean), view)

    def _make_room(self) -> None:
        while len(self._held) > 1 and sum(map(_bytes, self._held.values())) > self._max_bytes:
            self._save(next(iter(self._held)))
            self._held.popitem(last=False)

    def _sums(self, i: int) -> CanonicalSums | None:
        if i in self._held:
            self._held.move_to_end(i)
            return self._held[i]
        path = self._sums_path(i)
        if not path.is_file():
            self._done[i] = set()
            return None
        with guard(path, remake(path)):
            stored = read_tensors(path, _SumsHeader, remake(path), None)
            arrays = [stored.tensors[field.name] for field in fields(CanonicalSums)[1:]]
        done = set(stored.about.done)
        self._done[i] = {p for p in self.partners[i] if self.names[p] in done}
        self._held[i] = CanonicalSums(len(done), *arrays)
        return self._held[i]

    def _save(self, i: int) -> None:
        if i not in self._unsaved:
            return
        sums = self._held[i]
        arrays = {field.name: getattr(sums, field.name) for field in fields(sums)[1:]}
        header = _SumsHeader(tuple(self.names[p] for p in sorted(self._done[i])))
        write_tensors(self._sums_path(i), arrays, asdict(header))
        self._unsaved.discard(i)

    def _finish(self, i: int) -> None:
        sums = self._held.pop(i)
        self._unsaved.discard(i)
        view = canonical_view(sums, self.subsample)
        frame = anchored_frame(view, self.subsample, self.pixel_center)
        kept = {
            "relative_depth": view.relative_depth,
            "confidence": view.confidence,
            "anchor_depth": frame.anchor_depth,
        }
        write_tensors(self._view_path(i), kept, asdict(_ViewHeader(frame.focal, frame.confidence)))
        self._sums_path(i).unlink(missing_ok=True)
        self._finished.add(i)

    def _view_path(self, i: int) -> Path:
        return self.folder / f"{self._name(i)}.view.safetensors"

    def _sums_path(self, i: int) -> Path:
        return self.folder / f"{self._name(i)}.sums.safetensors"

    def _name(self, i: int) -> str:
        """Of the frame and everything it is averaged over."""
        others = sorted(self.names[p] for p in self.partners[i])
        return cache_key(self.names[i], *others, self.subsample, self.pixel_center)


def _bytes(sums: CanonicalSums) -> int:
    return sum(value.nbytes for value in vars(sums).values() if isinstance(value, Tensor))
