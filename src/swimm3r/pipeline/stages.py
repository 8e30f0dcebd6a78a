"""The stages of a run, each made or reused: prepare -> sfm -> splat -> eval."""

import logging
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

from swimm3r import devices
from swimm3r.pipeline import summary as sections
from swimm3r.pipeline.inputs import truth_of
from swimm3r.pipeline.presets import RunSettings
from swimm3r.pipeline.run_record import RunRecord
from swimm3r.pipeline.run_settings import navigation_of_mapping
from swimm3r.pipeline.scores.evaluation import own_scores
from swimm3r.pipeline.scores.scoring import MappedRun, Protocol
from swimm3r.pipeline.stage_keys import StageKey, stage_keys
from swimm3r.prepare import load_frames, read_frames
from swimm3r.progress import Progress
from swimm3r.scale.navigation.navigator import NavigationFile
from swimm3r.scale.rig import has_known_baseline
from swimm3r.scale.run import is_scaled, scale_folder, scale_sections
from swimm3r.scene.frames import Frames
from swimm3r.scene.placement import Navigator
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction, unfiltered_matches
from swimm3r.scene.run_folder import open_run
from swimm3r.sfm import reconstruct
from swimm3r.sfm.between import read_between
from swimm3r.sfm.imported.model_poses import check_model_poses
from swimm3r.sfm.lens import known_lens
from swimm3r.sfm.rectified.frames import RectifiableError
from swimm3r.sfm.rectified.run import (
    given_rectification,
    has_rectified_rows,
    is_rectified,
    rectify_run,
    run_frames,
    run_truth,
    write_masks_as_filmed,
)
from swimm3r.sfm.settings import ColmapModelSettings
from swimm3r.splat import train
from swimm3r.splat.map_file import load_map
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import MapDevice
from swimm3r.splat.training.observer import Observer
from swimm3r.tasks.settings import EngineSettings

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Stages:
    """The stages of one run. Results of a stage are read from disk, to the last bit as a resumed run finds them."""

    record: RunRecord
    source: Path
    settings: RunSettings
    reference: Path | None  # a cameras.json to score against
    map_device: MapDevice
    progress: Progress
    observer: Observer | None
    engine: EngineSettings

    def make(self, last: str) -> None:
        """Make or reuse the stages one after another up to `last`."""
        frames = self._prepare()
        if last == "prepare":
            return
        frames, rec = self._sfm(frames)
        if last == "sfm":
            return
        if last == "eval" and not self._scored():
            self._check_test_poses()
        scene = self._splat(frames, rec)
        if last == "splat":
            return
        folder, own = self.record.folder, Protocol(self.settings.test, self.reference)
        truth = None if self._scored() else truth_of(self.source, self.reference)  # its file may be gone once scored
        truth = run_truth(folder, frames, truth)
        own_scores(
            self.record, MappedRun(folder, frames, rec, scene, self.settings), own, truth, self.progress, reuse=True
        )

    def _scored(self) -> bool:
        return self.record.is_done("eval", self._keys["eval"])

    def _check_test_poses(self) -> None:
        """Raise InputError, before hours of training, where test frames' poses were in a model that is gone."""
        model = self.settings.sfm
        if isinstance(model, ColmapModelSettings) and truth_of(self.source, self.reference) is None:
            check_model_poses(model.model, self.record.folder / "sfm")

    @cached_property
    def _keys(self) -> dict[str, StageKey]:
        return stage_keys(self.record.fingerprint, self.settings, self.reference)

    def _prepare(self) -> Frames:
        folder, lens = self.record.folder / "prepare", partial(known_lens, self.settings.sfm)
        frames = self.record.stage(
            "prepare",
            self._keys["prepare"],
            make=lambda: read_frames(self.source, self.settings.frames, folder, self.progress, lens),
            reuse=lambda: load_frames(folder),
        )
        described = sections.frames_section(frames)
        if self.record.is_done("sfm", self._keys["sfm"]):  # it may work on frames of another size, and warns of more
            self.record.summary["input"] = described | self.record.summary["input"]
        else:
            self.record.summary["input"] |= described
            self.record.summary["warnings"] = [{"what": what, "advice": ""} for what in frames.warnings]
        return frames

    def _sfm(self, prepared: Frames) -> tuple[Frames, Reconstruction]:
        """Structure from motion in the unit of the run, and the frames that it and the map work on."""
        folder, navigation = self.record.folder, navigation_of_mapping(self.settings)
        navigator = None if navigation is None else NavigationFile(navigation)
        self.record.stage(
            "sfm",
            self._keys["sfm"],
            make=lambda: _reconstruct(prepared, self.settings, folder, self.progress, self.engine, navigator),
            reuse=lambda: None,
        )
        frames = run_frames(folder)
        rec = self._recorded(frames)
        if _scaled(self.record, rec, self.settings, self.progress):
            rec = self._recorded(frames)
        return frames, rec

    def _recorded(self, frames: Frames) -> Reconstruction:
        """The reconstruction on disk, with its sections in the record."""
        run, folder = self.record.folder, self.record.folder / "sfm"
        rec, between = load_reconstruction(folder, frames), read_between(folder)
        placed = 0 if between is None else len(between.names)
        found = sections.sfm_sections(rec, frames, unfiltered_matches(folder, rec), placed)
        of_frames = {"rectified": is_rectified(run), "rows_rectified": has_rectified_rows(run)}
        size = {"width": frames.width, "height": frames.height}
        self.record.describe("sfm", {**found, **scale_sections(run, rec), "input": {**size, **of_frames}})
        return rec

    def _splat(self, frames: Frames, rec: Reconstruction) -> SplatMap:
        folder, device = self.record.folder / "splat", self.map_device
        self.record.stage(
            "splat",
            self._keys["splat"],
            make=lambda: train(
                rec, frames, self.settings.splat, folder, self.progress, device, self.observer, self.engine
            ),
            reuse=lambda: None,
        )
        scene = load_map(folder / "map.safetensors").to(devices.for_maps(device))
        self.record.describe("splat", sections.splat_sections(scene, rec, frames, folder))
        return scene


def _reconstruct(
    prepared: Frames,
    settings: RunSettings,
    folder: Path,
    progress: Progress,
    engine: EngineSettings,
    navigator: Navigator | None,
) -> None:
    """Structure from motion of a run, of rectified frames where no lens model explains the prepared ones, or the camera
    turned while their rows were exposed.
    """
    if not is_rectified(folder) and not has_rectified_rows(folder):
        rectification = given_rectification(settings.sfm, prepared)
        if rectification is not None:
            rectify_run(folder, rectification, progress)
    while True:  # once as filmed, and once after each of the two rectifications
        try:
            reconstruct(run_frames(folder), settings.sfm, folder / "sfm", progress, engine, navigator)
            break
        except RectifiableError as error:
            log.info("%s: frames are rectified, and everything from here on works on the rectified ones", error.what)
            rectify_run(folder, error.rectification, progress)
    if is_rectified(folder) or has_rectified_rows(folder):
        write_masks_as_filmed(prepared, folder)


def _scaled(record: RunRecord, rec: Reconstruction, settings: RunSettings, progress: Progress) -> bool:
    """Give the run the unit and the place that its settings or its rig tell; return whether anything was to be done."""
    if not settings.scale.has_sources and not has_known_baseline(rec):
        return False
    record.write()
    run = open_run(record.folder, "sfm")
    if is_scaled(record.folder, run.stages["sfm"].key, settings.scale):
        return False
    scale_folder(record.folder, run, settings.scale, progress)
    record.reread()
    return True
