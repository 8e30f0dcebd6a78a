"""A bounded memory of what was read from disk, so that a dive of any length fits a laptop."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import TypeVar

import numpy as np

Arrays = TypeVar("Arrays", bound=tuple[np.ndarray, ...])


class ArrayCache:
    """The least recently used arrays go first once `max_bytes` is exceeded; safe to share between threads.

    `least_entries` stay whatever their size: work that goes back and forth between a few large images needs them all.
    """

    def __init__(self, max_bytes: int, least_entries: int = 1) -> None:
        self.max_bytes, self.least_entries = max_bytes, least_entries
        self._held: OrderedDict[Hashable, tuple[np.ndarray, ...]] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def nbytes(self) -> int:
        """The entries held now."""
        with self._lock:
            return sum(array.nbytes for arrays in self._held.values() for array in arrays)

    def get(self, key: Hashable, load: Callable[[], Arrays]) -> Arrays:
        """The arrays under `key`, loaded when absent. They are shared: whoever changes them copies first."""
        with self._lock:
            if key in self._held:
                self._held.move_to_end(key)
                return self._held[key]  # type: ignore[return-value]
        arrays = load()
        for array in arrays:
            array.flags.writeable = False
        with self._lock:
            self._held[key] = arrays
            total = sum(a.nbytes for held in self._held.values() for a in held)
            while total > self.max_bytes and len(self._held) > self.least_entries:
                _, dropped = self._held.popitem(last=False)
                total -= sum(a.nbytes for a in dropped)
        return arrays
