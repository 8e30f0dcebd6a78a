"""medium.json: the fitted water, per encoding, with its uncertainty."""

import json
from pathlib import Path

import torch

from swimm3r.io.atomic import write_text
from swimm3r.medium import AttenuationCurve, Medium, MediumFit


def write_fits(path: Path, fits: dict[str, MediumFit]) -> None:
    """Write named fits ("stored", "linear"); lists are R, G, B."""

    def plain(record: Medium | AttenuationCurve) -> dict[str, list[float]]:
        return {name: value.tolist() for name, value in vars(record).items()}

    document = {
        name: {
            "medium": plain(fit.medium),
            "curve": plain(fit.curve),
            "std": plain(fit.std),
            "identifiable": {key: flags.tolist() for key, flags in fit.identifiable.items()},
            "z_range": list(fit.z_range),
            "encoding": fit.encoding,
        }
        for name, fit in fits.items()
    }
    write_text(path, json.dumps(document, indent=2) + "\n")


def read_fits(path: Path) -> dict[str, MediumFit]:
    """Read what `write_fits` wrote."""

    def tensors(record: dict) -> dict[str, torch.Tensor]:
        return {name: torch.tensor(value) for name, value in record.items()}

    document = json.loads(path.read_text(encoding="utf-8"))
    return {
        name: MediumFit(
            medium=Medium(**tensors(fit["medium"])),
            curve=AttenuationCurve(**tensors(fit["curve"])),
            std=Medium(**tensors(fit["std"])),
            identifiable=tensors(fit["identifiable"]),
            z_range=(fit["z_range"][0], fit["z_range"][1]),
            encoding=fit["encoding"],
        )
        for name, fit in document.items()
    }
