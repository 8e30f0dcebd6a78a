"""The last stage: a run's map rendered and scored on its test frames, and the flight along the dive.

A protocol is where the poses of the test frames come from and how they are refined. The run's own is that of its
settings and its reference; scores by any other stand beside its own, never in their place.
"""

import re
from dataclasses import asdict, dataclass
from pathlib import Path

from swimm3r.io.files.cache_key import cache_key
from swimm3r.io.view_names import view_stems
from swimm3r.pipeline import summary as sections
from swimm3r.pipeline.camera_paths import rows_of_one_camera
from swimm3r.pipeline.presets import RunSettings
from swimm3r.pipeline.renders import display_style, write_flythrough
from swimm3r.pipeline.scores import held_out
from swimm3r.pipeline.scores.restored import restored_section
from swimm3r.pipeline.scores.truth import truth_section
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.imported.model_poses import model_poses
from swimm3r.sfm.settings import ColmapModelSettings
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import PoseRefinementSettings
from swimm3r.splat.training_poses import as_mapped

_FLIGHT = 90  # images of the fly-through


@dataclass(frozen=True)
class Protocol:
    """Placement of the test frames before they are scored."""

    test: PoseRefinementSettings
    reference: Path | None = None  # a cameras.json that poses start at and are compared with

    def key_beside(self, own: "Protocol") -> str:
        """Differences from a run's own protocol as a folder's name: steps-20; empty without any."""
        parts = [
            f"{name.replace('_', '-')}-{value}"
            for name, value in asdict(self.test).items()
            if value != getattr(own.test, name)
        ]
        if self.reference != own.reference:
            digest = cache_key(self.reference)[:8]
            parts.append("no-reference" if self.reference is None else f"reference-{self.reference.stem}-{digest}")
        return re.sub(r"[^\w.-]+", "-", "_".join(parts))


@dataclass(frozen=True)
class MappedRun:
    """A run folder with a finished map."""

    folder: Path
    frames: Frames
    rec: Reconstruction
    scene: SplatMap
    settings: RunSettings


def start_poses(
    folder: Path,
    rec: Reconstruction,
    frames: Frames,
    settings: RunSettings,
    truth: GroundTruth | None,
    progress: Progress = silent,
) -> dict[str, held_out.FirstPose]:
    """Poses from which the refinement of a run's test frames starts, in the reconstruction's axes: the truth's where
    known. Without a truth, at those of the model that the reconstruction was imported from.
    """
    if truth is None and isinstance(settings.sfm, ColmapModelSettings):
        names, cameras = model_poses(frames, settings.sfm.model, folder / "sfm")
        truth = GroundTruth(names, cameras, metric=False)
    return held_out.first_poses(rec, frames, settings.sfm.features, truth, progress)


def score_map(
    run: MappedRun, test: PoseRefinementSettings, truth: GroundTruth | None, into: Path, progress: Progress = silent
) -> dict[str, dict | None]:
    """The sections "test", "restored" (of the map) and "truth" by a protocol; the views it renders go to `into`."""
    frames, rec, scene, restore = run.frames, run.rec, run.scene, run.settings.sfm.restore
    poses = held_out.in_axes_of(scene, rec, start_poses(run.folder, rec, frames, run.settings, truth, progress))
    views = held_out.score_views(scene, rec, frames, poses, into, test, restore, progress, truth)
    stems = view_stems(frames.names)
    physical, shown = ([into / f"{stems[v.name]}_{kind}.png" for v in views] for kind in ("clear_physical", "clear"))
    return {
        "test": sections.test_section(views, test, scene.colors, [n for n in frames.test.names if n not in poses]),
        "restored": {"splat": restored_section(physical, shown, progress)},
        "truth": truth_section(rec, frames, truth, scene, views, progress) if truth else None,
    }


def score_restored_frames(run: MappedRun, progress: Progress = silent) -> dict[str, object]:
    """The entry "sfm" of the section "restored"."""
    physical, shown = (
        [run.folder / "sfm" / folder / f"{name}.png" for name in run.rec.names]
        for folder in ("restored_physical", "restored")
    )
    return restored_section(physical, shown, progress)


def film_flight(run: MappedRun, progress: Progress = silent) -> None:
    """Write RUN/renders/flythrough.mp4, at the size the map was trained at."""
    scene, path = run.scene, as_mapped(run.rec, run.scene.poses)
    rows = rows_of_one_camera(path.names, run.frames)
    lens = path.cameras[rows[0]]
    canvas = lens.drawn(scene.settings.long_side)
    write_flythrough(
        run.folder / "renders" / "flythrough.mp4",
        scene,
        held_out.cut(canvas, held_out.visible_window(lens, canvas)),
        path.cameras.cam2world[rows],
        run.frames.times_of([path.names[i] for i in rows]),
        _FLIGHT,
        display_style(scene, run.rec, run.settings.sfm.restore),
        progress,
    )
