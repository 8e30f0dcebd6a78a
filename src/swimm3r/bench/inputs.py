"""Files that decide a cell besides its settings: weights, models, finished reconstructions (for `cells.kept_cell`)."""

from pathlib import Path

from swimm3r import weights
from swimm3r.errors import WeightsError
from swimm3r.io.files.cache_key import content_digest
from swimm3r.pipeline.finished_sfm import FinishedSfm
from swimm3r.sfm.settings import ColmapModelSettings, Mast3rSettings, SfmSettings

_RECONSTRUCTION = ("cameras.json", "medium.json", "reconstruction.json", "matches.npz")


def weights_digest(name: str, explicit: Path | None = None) -> str | None:
    """Of the weights a cell would use; None where there are none, and the complaint where they cannot be used."""
    try:
        return content_digest(weights.find(name, explicit))
    except WeightsError as unfit:
        return unfit.what


def lpips_weights() -> list[str | None]:
    """Without which LPIPS is not computed."""
    return [weights_digest("vgg16"), weights_digest("lpips-vgg")]


def network_weights(settings: Mast3rSettings) -> list[str | None]:
    """Of everything that the network's methods load."""
    found = [weights_digest("mast3r", settings.weights), content_digest(settings.adapter)]
    if settings.similarity == "asmk":
        found += [weights_digest("mast3r-retrieval"), weights_digest("mast3r-codebook")]
    return found


def files_of(settings: SfmSettings) -> list[str | None]:
    """Of the files that settings name or imply; another program's model, known cameras, weights."""
    match settings:
        case Mast3rSettings(known=known):
            return [*network_weights(settings), content_digest(known)]
        case ColmapModelSettings(model=model):
            return [content_digest(model)]
        case _:
            return []


def reconstruction_of(folder: Path, sfm: FinishedSfm) -> list[str | None]:
    """Of a run's structure from motion as it lies on disk: one made again may differ under the same settings."""
    return [sfm.key, *(content_digest(folder / "sfm" / name) for name in _RECONSTRUCTION)]
