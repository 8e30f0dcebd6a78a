"""A network that says the truth of a synthetic dive, or the truth and noise; the MASt3R back end is tested with it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import swimm3r
from swimm3r.cameras import Cameras, image_directions, resized
from swimm3r.scene.frames import Frames
from swimm3r.scene.ground_truth import GroundTruth, read_ground_truth
from swimm3r.sfm.mast3r.network import Architecture, Decoded, Descriptors, Encoded, Mast3r, Pointmap
from swimm3r.sfm.mast3r.settings import AlignmentSettings
from swimm3r.sfm.mast3r_sfm.network_frames import network_images
from swimm3r.sfm.settings import Mast3rSettings
from swimm3r.synthetic import DiveSettings, write_dive

QUICK = AlignmentSettings(intrinsics="shared", coarse_iterations=80, fine_iterations=80)
CONFIDENCE = 10.0
WAVELENGTHS = (8.0, 2.0, 0.5, 0.125)  # m, along three directions each: 24 numbers that tell places apart to millimetres


class ExactNetwork(Mast3r):
    """Takes the network's place: recognizes its images and says where every pixel's surface truly is."""

    def __init__(self, images: list[Tensor], cameras: Cameras, z_depth: Tensor, noise: float = 0.0) -> None:
        """`z_depth` (n h w) and `cameras` are of the network's images; noise is relative, per pass and pixel."""
        torch.nn.Module.__init__(self)
        self.architecture = Architecture()
        self.mask_token = torch.nn.Parameter(torch.full((1,), noise))
        self.enc_norm = torch.nn.LayerNorm(8)
        self.images, self.cameras, self.z_depth, self.noise = images, cameras, z_depth.double(), noise
        self.encoded, self.passes = [], []
        self.generator = torch.Generator().manual_seed(0)

    def encode(self, images: Tensor, portrait: Tensor | None = None) -> Encoded:
        i = next(k for k, image in enumerate(self.images) if torch.equal(image, images[0]))
        self.encoded.append(i)
        height, width = images.shape[2:]
        count = height * width // 256
        tokens = torch.full((1, count, 8), float(i))
        tokens[..., 1] = 1
        return Encoded(tokens, torch.zeros(1, count, 2, dtype=torch.int64), height, width)

    def decode(self, view1: Encoded, view2: Encoded) -> tuple[Decoded, Decoded]:
        self.passes.append((int(view1.tokens[0, 0, 0]), int(view2.tokens[0, 0, 0])))
        both = (view1.tokens, view2.tokens)
        return Decoded(both, view1.height, view1.width), Decoded(both, view2.height, view2.width)

    def pointmap(self, view: Decoded, which: int) -> Pointmap:
        first, own = self._frames(view, which)
        points = (self._world(own) - self.cameras.centers[first]) @ self.cameras.cam2world[first, :3, :3]
        if self.noise:
            points = points * (1 + self.noise * torch.randn(points.shape, generator=self.generator))
        confidence = torch.full(points.shape[:2], CONFIDENCE)
        return Pointmap(points.float()[None], confidence[None])

    def descriptors(self, view: Decoded, which: int) -> Descriptors:
        world = self._world(self._frames(view, which)[1])
        if self.noise:
            world = world * (1 + self.noise / 10 * torch.randn(world.shape, generator=self.generator))
        waves = torch.tensor([2 * torch.pi / w for w in WAVELENGTHS], dtype=torch.float64)
        phase = (world[..., None] * waves).flatten(2)
        described = torch.cat([phase.cos(), phase.sin()], -1) / 12**0.5
        known = self.z_depth[self._frames(view, which)[1]] > 0
        return Descriptors(described.float()[None], torch.where(known, CONFIDENCE, 1e-3)[None].float())

    @staticmethod
    def _frames(view: Decoded, which: int) -> tuple[int, int]:
        numbers = [int(tokens[0, 0, 0]) for tokens in view.tokens]
        return numbers[0], numbers[which - 1]

    def _world(self, i: int) -> Tensor:
        z = torch.where(self.z_depth[i] > 0, self.z_depth[i], 30.0)  # open water is far away
        seen = image_directions(self.cameras[i]).double() * z[..., None]
        return seen @ self.cameras.cam2world[i, :3, :3].T + self.cameras.centers[i]


@dataclass(frozen=True)
class Dive:
    frames: Frames
    truth: GroundTruth
    settings: Mast3rSettings

    @property
    def cameras(self) -> Cameras:
        """The true cameras of the training frames."""
        return self.truth.cameras[[self.truth.names.index(name) for name in self.frames.train.names]]

    def network(self, noise: float = 0.0, kind: type[ExactNetwork] = ExactNetwork) -> ExactNetwork:
        """One that knows this dive; the network's images are a whole fraction of the frames."""
        train = self.frames.train
        images = network_images(train, self.settings)
        frame = images.framing
        assert (frame.left, frame.top) == (0, 0)
        step = self.frames.width // frame.network_width
        cameras = resized(self.cameras, frame.network_width, frame.network_height)
        depths = [self.truth.z_depth(name) for name in train.names]
        seen = [exact_depth(z_depth, step) for z_depth in depths if z_depth is not None]
        return kind([images.image(i) for i in range(len(train))], cameras, torch.stack(seen), noise)


def exact_depth(z_depth: torch.Tensor, step: int) -> torch.Tensor:
    """On a grid coarser by a whole factor, at the middle of its pixels."""
    if step == 1:
        return z_depth
    return z_depth[step // 2 :: step, step // 2 :: step]  # half a fine pixel off; see the tolerances


def make_dive(folder: Path, **settings: Any) -> tuple[Frames, GroundTruth]:
    write_dive(DiveSettings(**settings), folder)
    return swimm3r.read_frames(folder, folder=folder / "prepared"), read_ground_truth(folder / "truth")
