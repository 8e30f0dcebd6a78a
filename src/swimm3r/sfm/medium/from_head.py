"""The water of a dive as the physics head read it: kept per frame, laid over prepared frames, summed up for the dive.

    folder/NAME.npz     Binf [3], beta_B [3], and a, b, c, d of beta_D(z) = a e^{bz} + c e^{dz} per 8 x 8 network pixels

in the reconstruction's unit: the head speaks of the network's metres, the alignment scales each frame, and the water
with it. The dive's fit is the median over frames; its curve is one exponential through the frames' beta_D at the depths
they see.

That frames agree is no sign that they are right: a head that always says the same agrees with itself. A coefficient's
standard deviation is therefore the head's own error, measured on held-out pairs whose water was known (`HeadFacts`),
and the frames' spread, added in squares; it counts as identifiable where that is small. Without a measured error
nothing is identifiable, and every standard deviation is as large as the coefficient itself.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from swimm3r.errors import InputError
from swimm3r.imaging.depth_completion import fill_z_depth
from swimm3r.imaging.open_water import sea_share
from swimm3r.imaging.undistortion import frame_rays
from swimm3r.io.files.array_file import read_npz
from swimm3r.io.files.atomic import atomic_path
from swimm3r.io.files.damage import guard, remake
from swimm3r.medium import AttenuationCurve, Medium, MediumFit, remove_water
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.point_groups import PointGroups
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.mast3r_sfm.network_frames import NetworkImages
from swimm3r.sfm.medium.dense_tracks import ray_depth_map
from swimm3r.sfm.medium.restore import RestoredImage, told
from swimm3r.sfm.medium.settings import SeathruSettings
from swimm3r.sfm.student.physics_head import HeadFacts, WaterMaps

_CELL = 8  # network pixels; the head's maps are smooth over 16
_SAMPLES = 2_000  # pixels of each frame that the dive's curve is fitted to
_UNMEASURED = 1.0  # relative error of a head whose error nobody has measured


@dataclass(frozen=True)
class FrameWater:
    """The head's prediction for one frame, in the reconstruction's unit."""

    Binf: Float[Tensor, "3"]
    beta_B: Float[Tensor, "3"]
    curve: Float[Tensor, "12 hc wc"]  # a, b, c, d of three channels each, on the network's image in cells

    def at(self, ray_depth: Float[Tensor, " n"], place: Float[Tensor, "n 2"]) -> Medium:
        """The medium of pixels; `place` is where they are in the network's image, -1..1 from edge to edge."""
        grid = place.to(self.curve)[None, None]
        # outside of the network's crop the edge stands in
        sampled = F.grid_sample(self.curve[None], grid, padding_mode="border", align_corners=False)[0, :, 0].T
        beta_D = AttenuationCurve(*sampled.split(3, dim=-1)).at(ray_depth)
        return Medium(self.Binf.expand_as(beta_D), beta_D, self.beta_B.expand_as(beta_D))


@dataclass(frozen=True)
class FrameReading:
    """One frame's contribution to the dive's water, at some of its pixels of known depth, at least one."""

    Binf: Float[Tensor, "3"]
    beta_B: Float[Tensor, "3"]
    ray_depth: Float[Tensor, " n"]
    beta_D: Float[Tensor, "n 3"]


@dataclass(frozen=True)
class PredictedWater:
    """The water of all frames of a reconstruction, read from disk frame by frame."""

    folder: Path
    place: Float[Tensor, "pixels 2"]  # of the prepared frames' pixels in the network's image, -1..1
    head: HeadFacts

    def frame(self, name: str) -> FrameWater:
        """The water of a frame."""
        path = self.folder / f"{name}.npz"
        with guard(path, remake(self.folder.parent)):
            return FrameWater(*map(torch.from_numpy, read_npz(path, "Binf", "beta_B", "curve").values()))

    def at(self, name: str, pixel: Int[Tensor, " n"], ray_depth: Float[Tensor, " n"]) -> Medium:
        """The medium of some pixels of a frame, row-major indices in the prepared frame."""
        return self.frame(name).at(ray_depth, self.place[pixel])


def write(maps: WaterMaps, scale: float, folder: Path, name: str) -> None:
    """Keeps a frame's water; `scale` is the reconstruction's unit per metre of the network in this frame."""
    scaled = maps.rescaled(scale)
    curve = torch.cat(list(vars(scaled.curve).values()), dim=-1).permute(0, 3, 1, 2)
    cells = F.avg_pool2d(curve.float(), _CELL)[0]
    with atomic_path(folder / f"{name}.npz") as draft:
        np.savez(
            draft, Binf=scaled.Binf[0].cpu().numpy(), beta_B=scaled.beta_B[0].cpu().numpy(), curve=cells.cpu().numpy()
        )


def read(folder: Path, images: NetworkImages, head: HeadFacts) -> PredictedWater | None:
    """Read the predictions that `write` stored; None where the adapter has no head."""
    if not folder.is_dir():
        return None
    frames, frame = images.frames, images.framing
    rows, columns = torch.arange(frames.height) + 0.5, torch.arange(frames.width) + 0.5
    pixels = torch.cartesian_prod(rows, columns).flip(-1).double()
    size = torch.tensor([frame.network_width, frame.network_height])
    place = (2 * images.from_frame(pixels) / size - 1).nan_to_num(0.0).float()
    return PredictedWater(folder, place, head)


def dive_fit(water: PredictedWater, rec: Reconstruction, settings: SeathruSettings) -> MediumFit:
    """One water for the dive, on values as stored. Raises InputError where no frame has any depth."""
    readings = []
    for i, name in enumerate(rec.names):
        if name not in rec.depth:
            continue
        z = ray_depth_map(rec.depth[name].z_depth, frame_rays(rec.cameras[i])).flatten()
        pixel = torch.nonzero(z > 0)[:, 0]
        if not len(pixel):
            continue
        pixel = pixel[:: max(1, len(pixel) // _SAMPLES)]
        own = water.frame(name)
        readings.append(FrameReading(own.Binf, own.beta_B, z[pixel], own.at(z[pixel], water.place[pixel]).beta_D))
    if not readings:
        raise InputError(
            "no frame has any depth to read the water at",
            cause="the dense depth stage found almost no surface",
            hint="clearer or slower footage",
        )
    return summed_up(readings, settings, water.head.error)


def summed_up(readings: Sequence[FrameReading], settings: SeathruSettings, error: Medium | None = None) -> MediumFit:
    """The water that frames, at least one, agree on best: medians, and one exponential through their beta_D.

    `error` is the head's relative standard error per coefficient and channel, None where it was never measured.
    """
    z = torch.cat([r.ray_depth for r in readings]).double()
    beta_D = torch.cat([r.beta_D for r in readings]).double()
    middle = z.median()
    level, slope = _exponential(z / middle, beta_D)
    curve = AttenuationCurve(level.float(), (slope / middle).float(), torch.zeros(3), torch.zeros(3))
    per_frame = {
        "Binf": torch.stack([r.Binf for r in readings]),
        "beta_D": torch.stack([r.beta_D.median(0).values for r in readings]),
        "beta_B": torch.stack([r.beta_B for r in readings]),
    }
    # from the median absolute deviation, as of a normal distribution
    spread = {k: 1.4826 * (v - v.median(0).values).abs().median(0).values for k, v in per_frame.items()}
    medium = Medium(per_frame["Binf"].median(0).values, curve.at(middle.float()), per_frame["beta_B"].median(0).values)
    relative = Medium(*(torch.full((3,), _UNMEASURED) for _ in per_frame)) if error is None else error
    std = {k: (spread[k] ** 2 + (getattr(relative, k) * getattr(medium, k)) ** 2).sqrt() for k in spread}
    known = {k: std[k] < settings.identifiable_std * getattr(medium, k) for k in std}
    low, high = torch.quantile(z[:: max(1, len(z) // 1_000_000)], torch.tensor([0.002, 0.998]).double()).tolist()
    return MediumFit(
        **vars(medium),
        curve=curve,
        std=Medium(**std),
        identifiable=known,
        z_range=(low, high),
        encoding="srgb",
        estimator="physics head",
    )


def predicted_images(
    rec: Reconstruction,
    frames: Frames,
    water: PredictedWater,
    progress: Progress = silent,
    keep: Callable[[int, RestoredImage], None] = lambda i, image: None,
) -> Iterator[tuple[int, RestoredImage]]:
    """Every frame with depth, by its place in `rec`: Eq. 4, clamped, by the frame's own water.

    Unknown depth is filled in along the edges; open water keeps the color it has. `keep` is as in `restored_images`.
    """
    assert rec.cloud is not None
    cloud = PointGroups(rec.cloud.xyz)

    def restored(i: int) -> RestoredImage | None:
        name = rec.names[i]
        depth = rec.depth[name]
        if not bool((depth.z_depth > 0).any()):
            return None
        filmed = frames.image(frames.index(name))
        own = water.frame(name)
        sea = sea_share(filmed, depth.z_depth, own.Binf)
        z_depth = fill_z_depth(filmed, depth, sea, cloud.z_depth(rec.cameras[i]))
        ray_depth = ray_depth_map(z_depth, frame_rays(rec.cameras[i]))
        z = ray_depth.flatten()
        J = remove_water(filmed.reshape(-1, 3), z, own.at(z, water.place), water.head.min_transmittance)
        J = J.clamp(0, 1).reshape(filmed.shape)
        balanced = (J * rec.white_balance.factors).clamp(0, 1)
        clear, shown = (surface + sea[..., None] * (filmed - surface) for surface in (J, balanced))
        image = RestoredImage(clear, shown, ray_depth, sea)
        keep(i, image)
        return image

    yield from told(restored, len(rec.names), progress)


def _exponential(z: Float[Tensor, " n"], beta: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Level and slope of beta = level e^{slope z}, slope <= 0, by least squares of the logarithm."""
    log_beta = beta.clamp(min=1e-9).log()
    centerd = z - z.mean()
    slope = (centerd[:, None] * log_beta).sum(0) / centerd.square().sum().clamp(min=1e-12)
    slope = slope.clamp(max=0.0)
    return torch.exp(log_beta.mean(0) - slope * z.mean()), slope
