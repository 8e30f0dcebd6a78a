"""Keys of the stages of a run: the settings that decided a result, and the content of the files that these name.

A file that is not on this computer counts as it was when the stage was made, as where a run is copied to another
computer without it. So does one whose content was not recorded, in runs of earlier versions.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from swimm3r.io.calibration.run import lens_digest
from swimm3r.io.files.cache_key import cache_key, given_digest
from swimm3r.io.imports.read import model_path
from swimm3r.pipeline.presets import RunSettings
from swimm3r.pipeline.run_settings import files_by_stage, settings_by_stage
from swimm3r.scene.run_folder import StageRecord


@dataclass(frozen=True)
class StageKey:
    """The settings of a stage and of those before it, and the files that they name."""

    key: str  # a hash of the settings
    files: Mapping[str, str] = field(default_factory=dict)  # digests of those on this computer, by the setting

    def is_of(self, record: StageRecord) -> bool:
        """Return whether a stage was made with this key."""
        return record.key == self.key and not self.changed_files(record)

    def changed_files(self, record: StageRecord) -> list[str]:
        """The settings whose files have other content than those that a stage was made from."""
        return [name for name, digest in self.files.items() if record.files.get(name, digest) != digest]

    def entry(self, record: StageRecord | None) -> dict[str, object]:
        """The key as summary.json has it; files that are not on this computer as in the record before."""
        files = {**({} if record is None else record.files), **self.files}
        return {"key": self.key, **({"files": files} if files else {})}


def stage_keys(fingerprint: str, settings: RunSettings, reference: Path | None) -> dict[str, StageKey]:
    """The key of every stage; of files over 64 MiB and of folders, samples are hashed (`given_digest`)."""
    keys, before, files = {}, fingerprint, {}
    named = files_by_stage(settings, reference)
    for stage, values in settings_by_stage(settings).items():
        if stage == "eval":
            values = {"reference": str(reference), "test": values}
        before = cache_key(stage, before, values)[:16]
        digests = {name: _digest(name, path) for name, path in named[stage].items()}
        files = {**files, **{name: digest for name, digest in digests.items() if digest is not None}}
        keys[stage] = StageKey(before, files)
    return keys


def _digest(name: str, path: Path) -> str | None:
    """Of what a setting reads of the file or folder that it names; None where that is not on this computer."""
    match name:
        case "sfm.lens_from":
            return lens_digest(path)
        case "sfm.model" | "sfm.known":
            found = model_path(path)
            return None if found is None else given_digest(found)
        case _:
            return given_digest(path)
