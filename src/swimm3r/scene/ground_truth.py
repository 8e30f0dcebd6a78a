"""Ground truth of a dive: reference poses, and for synthetic dives depth, clear colors and the water.

On disk a folder beside the images: cameras.json; z_depth/NAME.npz (key z_depth), clear/NAME.png, masks/NAME.png (0
where something moves) and medium.json where they exist; under a lamp lamp/NAME.npz (keys light and backscatter). A
cameras.json alone is a reference, too.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import Cameras, cameras_of, resized
from swimm3r.io import cameras_json, images
from swimm3r.io.files.array_file import Layout, read_arrays
from swimm3r.io.files.damage import Remedy, damaged
from swimm3r.io.files.json_file import read_json
from swimm3r.io.medium_json import MediumRecord
from swimm3r.medium import Medium

_REMEDY = Remedy(
    "make the dive again, or move its truth folder away to run without one",
    cause="it was cut off or edited, or is of another dive",
)
FOLDER = "truth"  # where a synthetic dive keeps it, beside images/


@dataclass(frozen=True)
class LampImages:
    """A lamp's share in one image."""

    light: Float[Tensor, "h w 3"]  # on the surfaces, through the water before them
    backscatter: Float[Tensor, "h w 3"]


@dataclass(frozen=True)
class GroundTruth:
    """Reference poses of named frames; `folder` holds the rest where there is any.

    Images are of the size of the cameras, whatever that of the files is.
    """

    names: tuple[str, ...]
    cameras: Cameras
    metric: bool
    medium: Medium | None = None  # scene-wide, [3], on pixel values as stored
    folder: Path | None = None
    stored: tuple[int, int] | None = None  # width and height of the files; None: those of the cameras

    def at_size(self, width: int, height: int) -> "GroundTruth":
        """The same of frames of another size: depth and masks of the nearest pixels, colors averaged by area."""
        if (width, height) == (self.cameras.width, self.cameras.height):
            return self
        return replace(self, cameras=resized(self.cameras, width, height), stored=self._stored)

    @property
    def _stored(self) -> tuple[int, int]:
        return self.stored or (self.cameras.width, self.cameras.height)

    def z_depth(self, name: str) -> Float[Tensor, "h w"] | None:
        """Exact depth along the optical axis, 0 where the ray meets nothing; None where the reference has none."""
        path = self._path("z_depth", f"{name}.npz")
        if path is None:
            return None
        z_depth = read_arrays(path, {"z_depth": Layout("h w")}, _REMEDY)["z_depth"]
        self._check_size(path, z_depth)
        return torch.from_numpy(self._nearest(z_depth.astype(np.float32)))

    def clear(self, name: str) -> Float[Tensor, "h w 3"] | None:
        """The image without water, 0..1; None where the reference has none."""
        path = self._path("clear", f"{name}.png")
        if path is None:
            return None
        rgb = images.read_rgb(path)
        self._check_size(path, rgb)
        return torch.from_numpy(self._averaged(rgb.astype(np.float32) / np.float32(np.iinfo(rgb.dtype).max)))

    @property
    def lit(self) -> bool:
        """True for a dive under a lamp."""
        return self.folder is not None and (self.folder / "lamp").is_dir()

    def lamp(self, name: str) -> LampImages | None:
        """Light on the surfaces and backscatter of a dive under a lamp; None in daylight."""
        path = self._path("lamp", f"{name}.npz")
        if path is None:
            return None
        found = read_arrays(path, {"light": Layout("h w 3"), "backscatter": Layout("h w 3")}, _REMEDY)
        self._check_size(path, found["light"])
        parts = (self._averaged(found[key].astype(np.float32)) for key in ("light", "backscatter"))
        return LampImages(*(torch.from_numpy(part) for part in parts))

    def moving(self, name: str) -> Bool[Tensor, "h w"] | None:
        """True where the image shows something that moves; None where the reference does not say."""
        path = self._path("masks", f"{name}.png")
        if path is None:
            return None
        still = images.read_mask(path)
        self._check_size(path, still)
        return ~torch.from_numpy(self._nearest(still.astype(np.uint8)) > 0)

    def _nearest(self, values: np.ndarray) -> np.ndarray:
        import cv2

        return cv2.resize(values, (self.cameras.width, self.cameras.height), interpolation=cv2.INTER_NEAREST_EXACT)

    def _averaged(self, values: np.ndarray) -> np.ndarray:
        import cv2

        return cv2.resize(values, (self.cameras.width, self.cameras.height), interpolation=cv2.INTER_AREA)

    def _check_size(self, path: Path, values: np.ndarray) -> None:
        width, height = self._stored
        if values.shape[:2] != (height, width):
            why = f"it has {values.shape[1]}x{values.shape[0]} pixels, its cameras.json says {width}x{height}"
            raise damaged(path, why, _REMEDY)

    def _path(self, kind: str, file: str) -> Path | None:
        path = None if self.folder is None else self.folder / kind / file
        return path if path is not None and path.is_file() else None


def read_ground_truth(path: Path) -> GroundTruth:
    """Read a truth folder or a cameras.json. Raises InputError where it is neither."""
    folder = path if path.is_dir() else None
    table = cameras_json.read_cameras(path / "cameras.json" if folder else path)
    medium = None
    if folder and (folder / "medium.json").is_file():
        medium = read_json(folder / "medium.json", MediumRecord, _REMEDY).medium()
    return GroundTruth(table.names, cameras_of(table), table.units == "metres", medium, folder)
