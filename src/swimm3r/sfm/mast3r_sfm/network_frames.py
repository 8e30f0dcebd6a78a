"""The frames of a dive as the network sees them: without distortion, at its size; and every pixel's way back.

prepared frame (its lens) -> undistorted, same K (pinhole) -> resized and cropped (`preprocess`)
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import Cameras
from swimm3r.errors import InputError, UsageError
from swimm3r.imaging.undistortion import distorted_pixels, undistorted, undistorted_pixels
from swimm3r.io.files.cache_key import bytes_digest
from swimm3r.io.imports.read import read_foreign
from swimm3r.scene.frames import Frames
from swimm3r.sfm.imported.match_frames import model_cameras
from swimm3r.sfm.lens import behind_port, check_lens_settings, lens_of, with_calibration
from swimm3r.sfm.mast3r.preprocess import (
    Framing,
    K_to_image,
    K_to_network,
    framing,
    mask_to_network,
    pixels_to_image,
    pixels_to_network,
    to_network,
)
from swimm3r.sfm.settings import LENS_NUMBERS, Mast3rSettings

_SAME_LENS = 0.01  # pixels, or of a distortion
_ASSUMED = 0.75  # focal length over width of an unknown lens; only says how to write K, nothing is computed with it


@dataclass(frozen=True)
class KnownPoses:
    """Known poses of the frames that the user's file names."""

    cam2world: Float[Tensor, "n 4 4"]  # float64; anything for the others
    posed: Bool[Tensor, " n"]
    metric: bool  # whether they are in metres


@dataclass(frozen=True)
class NetworkImages:
    """Images, masks and intrinsics of frames that share one lens; images are made one at a time."""

    frames: Frames
    lens: Cameras  # one camera of the prepared frames
    known: bool  # whether the lens's K is
    framing: Framing
    poses: "KnownPoses | None" = None

    def image(self, i: int) -> Float[Tensor, "3 H W"]:
        """Frame i in -1..1."""
        return to_network(self._undistorted(i)[0], self.framing)

    def mask(self, i: int) -> Bool[Tensor, "H W"] | None:
        """Mask of the usable pixels of frame i; None: all."""
        if self.frames.frames[i].mask is None and self.lens.model == "PINHOLE":
            return None
        return mask_to_network(self._undistorted(i)[1], self.framing)

    def digest(self, i: int) -> str:
        """Digest of frame i as the network sees it."""
        frame = self.frames.frames[i]
        parts = [frame.path.read_bytes(), repr(self.framing).encode()]
        if frame.mask is not None:
            parts.append(frame.mask.read_bytes())
        if self.lens.model != "PINHOLE":
            parts += [self.lens.K.numpy().tobytes(), self.lens.distortion.numpy().tobytes(), self.lens.model.encode()]
        return bytes_digest(*parts)

    @cached_property
    def K(self) -> Float[Tensor, "3 3"] | None:
        """Known intrinsics in the network's pixels, centers at +0.5; None where the lens is not known."""
        return K_to_network(self.lens.K[0].double(), self.framing) if self.known else None

    def cameras(self, K: Float[Tensor, "n 3 3"], cam2world: Float[Tensor, "n 4 4"]) -> tuple[Cameras, Cameras]:
        """From K in the network's pixels: cameras of the prepared frames, distorted as they are, and the network's."""
        flat = torch.zeros(len(K), 0, dtype=torch.float64)
        canvas = Cameras(K, flat, cam2world, self.framing.network_width, self.framing.network_height)
        original = self.lens.K.double().repeat(len(K), 1, 1)
        if self.lens.model == "PINHOLE":
            original = K_to_image(K, self.framing)
        lens = replace(self.lens, K=original, distortion=self.lens.distortion.repeat(len(K), 1), cam2world=cam2world)
        return lens, canvas

    def to_frame(self, xy: Float[Tensor, "m 2"]) -> Float[Tensor, "m 2"]:
        """Pixels of the network's image (centers at +0.5) -> of the prepared frame, distorted as it is."""
        return distorted_pixels(self.lens, pixels_to_image(xy.double(), self.framing))

    def from_frame(self, xy: Float[Tensor, "m 2"]) -> Float[Tensor, "m 2"]:
        """The inverse of `to_frame`; NaN where the lens has no ray."""
        return pixels_to_network(undistorted_pixels(self.lens, xy), self.framing)

    def _undistorted(self, i: int) -> tuple[Tensor, Tensor]:
        return undistorted(self.frames.image(i), self.frames.mask(i), self.lens, self.lens.pinhole())


def network_images(frames: Frames, settings: Mast3rSettings) -> NetworkImages:
    """Raises UsageError where the lens settings contradict themselves, InputError for images too narrow."""
    try:
        frame = framing(frames.width, frames.height, settings.size, settings.square_ok)
    except ValueError as error:
        raise InputError(
            str(error),
            cause="panoramas and strips are no images of a camera",
            hint="images up to 16 times as wide as high",
        ) from error
    if settings.known is not None:
        lens, poses = _from_file(frames, settings, settings.known)
        return NetworkImages(frames, lens, True, frame, poses)
    settings = with_calibration(settings, frames.width, frames.height, frames.calibration)
    settings, _ = behind_port(settings, frames.width, frames.height)
    lens = _lens(frames.width, frames.height, settings)
    return NetworkImages(frames, lens, settings.focal is not None, frame)


def _from_file(frames: Frames, settings: Mast3rSettings, path: Path) -> tuple[Cameras, KnownPoses]:
    """Lens and poses of a file of known cameras."""
    given = [name for name in ("calibration", *LENS_NUMBERS) if getattr(settings, name) is not None]
    if given or settings.bundle_adjustment:
        other = given[0] if given else "bundle-adjustment"
        raise UsageError(
            f"--known and --{other} contradict each other",
            cause="the file says where frames were and through which lens, and that is held",
            hint=f"leave out one of the two{'' if given else ': bundle adjustment would move the poses'}",
        )
    foreign = read_foreign(path)
    names, cameras = model_cameras(frames, foreign.model)
    if not names:
        raise InputError(
            f"none of the {len(frames)} frames is in {path}",
            cause=f"it is of other images; it names {', '.join(foreign.model.names[:3])}, ...",
            hint="its names must be those of the prepared frames, with or without suffix",
        )
    intrinsics = torch.cat([cameras.K.flatten(1), cameras.distortion], dim=1)
    if float((intrinsics - intrinsics[:1]).abs().max()) > _SAME_LENS:
        raise InputError(
            f"the frames in {path} have different intrinsics",
            cause="they were calibrated one by one, or come from several cameras",
            hint="one lens for all frames: calibrate them together",
        )
    cam2world = torch.eye(4, dtype=torch.float64).repeat(len(frames), 1, 1)
    rows = [frames.index(name) for name in names]
    cam2world[rows] = cameras.cam2world
    posed = torch.zeros(len(frames), dtype=torch.bool)
    posed[rows] = True
    origin = torch.eye(4, dtype=torch.float64)[None]
    return replace(cameras[0], cam2world=origin), KnownPoses(cam2world, posed, foreign.metric)


def _lens(width: int, height: int, settings: Mast3rSettings) -> Cameras:
    check_lens_settings(settings, settings.camera, width, height)
    if settings.focal is None and settings.camera != "PINHOLE":
        raise UsageError(
            f"a lens with distortion ({settings.camera}) must be known before the network sees its images",
            cause="--camera was given without --focal",
            hint="add --calibration, or --focal and the distortion of one, or leave --camera at PINHOLE",
        )
    focal = _ASSUMED * width if settings.focal is None else settings.focal
    return lens_of(settings, settings.camera, width, height, focal)
