"""The blocks of a large map on disk, of which a view takes those that it sees, far ones with fewer primitives.

blocks/0003.safetensors holds the primitives of a block, blocks/0003_coarse.safetensors about an eighth as many
(`splat.blocks.coarse`), both in scene units; the map's own file lists them (`splat.map_file`). Blocks that were read
stay in a memory of bounded size, so that a map of any extent is rendered in the memory that its views need.
"""

import shutil
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.devices import CPU
from swimm3r.io.files.atomic import atomic_path
from swimm3r.io.files.damage import Remedy, damaged, guard
from swimm3r.io.files.safe_names import check_name
from swimm3r.io.files.tensor_file import TensorFile, read_tensors, write_tensors
from swimm3r.splat.primitives.beta import BetaPrimitives, select
from swimm3r.splat.primitives.kinds import primitives_from
from swimm3r.splat.projection.view_camera import ViewCamera

SCHEMA = 1  # of a block's files
FOLDER = "blocks"  # beside the map's own file
CACHE_BYTES = 1 << 30
_COARSE_PIXELS = 1.0  # distance of neighbors among a block's few primitives, up to which they stand for all
_SLACK = 0.05  # of the image, around it: splats are blurred, and drawn a little larger than they are

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class BlockEntry:
    """A block as its map lists it; lengths in scene units."""

    file: str  # relative to the map's own
    primitives: int
    coarse: int
    spacing: float  # of neighbors among the coarse ones
    low: Triple  # of the box that holds every primitive with its whole extent
    high: Triple

    def __post_init__(self) -> None:
        check_name(self.file)
        if self.primitives < 0 or self.coarse < 0 or self.spacing < 0:
            raise ValueError(f"{self.file} has {self.primitives} primitives, {self.coarse} at {self.spacing:g}")
        if any(low > high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"the box of {self.file} ends before it begins")

    @property
    def coarse_file(self) -> str:
        """The file of the few primitives."""
        return self.file.removesuffix(".safetensors") + "_coarse.safetensors"

    def is_in(self, view: ViewCamera) -> bool:
        """Return whether the box may reach into a view."""
        corners = torch.cartesian_prod(*(torch.tensor(pair) for pair in zip(self.low, self.high, strict=True)))
        x, y, z = (corners.to(view.R) @ view.R.mT + view.t).unbind(-1)
        if view.fisheye is not None:  # of all that lies ahead; what is beside the image is culled by primitive
            return bool((z > 0).any())
        view = view.widened(_SLACK)
        before_edges = (
            z,
            x * view.fx + view.cx * z,
            (view.width - view.cx) * z - x * view.fx,
            y * view.fy + view.cy * z,
            (view.height - view.cy) * z - y * view.fy,
        )
        return all(bool((side > 0).any()) for side in before_edges)

    def is_far(self, view: ViewCamera) -> bool:
        """Return whether a view cannot tell the few primitives from all."""
        low, high = torch.tensor(self.low).to(view.center), torch.tensor(self.high).to(view.center)
        away = float((view.center - view.center.clamp(low, high)).norm())
        return self.coarse > 0 and self.spacing * max(view.fx, view.fy) <= _COARSE_PIXELS * away


@dataclass(frozen=True)
class _BlockHeader:
    key: str
    entry: BlockEntry | None = None  # none in the file of the few


class PartCache:
    """Primitives by the files they were read from; the least recently used go first; shared between threads."""

    def __init__(self, max_bytes: int = CACHE_BYTES) -> None:
        self.max_bytes = max_bytes
        self._held: OrderedDict[tuple, BetaPrimitives] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def nbytes(self) -> int:
        """The primitives held now."""
        with self._lock:
            return sum(nbytes(p) for p in self._held.values())

    def get(self, key: tuple, load: Callable[[], BetaPrimitives]) -> BetaPrimitives:
        """The primitives under a key, loaded where they are not held."""
        with self._lock:
            if key in self._held:
                self._held.move_to_end(key)
                return self._held[key]
        found = load()
        with self._lock:
            self._held[key] = found
            total = sum(nbytes(p) for p in self._held.values())
            while total > self.max_bytes and len(self._held) > 1:
                total -= nbytes(self._held.popitem(last=False)[1])
        return found


@dataclass(frozen=True, eq=False)
class StoredBlocks:
    """The blocks of a map; their primitives come to `device` when they are asked for."""

    folder: Path  # of the map's own file
    key: str  # of the training that made them
    entries: tuple[BlockEntry, ...]
    device: torch.device = CPU
    kept: Callable[[Float[Tensor, "n 3"]], Bool[Tensor, " n"]] | None = None  # None: all of them
    cache: PartCache = field(default_factory=PartCache)

    def __len__(self) -> int:
        return len(self.entries)

    @property
    def count(self) -> int:
        """Number of primitives of all blocks."""
        return sum(entry.primitives for entry in self.entries)

    def to(self, device: torch.device) -> "StoredBlocks":
        """The same on a device."""
        return replace(self, device=device, cache=PartCache(self.cache.max_bytes))

    def within(self, kept: Callable[[Float[Tensor, "n 3"]], Bool[Tensor, " n"]]) -> "StoredBlocks":
        """The same without the primitives whose centers `kept` denies."""
        return replace(self, kept=kept, cache=PartCache(self.cache.max_bytes))

    def seen_by(self, view: ViewCamera) -> list[BetaPrimitives]:
        """Primitives of the blocks that reach into a view, of far ones the few."""
        seen = [entry for entry in self.entries if entry.primitives and entry.is_in(view)]
        return [self.read(entry, coarse=entry.is_far(view)) for entry in seen]

    def parts(self, *, coarse: bool = False) -> Iterator[BetaPrimitives]:
        """The primitives of one block after another."""
        return (self.read(entry, coarse=coarse) for entry in self.entries if entry.primitives)

    def check_files(self) -> None:
        """Raise InputError where a file is missing."""
        for entry in self.entries:
            for path in (self.folder / entry.file, self.folder / entry.coarse_file):
                with guard(path, _remedy(path)):
                    path.open("rb").close()

    def copy_to(self, folder: Path) -> None:
        """Copy the blocks to another folder, where they are not there already.

        Raises ValueError for blocks that a part was taken of.
        """
        if self.kept is not None:
            raise ValueError("a part of a map in blocks cannot be saved")
        if folder.resolve() == self.folder.resolve():
            return
        for entry in self.entries:
            for file in (entry.file, entry.coarse_file):
                with atomic_path(folder / file) as draft:
                    shutil.copyfile(self.folder / file, draft)

    def read(self, entry: BlockEntry, *, coarse: bool = False) -> BetaPrimitives:
        """The primitives of a block, or the few. Raises InputError for a file that is damaged or missing."""
        file = entry.coarse_file if coarse else entry.file

        def load() -> BetaPrimitives:
            p = read_block(self.folder / file, self.key, entry.coarse if coarse else entry.primitives)
            p = p if self.kept is None else select(p, self.kept(p.xyz))
            return p.to(self.device)

        return self.cache.get((file,), load)


def write_block(path: Path, p: BetaPrimitives, key: str, entry: BlockEntry | None = None) -> None:
    """Write a block's primitives, or the few of it without an `entry`, whole or not at all."""
    tensors = {f"primitives.{name}": values for name, values in p._asdict().items()}
    write_tensors(path, tensors, {"schema": SCHEMA, "key": key, "entry": None if entry is None else asdict(entry)})


def entry_of(folder: Path, file: str, key: str) -> BlockEntry:
    """The entry of a finished block. Raises InputError where its files are damaged, missing or of another key."""
    entry = _read(folder / file, key).about.entry
    if entry is None or entry.file != file:
        raise damaged(folder / file, "it is no block's own file", _remedy(folder / file))
    for name, count in ((entry.file, entry.primitives), (entry.coarse_file, entry.coarse)):
        read_block(folder / name, key, count)
    return entry


def read_block(path: Path, key: str, count: int | None = None) -> BetaPrimitives:
    """Read what `write_block` wrote. Raises InputError for damage, and where key or number are others."""
    stored = _read(path, key)
    with guard(path, _remedy(path)):
        p = primitives_from(stored.tensors, BetaPrimitives, "primitives.", may_be_empty=True)
        if count is not None and len(p.xyz) != count:
            raise ValueError(f"it holds {len(p.xyz)} primitives, and the map lists {count}")
    assert isinstance(p, BetaPrimitives)
    return p


def _read(path: Path, key: str) -> TensorFile[_BlockHeader]:
    stored = read_tensors(path, _BlockHeader, _remedy(path), SCHEMA)
    if stored.about.key != key:
        raise damaged(path, "it is of another training", _remedy(path))
    return stored


def _remedy(path: Path) -> Remedy:
    return Remedy(
        f"remove it and {path.parents[1] / 'map.safetensors'}; the swimm3r command that trained the map trains this"
        " block again, alone",
        cause="the file is damaged, of another training, or of another program",
        fault="is not a block of this map",
    )


def no_primitives() -> BetaPrimitives:
    """The primitives of a static map that has none outside its blocks."""
    return BetaPrimitives(*(torch.zeros(0, *shape) for shape in ((3,), (3,), (3,), (), (4,), (6,), (15,), ())))


def joined(parts: list[BetaPrimitives]) -> BetaPrimitives:
    """Primitives one after another; of one part, itself."""
    return parts[0] if len(parts) == 1 else BetaPrimitives(*(torch.cat(values) for values in zip(*parts, strict=True)))


def nbytes(p: BetaPrimitives) -> int:
    """The memory of primitives."""
    return sum(values.numel() * values.element_size() for values in p)
