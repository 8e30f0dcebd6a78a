"""Outcome of each dive of a batch: rows of results.csv."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from swimm3r.batch.dive import Dive
from swimm3r.errors import InputError, UsageError
from swimm3r.io import medium_json
from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.damage import remake
from swimm3r.pipeline.presets import from_yaml
from swimm3r.pipeline.run_settings import with_stages_of
from swimm3r.pipeline.stage_keys import stage_keys
from swimm3r.prepare.image_folder import source_digest
from swimm3r.report.verdict import water_verdict
from swimm3r.scale.run import is_scaled
from swimm3r.scene.run_folder import STAGES, is_run, read_run
from swimm3r.tasks import Failure

Status = Literal["finished", "failed", "waiting"]


@dataclass(frozen=True)
class Row:
    """One dive; what is not known is None or empty."""

    name: str
    status: Status
    frames: int | None = None
    registered: int | None = None
    psnr: float | None = None
    ssim: float | None = None
    sharpness: float | None = None
    medium: str = ""
    """The water in one sentence."""
    seconds: float | None = None
    cpu_seconds: float | None = None
    peak_mb: int | None = None
    warnings: int = 0
    error: str = ""
    cause: str = ""
    hint: str = ""
    exit_code: int | None = None
    log: str = ""


def is_finished(dive: Dive, out: Path, last_stage: str) -> bool:
    """Return whether a dive's run is there up to the last stage, of this input and with these settings."""
    folder = out / dive.name
    if not is_run(folder):
        return False
    try:
        run, held = read_run(folder), from_yaml(folder / "settings.yaml")
    except InputError:
        return False  # the run itself says what is wrong with its folder
    stages = STAGES[: STAGES.index(last_stage) + 1]
    if not all(run.is_finished(stage) for stage in stages):
        return False
    if run.input.fingerprint != source_digest(dive.source, leave_out=folder):
        return False
    settings = with_stages_of(dive.settings, held, STAGES[len(stages) :])
    scored = run.stages.get("eval")
    known = Path(scored.reference) if scored is not None and scored.reference else None
    known = known if dive.reference is None else dive.reference.resolve()
    keys = stage_keys(run.input.fingerprint, settings, known)
    made = all(keys[stage].is_of(run.stages[stage]) for stage in stages)
    return made and (
        "sfm" not in stages or not settings.scale.has_sources or is_scaled(folder, keys["sfm"].key, settings.scale)
    )


def row_of(dive: Dive, out: Path, status: Status, failure: Failure | None = None) -> Row:
    """The row of a dive, by what its run folder holds."""
    found = _facts(out / dive.name) if is_run(out / dive.name) else {}
    if failure is not None:
        error = failure.error
        found |= {"error": error.what, "cause": error.cause, "hint": error.hint, "exit_code": error.exit_code}
        found["log"] = "" if failure.log is None else failure.log.relative_to(out).as_posix()
    return Row(dive.name, status, **found)


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """Write the rows as a table; numbers are rounded to what they mean."""
    file = io.StringIO()
    table = csv.writer(file, lineterminator="\n")
    names = [field.name for field in fields(Row)]
    table.writerow(names)
    table.writerows([_shown(name, getattr(row, name)) for name in names] for row in rows)
    write_text(path, file.getvalue())


def check_ours(path: Path) -> None:
    """Raise UsageError where a results.csv is there that no batch wrote."""
    if path.is_file() and not path.read_text(encoding="utf-8", errors="replace").startswith("name,status,"):
        raise UsageError(
            f"{path} is another table, which would be overwritten",
            cause="--out names a folder with other things in it",
            hint="another --out, or move the file",
        )


def _facts(folder: Path) -> dict[str, Any]:
    try:
        summary = read_run(folder).sections
    except InputError:
        return {}  # of another version, or damaged: the failure that stands beside it says so
    stages = [stage for stage in summary["stages"].values() if stage.get("status") == "done"]
    peaks = [stage["peak_mb"] for stage in stages if stage.get("peak_mb") is not None]
    sfm, test = summary.get("sfm") or {}, summary.get("test") or {}
    return {
        "frames": summary["input"].get("frames"),
        "registered": sfm.get("registered"),
        **{name: test.get(name) for name in ("psnr", "ssim", "sharpness")},
        "medium": _water(folder, summary) if sfm else "",
        "seconds": sum(stage.get("seconds", 0.0) for stage in stages),
        "cpu_seconds": sum(stage.get("cpu_seconds", 0.0) for stage in stages),
        "peak_mb": max(peaks, default=None),
        "warnings": len(summary.get("warnings", ())),
    }


def _water(folder: Path, summary: dict[str, Any]) -> str:
    path = folder / "sfm" / "medium.json"
    try:
        fits = medium_json.read_fits(path, remake(path)) if path.is_file() else {}
    except InputError:
        return ""  # damaged, which is the matter of that run alone
    gray = bool(summary["input"].get("gray"))
    return water_verdict(fits.get("linear") or fits.get("stored"), metric=summary["sfm"]["metric"], gray=gray)


def _shown(name: str, value: object) -> object:
    if isinstance(value, float):
        return f"{value:.{1 if name.endswith('seconds') else 4 if name == 'ssim' else 3}f}"
    return "" if value is None else value
