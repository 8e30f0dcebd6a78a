"""Scale and place applied to a run folder: estimated, files rescaled, georeference.json, scale.json and summary.json.

The unit of the files becomes the metre. The result of structure from motion has had `metres_per_unit` of scale.json in
all; the same sources again give a factor of 1, and nothing is written but the record.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from swimm3r.errors import UsageError
from swimm3r.io.files.cache_key import cache_key, given_digest
from swimm3r.io.files.damage import Remedy
from swimm3r.io.files.folder_lock import folder_lock
from swimm3r.io.files.json_file import read_json
from swimm3r.progress import Progress, silent
from swimm3r.scale.estimate import RunScale, estimate_scale
from swimm3r.scale.rescale import finish_rescale, rescale_run
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scale.water_table import water_table
from swimm3r.scene.georeference import GEOREFERENCE, Georeference, load_georeference
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.run_folder import RunFolder, open_run
from swimm3r.sfm.rectified.run import run_frames

SCALE = "scale.json"
_SAME = 1e-9  # of a factor: the same sources again, by other roundings
_FILES = ("points", "distances", "marker_file", "laser_dots", "nav", "control")  # settings that name a file
_REMEDY = Remedy("swimm3r scale RUN with the sources it was made from writes it again")


@dataclass(frozen=True)
class ScaleRecord:
    """RUN/scale.json: the section "scale" of summary.json, and what it was made from."""

    key: str
    metres_per_unit: float  # of the result of structure from motion
    section: dict[str, Any]
    sources: dict[str, str] = field(default_factory=dict)  # a digest of each file, by the setting that names it


def scale_run(folder: Path, settings: ScaleSettings, progress: Progress = silent) -> dict[str, Any]:
    """Give a finished run metres and a place, and return the section "scale" of its summary.

    The report is left as it was. Raises InputError and UsageError that name the source and its fault; the run then is
    as before.
    """
    if not (folder / "summary.json").is_file() and not (folder / ".swimm3r-rescale").is_dir():
        open_run(folder, "sfm")
    with folder_lock(folder):
        finished = finish_rescale(folder)
        run = open_run(folder, "sfm")
        if not settings.has_sources:
            record = read_record(folder)
            if finished and record is not None:
                return record.section
            raise UsageError(
                "no source of scale is given",
                cause="swimm3r scale RUN alone finishes a rescaling that was interrupted, and there is none",
                hint="--scale-bar, --markers, --nav or another source; swimm3r scale --help lists them",
            )
        return scale_folder(folder, run, settings, progress)


def scale_folder(folder: Path, run: RunFolder, settings: ScaleSettings, progress: Progress = silent) -> dict[str, Any]:
    """The same for a caller that holds the folder's lock."""
    splat = run.stages.get("splat")
    if splat is not None and splat.status == "running":
        raise UsageError(
            f"the map of {folder} is half trained, and would have to begin anew in another unit",
            cause="its training was interrupted",
            hint=f"swimm3r run {folder} without sources of scale finishes it; then swimm3r scale {folder}",
        )
    frames = run_frames(folder)
    rec = load_reconstruction(folder / "sfm", frames)
    before, record = load_georeference(folder), read_record(folder)
    found = estimate_scale(rec, frames, settings, before, progress)
    factor = found.solution.scale
    if rec.metric and abs(math.log(factor)) < _SAME:
        factor = 1.0
    total = factor * (1.0 if record is None else record.metres_per_unit)
    georeference = replace(found.georeference, scale=1.0)
    section = scale_section(found, georeference, factor, total)
    summary = _summary(run.sections, rec, factor, section)
    digests = _digests(settings)
    new_record = ScaleRecord(_key(run.stages["sfm"].key, settings, digests), total, section, digests)
    texts = {
        GEOREFERENCE: _json(asdict(georeference)),
        SCALE: _json(asdict(new_record)),
        "summary.json": _json(summary),
    }
    exports = rescale_run(folder, factor, texts, progress)
    if exports:
        section = {**section, "files_in_old_unit": list(exports)}
    return section


def read_record(folder: Path) -> ScaleRecord | None:
    """RUN/scale.json, None where there is none."""
    path = folder / SCALE
    return read_json(path, ScaleRecord, _REMEDY) if path.is_file() else None


def is_scaled(folder: Path, sfm_key: str, settings: ScaleSettings) -> bool:
    """Return whether a run, whose structure from motion has this key, has the unit and the place of these sources.

    Their files are as they were, or not on this computer, as where the folder was copied to another.
    """
    record = read_record(folder)
    return record is not None and record.key == _key(sfm_key, settings, _digests(settings, record.sources))


def _key(sfm_key: str, settings: ScaleSettings, digests: Mapping[str, str]) -> str:
    """A digest of settings, of the files they name, and of the result that they are about."""
    values = {name: str(value) for name, value in asdict(settings).items()}
    return cache_key(values, dict(digests), sfm_key)[:16]


def _digests(settings: ScaleSettings, missing: Mapping[str, str] = MappingProxyType({})) -> dict[str, str]:
    """Of the content of each file that settings name; of those that are not on this computer, the given ones."""
    found = {name: given_digest(path) or missing.get(name) for name in _FILES if (path := getattr(settings, name))}
    return {name: digest for name, digest in found.items() if digest is not None}


def scale_sections(folder: Path, rec: Reconstruction) -> dict[str, Any]:
    """Sections "scale" and "water" of a run that has them, from its scale.json; none else."""
    record = read_record(folder)
    if record is None:
        return {}
    fit = rec.medium_linear or rec.medium
    water = {} if fit is None else {"water": water_table(fit, record.section["std"])}
    return {"scale": record.section, **water}


def scale_section(found: RunScale, georeference: Georeference, factor: float, total: float) -> dict[str, Any]:
    """The section "scale": the factor of this command, the scale in all, every source, and the place."""
    solution = found.solution
    section: dict[str, Any] = {
        "unit": "m",
        "factor": factor,
        "metres_per_unit": total,
        "std": solution.std,
        "sources": [
            {
                "source": each.estimate.source,
                "scale": each.estimate.scale,
                "std": each.estimate.std,
                "residual": each.residual,
                "residual_in_std": each.in_std,
                "outlier": each.is_outlier,
                "detail": each.estimate.detail,
            }
            for each in solution.sources
        ],
        "notes": [*_outlier_notes(found), *found.notes],
        "georeference": {
            "crs": "local" if georeference.epsg is None else f"EPSG:{georeference.epsg}",
            "origin_m": list(georeference.origin),
            "origin_std_m": None if georeference.origin_std is None else list(georeference.origin_std),
            "rotation_std_deg": None if georeference.rotation_std_deg is None else list(georeference.rotation_std_deg),
            "latitude_longitude_deg": None if georeference.geodetic is None else list(georeference.geodetic),
        },
    }
    if found.navigation is not None:
        section["navigation"] = _navigation_section(found)
    if found.control is not None:
        section["control"] = {
            "control_rms_m": found.control.rms("control"),
            "check_rms_m": found.control.rms("check"),
            "points": [asdict(point) for point in found.control.points],
        }
    return section


def _outlier_notes(found: RunScale) -> list[str]:
    return [
        f"{each.estimate.source} says {each.estimate.scale:.5g} m per unit, {100 * each.residual:+.1f}% or"
        f" {abs(each.in_std):.1f} of its standard deviations from the others: it is an outlier."
        for each in found.solution.outliers
    ]


def _navigation_section(found: RunScale) -> dict[str, Any]:
    fit = found.navigation
    assert fit is not None
    a, offset = fit.alignment, fit.offset
    shift = None if offset is None else offset.seconds
    return {
        "file": str(fit.path),
        "positions": len(fit.matched.frame),
        "matched_by": fit.by,
        "offset_s": shift,
        "offset_std_s": offset.std if offset is not None and fit.offset_found and math.isfinite(offset.std) else None,
        "rms_m": a.rms,
        "outliers": int(a.outliers.sum()),
        "residual_std_m": [float(v) if np.isfinite(v) else None for v in np.median(a.std, axis=0)],
        "attitude_rms_deg": a.attitude_residual_deg,
    }


def _summary(sections: dict[str, Any], rec: Reconstruction, factor: float, section: dict[str, Any]) -> dict[str, Any]:
    """summary.json in the new unit: coefficients of the water, the metric flag, scale and water table."""
    from swimm3r.medium import rescale

    changed = {**sections, "scale": section}
    if "sfm" in sections:
        changed["sfm"] = {**sections["sfm"], "metric": True}
    if "medium" in sections:
        changed["medium"] = {name: _in_metres(each, factor) for name, each in sections["medium"].items()}
    fit = rec.medium_linear or rec.medium
    if fit is not None:
        changed["water"] = water_table(rescale(fit, factor), section["std"])
    return changed


def _in_metres(medium: dict[str, Any], factor: float) -> dict[str, Any]:
    betas = {name: [value / factor for value in medium[name]] for name in ("beta_D", "beta_B") if name in medium}
    return {**medium, **betas, "unit": "1/m"}


def _json(document: Any) -> str:
    return json.dumps(document, indent=2) + "\n"
