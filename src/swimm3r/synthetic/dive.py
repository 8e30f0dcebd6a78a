"""A synthetic dive: images through known water, with everything about them known.

    raw = add_water(clear, ray_depth, medium), and Binf where a ray meets nothing      (paper Eqs. 2-4)

on values as stored (sRGB), before fish, snow, vignetting, the camera's exposure, white balance and tone mapping, and
noise; under a lamp, `lamp_light` says how both terms change, and `clear` is the scene evenly lit. Truth is of the still
scene by a camera whose gains are 1: depth and `clear` are what lies behind the fish, and `usable` is False wherever it
shows. Caustics are in `raw` alone: `clear` has the light that they have on average. Where a ray meets nothing, depth is
0 and `clear` is black. Behind a port every ray is traced through it (`optics`), attenuation begins at its outer
surface, and the cameras are the central ones of `swimm3r.refraction.central`. Where rows are exposed one after another,
poses are those at half time, and depth counts along their axes.

On disk: images/NAME, and truth/ as `ground_truth` reads it, with masks/NAME.png (0 at the fish) if there is one, and
gains.json, the camera's factors on linear light per frame, if they change; markers.json, the printed markers, if any;
lamp.json and lamp/NAME.npz, the lamp and its light and backscatter per pixel, if there is one; behind a port lens.json,
the lens in air.
"""

import json
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r import water_types
from swimm3r.appearance import shading_gains
from swimm3r.cameras import Cameras
from swimm3r.errors import InputError
from swimm3r.io import images
from swimm3r.io.files.atomic import atomic_path, write_text
from swimm3r.io.files.damage import Remedy, guard
from swimm3r.lamp import Lamp, lamp_document
from swimm3r.medium import Medium, add_water, srgb_from_linear, transmittances
from swimm3r.progress import Progress, silent
from swimm3r.refraction.central import CameraInWater
from swimm3r.scene.ground_truth import FOLDER
from swimm3r.synthetic import disturbances
from swimm3r.synthetic.lamp_light import lamp_backscatter, lamp_of, light_on
from swimm3r.synthetic.optics import PixelRays, behind_port, lens_of, rays_of, rolled
from swimm3r.synthetic.path import loop, motion_between, right_of, survey
from swimm3r.synthetic.plain import Plain
from swimm3r.synthetic.printed_markers import FAMILY, Plate, plates_along, with_plates
from swimm3r.synthetic.render_frame import SAMPLES, render
from swimm3r.synthetic.seafloor import Seafloor, make_seafloor
from swimm3r.synthetic.settings import DiveSettings


@dataclass(frozen=True)
class DiveFrame:
    """One image and the truth about it."""

    raw: Float[Tensor, "h w 3"]  # what the camera stores, 0..1 (noise may overshoot)
    clear: Float[Tensor, "h w 3"]  # J
    z_depth: Float[Tensor, "h w"]  # m, 0 where the ray meets nothing
    ray_depth: Float[Tensor, "h w"]  # m of water along the ray
    usable: Bool[Tensor, "h w"]  # False where the moving object shows
    light: Float[Tensor, "h w 3"] | None = None  # of the lamp on the surfaces; None in daylight
    backscatter: Float[Tensor, "h w 3"] | None = None  # of the lamp


@dataclass(frozen=True)
class Dive:
    """A dive whose frames are rendered when asked for."""

    settings: DiveSettings
    names: tuple[str, ...]  # of the images, with extension
    cameras: Cameras  # metres
    medium: Medium  # [3], 1/m
    floor: Seafloor | Plain
    plates: tuple[Plate, ...] = ()  # with printed markers
    housed: CameraInWater | None = None  # the lens behind a port, for which `cameras` are the central ones
    motion: Float[np.ndarray, "n 6"] | None = None  # of each camera while its rows are exposed; None all at once

    def __len__(self) -> int:
        return len(self.names)

    @property
    def lamp(self) -> Lamp | None:
        """The lamp on the camera; None in daylight."""
        return lamp_of(self.settings.lamp) if self.settings.lit_by == "lamp" else None

    @cached_property
    def rays(self) -> tuple[PixelRays, PixelRays]:
        """The rays of pixel centers, and of the samples that colors are means of, where all are exposed at once."""
        return rays_of(self.cameras[0], self.housed), rays_of(self.cameras[0], self.housed, SAMPLES)

    def rays_of(self, i: int) -> tuple[PixelRays, PixelRays]:
        """The `rays` of frame i, in the axes of its camera at half of the exposure."""
        if self.motion is None:
            return self.rays
        centers, samples = self.rays
        return rolled(centers, self.motion[i]), rolled(samples, self.motion[i])

    def seconds(self, i: int) -> float:
        """Time at which image i is taken, from that of the first one on."""
        instant, side = divmod(i, max(1, len(self.settings.sides)))
        return instant / self.settings.fps + side * self.settings.stereo_delay

    def gains(self, i: int) -> Float[Tensor, "3"]:
        """The camera's factors on linear light in frame i; 1 without changes of exposure and white balance."""
        rng = np.random.default_rng(self.settings.stream(6, i))
        return disturbances.camera_gains(self.settings.exposure, self.settings.white_balance, rng)

    def shading(self, i: int) -> Float[Tensor, "k 3"]:
        """The shading of frame i on linear light (`swimm3r.appearance`); 0 without changes over the image."""
        rng = np.random.default_rng(self.settings.stream(7, i))
        return disturbances.local_tones(self.settings.local_exposure, rng)

    def frame(self, i: int) -> DiveFrame:
        """Render frame i; the same every time."""
        settings, camera = self.settings, self.cameras[i]
        seconds = self.seconds(i)
        floor = self.floor.around(*camera.centers[0, :2].tolist())
        centers, samples = self.rays_of(i)
        rays, sample_rays = centers.direction, samples.direction
        z_depth, clear = self._surfaces(i, floor, seconds, 0.0)
        lit = self._surfaces(i, floor, seconds, settings.caustics)[1] if settings.caustics else clear
        ray_depth = centers.water_path(z_depth)
        light, glow = None, None
        if (lamp := self.lamp) is None:
            raw = torch.where((z_depth > 0)[..., None], add_water(lit, ray_depth, self.medium), self.medium.Binf)
        else:
            light = light_on(rays.float(), ray_depth, lamp, self.medium)
            glow = lamp_backscatter(rays.float(), ray_depth, lamp, self.medium)
            raw = lit * light * transmittances(ray_depth, self.medium)[0] + glow
        usable = torch.ones_like(z_depth, dtype=torch.bool)
        rng = np.random.default_rng(settings.stream(2, i))
        if settings.moving_object:
            there = disturbances.swimming(
                floor, seconds * settings.fps / max(settings.frame_count - 1, 1), settings.seed
            )
            seen = disturbances.fish(sample_rays, z_depth, there.seen_from(camera.cam2world[0]))
            raw, usable = disturbances.with_fish(raw, seen, self.medium), disturbances.untouched(seen)
        if settings.marine_snow:
            raw = disturbances.marine_snow(raw, camera, settings.marine_snow, self.medium, rng)
        if settings.vignetting:
            raw = disturbances.vignette(raw, settings.vignetting)
        if settings.exposure or settings.white_balance:
            raw = disturbances.exposed(raw, self.gains(i))
        if settings.local_exposure:
            shade = shading_gains(self.shading(i), *raw.shape[:2])
            raw = disturbances.exposed(raw, shade.permute(1, 2, 0))
        if settings.noise:
            raw = disturbances.sensor_noise(raw, settings.noise, rng)
        return DiveFrame(raw, clear, z_depth, ray_depth, usable, light, glow)

    def _surfaces(
        self, i: int, floor: Seafloor, time: float, caustics: float
    ) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w 3"]]:
        """Z depth and clear color of what camera i sees at a time (s), under caustics of a strength."""
        radiance, z = render(floor, self.cameras.cam2world[i].numpy(), *self.rays_of(i), time, caustics)
        if self.plates:
            radiance, z = with_plates(radiance, z, self.cameras[i], self.plates)
        clear = srgb_from_linear(torch.from_numpy(radiance * np.array(self.settings.daylight))).clamp(0, 1).float()
        return torch.from_numpy(z).float(), clear


def make_dive(settings: DiveSettings) -> Dive:
    """The seafloor, path and water of a dive; images are rendered by `Dive.frame`.

    Raises UsageError where a survey's camera would see too far.
    """
    floor: Seafloor | Plain
    if settings.path == "loop":
        floor = make_seafloor(settings.seed, settings.corals, settings.season)
    else:
        floor = Plain(settings.seed, settings.corals, settings.season)
    poses, motion = poses_of(settings, floor), None
    if settings.readout:
        before, after = (poses_of(settings, floor, sign * settings.readout / 2) for sign in (-1, 1))
        motion = motion_between(before, after, poses)
    housed, count = behind_port(settings), len(poses)
    lens = housed.central if housed else lens_of(settings)
    cameras = replace(
        lens,
        K=lens.K.repeat(count, 1, 1),
        distortion=lens.distortion.repeat(count, 1),
        cam2world=torch.from_numpy(poses),
    )
    marked = settings.printed_markers
    plates = plates_along(floor, poses[:, :3, 3], marked, settings.printed_marker_size, settings.seed) if marked else []
    return Dive(settings, _names(settings), cameras, water(settings), floor, tuple(plates), housed, motion)


def poses_of(settings: DiveSettings, floor: Seafloor | Plain, moment: float = 0.0) -> Float[np.ndarray, "n 4 4"]:
    """cam2world of all cameras of a dive, `moment` seconds after their images."""

    def side(later: float) -> Float[np.ndarray, "n 4 4"]:
        if isinstance(floor, Plain):
            return survey(settings, later + moment)
        return loop(floor, settings.frames, settings.stream(1), later * settings.fps, moment * settings.fps)

    if not settings.sides:
        return side(0.0)
    right = right_of(side(settings.stereo_delay), settings.stereo)
    return np.stack([side(0.0), right], 1).reshape(-1, 4, 4)


def write_dive(settings: DiveSettings, folder: Path, progress: Progress = silent) -> None:
    """Render a dive into a folder: images/ and truth/; one that is there already, whole, is left alone.

    truth/dive.json holds the settings, and once the dive is whole says so. Raises InputError where anything else lies
    in the folder, another dive, too.
    """
    record, described = folder / FOLDER / "dive.json", json.loads(json.dumps(asdict(settings)))
    if _is_whole(folder, record, described):
        return
    write_text(record, json.dumps({**described, "whole": False}, indent=2) + "\n")
    dive, truth = make_dive(settings), folder / FOLDER
    for i, name in enumerate(dive.names):
        progress("rendering", i, len(dive))
        frame = dive.frame(i)
        images.write_rgb(folder / "images" / name, frame.raw.numpy())
        images.write_rgb(truth / "clear" / f"{name}.png", frame.clear.numpy())
        with atomic_path(truth / "z_depth" / f"{name}.npz") as draft:
            np.savez_compressed(draft, z_depth=frame.z_depth.numpy())
        if frame.light is not None and frame.backscatter is not None:
            with atomic_path(truth / "lamp" / f"{name}.npz") as draft:
                np.savez_compressed(
                    draft, light=frame.light.half().numpy(), backscatter=frame.backscatter.half().numpy()
                )
        if settings.moving_object:
            mask = frame.usable.numpy().astype(np.uint8)[..., None].repeat(3, 2) * 255
            images.write_rgb(truth / "masks" / f"{name}.png", mask)
            if settings.give_masks:
                images.write_rgb(folder / "masks" / f"{name}.png", mask)
    if settings.exposure or settings.white_balance:
        gains = {name: dive.gains(i).tolist() for i, name in enumerate(dive.names)}
        write_text(truth / "gains.json", json.dumps(gains, indent=2) + "\n")
    if dive.plates:
        document = {"family": FAMILY, "markers": [asdict(plate) for plate in dive.plates]}
        write_text(truth / "markers.json", json.dumps(document, indent=2) + "\n")
    if dive.lamp is not None:
        write_text(truth / "lamp.json", json.dumps(lamp_document(dive.lamp), indent=2) + "\n")
    if dive.housed is not None:
        dive.housed.lens.save(truth / "lens.json", ["lens"], units="metres")
    dive.medium.save(truth / "medium.json")
    dive.cameras.save(truth / "cameras.json", dive.names, units="metres")
    write_text(record, json.dumps({**described, "whole": True}, indent=2) + "\n")
    progress("rendering", len(dive), len(dive))


def _is_whole(folder: Path, record: Path, described: dict[str, Any]) -> bool:
    """Return whether the dive lies in the folder already; false of a part of it, and of an empty folder."""
    if not record.is_file():
        if folder.is_dir() and any(folder.iterdir()):
            raise _holds_others(folder)
        return False
    with guard(record, Remedy("remove the folder, or give another one")):
        found = json.loads(record.read_text(encoding="utf-8"))
    whole = found.pop("whole", True) if isinstance(found, dict) else True
    if found != described:
        raise _holds_others(folder)
    return whole is True


def _holds_others(folder: Path) -> InputError:
    return InputError(
        f"{folder} holds other things than this dive",
        cause="a dive of other settings was written there before, or the folder is somebody else's",
        hint="an empty or a new folder",
    )


def water(settings: DiveSettings) -> Medium:
    """The water of a dive: drawn from a family, or as given; under a lamp with the lamp's veiling light."""
    given = settings.coefficients
    medium = Medium(torch.tensor(given.Binf), torch.tensor(given.beta_D), torch.tensor(given.beta_B))
    if settings.family is not None:
        seed = settings.seed + 1009 * settings.visit
        medium = water_types.sample(settings.family, torch.Generator().manual_seed(seed))
    return replace(medium, Binf=settings.lamp.glow * medium.Binf) if settings.lit_by == "lamp" else medium


def _names(settings: DiveSettings) -> tuple[str, ...]:
    sides = [f"{side}/" for side in settings.sides] or [""]
    return tuple(f"{side}{i:04d}.png" for i in range(settings.frame_count) for side in sides)
