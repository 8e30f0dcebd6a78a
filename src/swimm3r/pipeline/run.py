"""The pipeline over a run folder: prepare -> sfm -> splat -> eval, each stage resumable, its record in summary.json.

A stage is reused when its settings and everything before it are unchanged (a hash, the stage's `key`); one that was cut
short goes on from what it left on disk; one whose settings changed is refused or moved away, never removed
(`run_record`).
"""

import json
import logging
import platform
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from swimm3r import devices
from swimm3r.io.files.atomic import write_text
from swimm3r.pipeline.estimate import estimate_run
from swimm3r.pipeline.inputs import check_inputs, input_fingerprint
from swimm3r.pipeline.presets import RunSettings, to_yaml
from swimm3r.pipeline.run_record import open_record
from swimm3r.pipeline.stage_keys import stage_keys
from swimm3r.pipeline.stage_start import StageStart, ignore_stages
from swimm3r.pipeline.stages import Stages
from swimm3r.progress import Progress, watched
from swimm3r.report import write_report
from swimm3r.scale.run import is_scaled
from swimm3r.splat.settings import MapDevice
from swimm3r.splat.training.observer import Observer
from swimm3r.tasks.settings import EngineSettings

log = logging.getLogger(__name__)


def run_pipeline(
    source: str | Path,
    folder: str | Path,
    settings: RunSettings | None = None,
    *,
    redo: bool = False,
    reference: Path | None = None,
    last_stage: str = "eval",
    map_device: MapDevice = "auto",
    progress: Progress | None = None,
    on_stage: Callable[[StageStart], None] = ignore_stages,
    observer: Observer | None = None,
    engine: EngineSettings = EngineSettings(),  # noqa: B008 - records are frozen
) -> dict:
    """Run the stages up to `last_stage` and return the summary (layout: docs/conventions.md).

    `settings` are a preset's (`swimm3r.PRESETS["fast"]`), or changed from one. Without them the run goes by those that
    the folder holds, a new one by the defaults. Stages made with other settings are refused, or with `redo` moved to
    `folder`/old and made again. `reference` is a cameras.json to score against; a synthetic dive brings its own truth.
    A run remembers it, and keeps its scores where the file is gone. An input may be gone once its frames are prepared,
    as where the folder was copied to another computer.
    `map_device` is where the map is trained and rendered. A rough estimate of time and disk is logged first, and
    `on_stage` is told of every stage that starts, `observer` of every step of the map's training. A terminal or a
    notebook shows how far it is, unless `progress` is given (`swimm3r.silent`: nothing). `engine` can spread chunks of
    a long clip, dense depth and blocks of a large map over processes or a cluster.

    Raises the errors of its stages (`swimm3r.errors`), UsageError where settings differ, the folder cannot be written
    to or another process works in it, InputError where it belongs to another input, and StorageError where the disk is
    far too small.
    """
    source, folder = Path(source), Path(folder)
    given = None if reference is None else reference.resolve()
    digest = input_fingerprint(source, folder)
    device = devices.for_maps(map_device)  # before there is a folder, and minutes of structure from motion
    with watched(progress) as told, open_record(folder, source, digest, redo=redo) as record:
        settings, reference = record.settle(settings, given, last_stage)
        superseded = record.superseded(settings, reference)
        keys = stage_keys(record.fingerprint, settings, reference)
        to_do = record.to_do(keys)
        has_sfm = last_stage != "prepare" and "sfm" not in to_do
        scaled = has_sfm and is_scaled(folder, keys["sfm"].key, settings.scale)
        check_inputs(source, settings, reference if "eval" in to_do else given, to_do, scaled=scaled)
        if reference is not None and not reference.exists() and record.is_done("eval", keys["eval"]):
            log.warning("%s is not on this computer: the scores that were taken against it are kept", reference)
        record.set_aside(superseded)
        record.write()
        write_text(folder / "settings.yaml", to_yaml(settings))
        write_text(folder / "versions.json", json.dumps(_versions(), indent=2) + "\n")
        plan = estimate_run(source, folder, settings, to_do, on_cpu=device.type == "cpu")
        record.announce(plan, on_stage)
        Stages(record, source, settings, reference, map_device, told, observer, engine).make(last_stage)
        summary = record.write()
        if last_stage == "eval":
            write_report(folder)
        return summary


def _versions() -> dict[str, str]:
    packages = ("swimm3r", "torch", "numpy", "scipy", "numba", "pycolmap", "opencv-python-headless", "av")
    return {"python": platform.python_version(), "platform": platform.platform()} | {p: version(p) for p in packages}
