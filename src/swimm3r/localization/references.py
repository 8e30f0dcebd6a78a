"""The images that a query is first compared with: of every registered pose an image and its depth."""

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import Cameras, unproject
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.splat.rendering import SplatMap


@dataclass(frozen=True)
class Reference:
    """An image whose pixels have known places in the world."""

    camera: Cameras  # one, distortion included
    rgb: Float[Tensor, "h w 3"]
    usable: Bool[Tensor, "h w"]
    z_depth: Float[Tensor, "h w"]  # 0 = unknown

    def points(self, pixels: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, "m 3"], Bool[Tensor, " n"]]:
        """World points of the pixels whose depth is known, and which those are. Centers are at +0.5."""
        column, row = pixels.long().unbind(-1)
        z = self.z_depth[row.clamp(0, self.camera.height - 1), column.clamp(0, self.camera.width - 1)].double()
        known = z > 0
        return unproject(self.camera, pixels[known].double()[None], z[None, known])[0], known


@runtime_checkable  # so that the suite can check calls against it
class References(Protocol):
    """The reference images of a reconstruction, by the names of its frames."""

    def __getitem__(self, name: str) -> Reference: ...


@dataclass(frozen=True)
class FilmedReferences:
    """The training frames with their depth maps."""

    rec: Reconstruction
    frames: Frames

    def __getitem__(self, name: str) -> Reference:
        f = self.frames.index(name)
        camera = self.rec.cameras[self.rec.index(name)]
        nothing = torch.zeros(camera.height, camera.width)
        z_depth = self.rec.depth[name].z_depth if name in self.rec.depth else nothing
        return Reference(camera, self.frames.image(f), self.frames.mask(f), z_depth)


@dataclass(frozen=True)
class RenderedReferences:
    """The map as the training cameras would see it."""

    rec: Reconstruction
    scene: SplatMap
    long_side: int
    min_alpha: float

    def __getitem__(self, name: str) -> Reference:
        return rendered(self.scene, self.rec.cameras[self.rec.index(name)], self.long_side, self.min_alpha)


def rendered(scene: SplatMap, lens: Cameras, long_side: int, min_alpha: float, time: float | None = None) -> Reference:
    """The map from a camera's pose on its pinhole canvas; depth where the map covers at least `min_alpha`.

    A dynamic map is shown at `time`, seconds of its clip, or half way through where nobody knows it.
    """
    canvas = lens.drawn(long_side)
    moment = sum(scene.span) / 2 if time is None else time
    out = scene.render(canvas, moment, backscatter=False, observed=False)
    covered = out.alpha > min_alpha
    camera = replace(canvas, cam2world=canvas.cam2world.double())
    return Reference(camera, out.rgb.clamp(0, 1), torch.ones_like(covered), torch.where(covered, out.z_depth, 0.0))
