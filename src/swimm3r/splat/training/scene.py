"""One scene as the training of its map finds it, in working units."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras
from swimm3r.devices import CPU
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.splat.medium.field import MediumField
from swimm3r.splat.pose_mlp import PoseMlp
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.projection.footprint import footprints
from swimm3r.splat.projection.view_camera import ViewCamera, view_camera
from swimm3r.splat.shared_settings import TrainingPoseSettings
from swimm3r.splat.training.state import State
from swimm3r.splat.training_poses import TrainingPoses
from swimm3r.splat.views import TrainingView, TrainingViews, median_z_depth


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The finished parts of a large map around a block in training; none of it is trained."""

    water: MediumField  # that all blocks share, per working unit
    neighbors: BetaPrimitives  # near the block, drawn with it, working units


@dataclass(frozen=True)
class TrainingScene:
    """A reconstruction and what follows from it."""

    rec: Reconstruction
    scale: float  # working units per scene unit
    radius: float  # of the cameras' path, working units
    views: TrainingViews
    poses: TrainingPoses | None = None  # None where poses are held
    device: torch.device = CPU  # of primitives and water; frames and poses are on the processor
    surroundings: Surroundings | None = None  # of a block of a large map

    @property
    def refined_cameras(self) -> int:
        """Number of refined poses."""
        return 0 if self.poses is None else len(self.poses)

    def codes(self, settings: TrainingPoseSettings, rng: torch.Generator) -> PoseMlp | None:
        """Poses as they are before the first step; None where they are held."""
        return None if self.poses is None else PoseMlp(len(self.poses), settings, rng)

    def view(self, k: int) -> TrainingView:
        """The k-th training image, on the device."""
        return self.views.on(self.device, k)

    def camera(self, view: TrainingView, codes: PoseMlp | None) -> Cameras:
        """A view's camera where training has moved it to."""
        if self.poses is None or codes is None:
            return view.camera
        place = torch.tensor([self.poses.names.index(view.name)])
        return replace(view.camera, cam2world=self.poses.moved(codes, place))

    def pinhole_view(self, view: TrainingView, codes: PoseMlp | None) -> ViewCamera:
        """That camera for drawing."""
        return view_camera(self.camera(view, codes)).to(self.device)

    def epipolar_error(
        self, codes: PoseMlp | None, settings: TrainingPoseSettings, share: float, rng: torch.Generator
    ) -> Float[Tensor, ""] | None:
        """L_epi of some matches, pixels, while it takes part at this share of the run, else None."""
        if self.poses is None or codes is None or share > settings.epipolar_end:
            return None
        return self.poses.epipolar_error(codes, self.poses.matches.some(settings.matches, rng))


def with_footprints(scene: TrainingScene, state: State) -> State:
    """The state with the footprints of its primitives, where they are filtered by them."""
    if scene.views.settings.render.antialiasing == "dilation":
        return state
    measured = footprints(state.primitives.xyz, scene.views.cameras)
    return replace(state, primitives=state.primitives._replace(footprint=measured))


def third_of_depth(scene: TrainingScene) -> float:
    """A third of the scene's median depth, working units: 1 where the scene has no scale and is brought to 3."""
    return median_z_depth(scene.rec) * scene.scale / 3


def path_radius(rec: Reconstruction, scale: float, working_depth: float) -> float:
    """1.1 times the largest distance of a camera from their mean, working units (UBS); a third of the depth at least.

    The floor keeps a camera that hardly moves from freezing its scene.
    """
    centers = rec.cameras.centers
    spread = float(torch.linalg.vector_norm(centers - centers.mean(0), dim=-1).max())
    return max(1.1 * spread * scale, working_depth / 3)
