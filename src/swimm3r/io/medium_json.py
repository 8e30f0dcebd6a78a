"""medium.json read back: the fitted water per encoding with its uncertainty, or bare coefficients.

`medium.save_fits` writes the first, `Medium.save` the second.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from swimm3r.io.files.damage import Remedy, guard
from swimm3r.io.files.json_file import decode, structure
from swimm3r.lamp import Lamp, LightEvidence
from swimm3r.medium import AttenuationCurve, Encoding, Estimator, Medium, MediumFit

_REMEDY = Remedy(
    "RUN/sfm/medium.json of any run is an example",
    cause="it is of another format, or a crash or an editor damaged it",
    fault="is not a medium.json",
)
_Channels = tuple[float, float, float]
_Pattern = tuple[float, float, float, float, float, float]
_Flags = tuple[bool, bool, bool]


@dataclass(frozen=True)
class MediumRecord:
    """Coefficients of a medium as a file has them, R, G, B."""

    Binf: _Channels
    beta_D: _Channels
    beta_B: _Channels

    def medium(self) -> Medium:
        """The same as tensors."""
        return Medium(torch.tensor(self.Binf), torch.tensor(self.beta_D), torch.tensor(self.beta_B))


@dataclass(frozen=True)
class LampRecord:
    """A lamp as a file has it."""

    position: _Channels
    reference: float
    fall_off: float
    strength: float
    beam: _Pattern
    veil: _Pattern

    def __post_init__(self) -> None:
        if self.reference <= 0 or self.strength <= 0:
            raise ValueError(f"a lamp has a distance and a strength above 0, got {self.reference} and {self.strength}")

    def lamp(self) -> Lamp:
        """The same as tensors."""
        position, beam, veil = (torch.tensor(values) for values in (self.position, self.beam, self.veil))
        return Lamp(position, self.reference, self.fall_off, self.strength, beam, veil)


@dataclass(frozen=True)
class _Curve:
    a: _Channels
    b: _Channels
    c: _Channels
    d: _Channels


@dataclass(frozen=True)
class _Identifiable:
    Binf: _Flags
    beta_D: _Flags
    beta_B: _Flags


@dataclass(frozen=True)
class _Fit:
    medium: MediumRecord
    curve: _Curve
    std: MediumRecord
    identifiable: _Identifiable
    z_range: tuple[float, float]
    encoding: Encoding
    estimator: Estimator = "Sea-Thru"  # earlier versions did not say
    lamp: LampRecord | None = None
    light: LightEvidence | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.z_range[0] <= self.z_range[1]:
            raise ValueError(f"a range of depths grows from 0 on, got {list(self.z_range)}")


def load_medium(path: str | Path, name: Literal["stored", "linear"] | None = None) -> Medium | MediumFit:
    """The medium that `MediumFit.save` or `Medium.save` wrote, or that a run keeps in RUN/sfm/medium.json.

    Of several fits in a file the one of that `name`: on pixel values as stored (by default), or in linear light.
    Raises InputError where the file holds no such medium.
    """
    path = Path(path)
    with guard(path, _REMEDY):
        document = decode(path.read_bytes())
        bare = isinstance(document, dict) and "Binf" in document
        if bare and name is None:
            return structure(document, MediumRecord).medium()
        fits = {} if bare else _fits(document)
        if not fits or name not in (None, *fits):
            raise ValueError(f"it holds no medium named {name}" if name else "it holds no medium")
        return fits[name or ("stored" if "stored" in fits else next(iter(fits)))]


def read_fits(path: Path, remedy: Remedy) -> dict[str, MediumFit]:
    """Read what `medium.save_fits` wrote. Raises the remedy's error, which names the file and the fault."""
    with guard(path, remedy):
        return _fits(decode(path.read_bytes()))


def _fits(document: object) -> dict[str, MediumFit]:
    """The fits of a decoded medium.json. Raises ValueError that names the place of the fault."""

    def tensors(record: _Curve | _Identifiable) -> dict[str, torch.Tensor]:
        return {name: torch.tensor(values) for name, values in vars(record).items()}

    return {
        name: MediumFit(
            **vars(fit.medium.medium()),
            curve=AttenuationCurve(**tensors(fit.curve)),
            std=fit.std.medium(),
            identifiable=tensors(fit.identifiable),
            z_range=fit.z_range,
            encoding=fit.encoding,
            estimator=fit.estimator,
            lamp=None if fit.lamp is None else fit.lamp.lamp(),
            light=fit.light,
        )
        for name, fit in structure(document, dict[str, _Fit]).items()
    }
