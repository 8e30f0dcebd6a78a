"""The teacher's features of each pair, computed in the first epoch and read from disk in the others.

The teacher always sees the same crop of the same clear images, water or not, so what it says of a pair never changes.
A file is named by a hash of the images' pixels: images that do change find nothing. Features are kept in half
precision, and rounded to it before their first use, too: every epoch compares with the same numbers, and a training
that was interrupted ends with the same bits.
"""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.errors import InputError
from swimm3r.io.files.cache_key import bytes_digest
from swimm3r.io.files.damage import remake
from swimm3r.io.files.tensor_file import read_tensors, write_tensors
from swimm3r.sfm.student.losses import PairFeatures
from swimm3r.sfm.student.student import Student

_LEVELS = ("encoder", "decoder", "descriptors")


class TeacherCache:
    """Features by pair, in a folder of at most so many bytes; pairs beyond that are computed each time."""

    def __init__(self, folder: Path, max_bytes: int) -> None:
        self._folder = folder
        self._room = max_bytes - sum(path.stat().st_size for path in folder.glob("*.safetensors"))

    def features(self, student: Student, clean: Float[Tensor, "b 2 3 h w"]) -> PairFeatures:
        """The teacher's features of the clear images of pairs, on their device."""
        stored = [self._read(images) for images in clean]
        missing = [k for k, found in enumerate(stored) if found is None]
        if missing:
            made = student.teacher(clean[missing])
            for row, k in enumerate(missing):
                one = {
                    f"{level}.{i}": value[row].half()
                    for level in _LEVELS
                    for i, value in enumerate(getattr(made, level))
                }
                stored[k] = one
                self._write(clean[k], one)
        return PairFeatures(*(self._stacked(stored, level, clean.device) for level in _LEVELS))

    @staticmethod
    def _stacked(stored: list, level: str, device: torch.device) -> tuple[Tensor, ...]:
        names = sorted((name for name in stored[0] if name.startswith(level)), key=lambda name: int(name.split(".")[1]))
        return tuple(torch.stack([one[name].to(device).float() for one in stored]) for name in names)

    def _path(self, images: Tensor) -> Path:
        pixels = images.detach().cpu().contiguous().numpy().tobytes()
        return self._folder / f"{bytes_digest(pixels)}.safetensors"

    def _read(self, images: Tensor) -> dict[str, Tensor] | None:
        path = self._path(images)
        if not path.is_file():
            return None
        try:
            return read_tensors(path, dict[str, str], remake(path), None, finite=False).tensors
        except InputError:  # damaged: made anew, which gives the same numbers
            return None

    def _write(self, images: Tensor, features: dict[str, Tensor]) -> None:
        size = sum(value.nbytes for value in features.values())
        if size > self._room:
            return
        self._room -= size
        write_tensors(self._path(images), features, {})
