"""medium.json: the fitted water, per encoding, with its uncertainty."""

import json
from dataclasses import dataclass
from pathlib import Path

import torch

from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.damage import Remedy
from swimm3r.io.files.json_file import read_json
from swimm3r.medium import AttenuationCurve, Encoding, Estimator, Medium, MediumFit


def write_fits(path: Path, fits: dict[str, MediumFit]) -> None:
    """Write named fits ("stored", "linear"); lists are R, G, B."""

    def plain(record: Medium | AttenuationCurve) -> dict[str, list[float]]:
        return {name: value.tolist() for name, value in vars(record).items()}

    document = {
        name: {
            "medium": plain(fit.constant()),
            "curve": plain(fit.curve),
            "std": plain(fit.std),
            "identifiable": {key: flags.tolist() for key, flags in fit.identifiable.items()},
            "z_range": list(fit.z_range),
            "encoding": fit.encoding,
            "estimator": fit.estimator,
        }
        for name, fit in fits.items()
    }
    write_text(path, json.dumps(document, indent=2) + "\n")


_Channels = tuple[float, float, float]
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

    def __post_init__(self) -> None:
        if not 0 <= self.z_range[0] <= self.z_range[1]:
            raise ValueError(f"a range of depths grows from 0 on, got {list(self.z_range)}")


def read_fits(path: Path, remedy: Remedy) -> dict[str, MediumFit]:
    """Read what `write_fits` wrote. Raises the remedy's error, which names the file and the fault."""

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
        )
        for name, fit in read_json(path, dict[str, _Fit], remedy).items()
    }
