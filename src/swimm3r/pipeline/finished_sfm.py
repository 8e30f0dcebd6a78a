"""A run folder whose structure from motion is finished, as the training of its map finds it."""

from dataclasses import dataclass
from pathlib import Path

from swimm3r.pipeline.inputs import truth_of
from swimm3r.pipeline.presets import RunSettings, from_yaml
from swimm3r.pipeline.scores.held_out import FirstPose
from swimm3r.pipeline.scores.scoring import start_poses
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.ground_truth import GroundTruth
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.run_folder import open_run
from swimm3r.sfm.rectified.run import run_frames, run_truth


@dataclass(frozen=True)
class FinishedSfm:
    """A run folder as its map's training finds it."""

    folder: Path
    frames: Frames
    rec: Reconstruction
    settings: RunSettings
    truth: GroundTruth | None
    key: str  # another one where anything before the map is another

    def first_poses(self, progress: Progress = silent) -> dict[str, FirstPose]:
        """Poses from which the refinement of the test frames starts, in the reconstruction's axes."""
        return start_poses(self.folder, self.rec, self.frames, self.settings, self.truth, progress)


def open_finished_sfm(folder: Path, reference: Path | None = None) -> FinishedSfm:
    """Read a run folder up to its map. Raises InputError where structure from motion is not finished."""
    run = open_run(folder, "sfm")
    frames = run_frames(folder)
    return FinishedSfm(
        folder,
        frames,
        load_reconstruction(folder / "sfm", frames),
        from_yaml(folder / "settings.yaml"),
        run_truth(folder, frames, truth_of(Path(run.input.path), reference)),
        run.stages["sfm"].key,
    )
