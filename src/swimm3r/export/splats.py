"""A run's map as the numbers that splat files store, and the difference that a format makes to its images.

Formats store what 3DGS optimizes: log scales, quaternions (w, x, y, z), logits of opacity, and spherical harmonics with
their signs. A format that rounds is read back, so that the printed difference is that of the file.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from jaxtyping import Float, Float32

from swimm3r.cameras import Cameras, cameras_of
from swimm3r.errors import DeviceError
from swimm3r.export.gaussians import (
    ASKED,
    Gaussians,
    clear_difference,
    clear_gaussians,
    spread,
    with_mean_color,
)
from swimm3r.export.result import Exported
from swimm3r.export.settings import CompressedPlySettings, SplatFileSettings, SplatPlySettings, SpzSettings
from swimm3r.geometry import quaternion_from_rotation, rotation_from_quaternion
from swimm3r.io import cameras_json
from swimm3r.scene.reconstruction_io import read_run_balance
from swimm3r.scene.run_folder import open_run
from swimm3r.scene.white_balance import UNBALANCED, WhiteBalance
from swimm3r.splat.map_file import load_map
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.primitives.spherical_harmonics import Y_00
from swimm3r.splat.rendering import SplatMap

SplatSettings = SplatPlySettings | CompressedPlySettings | SplatFileSettings | SpzSettings

_CONDON_SHORTLEY = torch.tensor([(-1.0) ** m for degree in (1, 2, 3) for m in range(-degree, degree + 1)])
_COMPARED = 8  # of them
_FLATTEST = 1e-6  # a scale of this share of the largest, at least: viewers divide by it


@dataclass(frozen=True)
class SplatArrays:
    """Gaussians as files store them, float32."""

    xyz: Float32[np.ndarray, "n 3"]
    log_scale: Float32[np.ndarray, "n 3"]
    quaternion: Float32[np.ndarray, "n 4"]  # w, x, y, z
    logit: Float32[np.ndarray, " n"]  # of opacity
    color: Float32[np.ndarray, "n 3"]  # coefficient of degree 0
    harmonics: Float32[np.ndarray, "n h 3"]  # from degree 1 on, with viewers' signs; 0, 3, 8 or 15 of them

    def __getitem__(self, rows: np.ndarray) -> "SplatArrays":
        return SplatArrays(**{name: values[rows] for name, values in vars(self).items()})


@dataclass(frozen=True)
class ExportedMap:
    """A run's map on its way out."""

    scene: SplatMap
    views: Cameras  # from where differences are measured
    time: float
    balance: WhiteBalance  # ones where the map's own colors are exported
    gaussians: Gaussians

    def arrays(self) -> SplatArrays:
        """The numbers of the file."""
        return arrays_of(self.gaussians)

    def result(self, path: Path, written: SplatArrays) -> Exported:
        """The outcome, with the difference between the written Gaussians and the map in views along the dive."""
        difference = clear_difference(self.scene, gaussians_of(written), self.views, self.time, self.balance.factors)
        return Exported(
            path,
            f"{len(written.xyz):,} Gaussians of {self.scene.count:,} primitives",
            f"Beside the map's own clear images: {difference.psnr:.1f} dB, mean alpha {difference.alpha:+.3f}.",
        )


def open_map(folder: Path, settings: SplatSettings) -> ExportedMap:
    """The Gaussians of a finished run's map at the settings' time and in their colors; of what training frames saw.

    Raises InputError without a map.
    """
    open_run(folder, "splat")
    whole = load_map(folder / "splat" / "map.safetensors")
    scene = whole.observed_part()
    refined = folder / "splat" / "cameras.json"
    table = refined if refined.is_file() else folder / "sfm" / "cameras.json"
    cameras = cameras_of(cameras_json.read_cameras(table))
    time = sum(scene.span) / 2 if settings.time is None else settings.time
    canvas = cameras.drawn(scene.settings.long_side)  # what is at the border of a fisheye alone is seen by no pinhole
    own = settings.colors == "physical" or not scene.has_water
    balance = UNBALANCED if own else read_run_balance(folder / "sfm")
    asked = canvas[spread(len(canvas), ASKED)]
    views = asked[spread(len(asked), _COMPARED)]
    g = clear_gaussians(scene, asked if scene.blocks is None else canvas, time)
    if isinstance(scene.primitives, BetaPrimitives):
        g = with_mean_color(scene, g, views, time)
    return ExportedMap(whole, views, time, balance, balanced(g, balance))


def balanced(g: Gaussians, balance: WhiteBalance) -> Gaussians:
    """The same Gaussians in the colors that people are shown; colors are linear in the harmonics."""
    return replace(g, rgb=g.rgb * balance.factors, harmonics=g.harmonics * balance.factors)


def arrays_of(g: Gaussians) -> SplatArrays:
    """The numbers that files store. Degrees of harmonics that all are 0 are left out."""
    variance, axes = torch.linalg.eigh(g.covariance.double())
    scale = variance.clamp(min=0).sqrt()
    scale = scale.clamp(min=_FLATTEST * scale.amax(-1, keepdim=True)).clamp(min=1e-12)
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]  # a rotation, not a reflection
    signed = g.harmonics * _CONDON_SHORTLEY[: g.harmonics.shape[1], None]
    columns = {
        "xyz": g.xyz,
        "log_scale": scale.log(),
        "quaternion": quaternion_from_rotation(axes),
        "logit": g.opacity.double().logit(),
        "color": (g.rgb - 0.5) / Y_00,
        "harmonics": signed,
    }
    return SplatArrays(**{name: values.numpy().astype(np.float32) for name, values in columns.items()})


def gaussians_of(arrays: SplatArrays) -> Gaussians:
    """The Gaussians that a file's numbers say: the inverse of `arrays_of`."""
    xyz, log_scale, quaternion, logit, color, harmonics = (
        torch.from_numpy(np.ascontiguousarray(values)) for values in vars(arrays).values()
    )
    unit = torch.nn.functional.normalize(quaternion.double(), dim=-1)
    axes = rotation_from_quaternion(unit) * log_scale.double().exp()[:, None]
    signs = _CONDON_SHORTLEY[: harmonics.shape[1], None]
    return Gaussians(xyz, 0.5 + Y_00 * color, torch.sigmoid(logit), (axes @ axes.mT).float(), harmonics * signs)


def along_curve(xyz: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """The order of points along a Morton curve: neighbors in the file are neighbors in space."""
    low, high = xyz.min(0), xyz.max(0)
    cells = ((xyz - low) / np.maximum(high - low, 1e-12) * (2**16 - 1)).astype(np.uint64)
    key = np.zeros(len(xyz), np.uint64)
    for bit in range(16):
        for axis in range(3):
            key |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(key, kind="stable")


def gsply_or_refuse() -> ModuleType:
    """The package that writes and reads compressed splats. Raises DeviceError that says what to install."""
    try:
        import gsply
    except ImportError as error:
        raise DeviceError(
            "this format needs gsply, which is not installed",
            cause="Swimm3R was installed without its export extra",
            hint="pip install 'swimm3r[export]', or --format ply or splat, which need nothing",
        ) from error
    return gsply


def for_gsply(gsply: ModuleType, arrays: SplatArrays) -> object:
    """The arrays as gsply takes them."""
    return gsply.GSData.from_arrays(
        arrays.xyz,
        arrays.log_scale,
        arrays.quaternion,
        arrays.logit,
        arrays.color,
        arrays.harmonics if arrays.harmonics.shape[1] else None,
        format="ply",
    )


def from_gsply(data: object) -> SplatArrays:
    """Arrays of what gsply read."""
    named = {"xyz": "means", "log_scale": "scales", "quaternion": "quats", "logit": "opacities", "color": "sh0"}
    columns = {name: np.asarray(getattr(data, theirs), np.float32) for name, theirs in named.items()}
    harmonics = getattr(data, "shN", None)
    none = np.zeros((len(columns["xyz"]), 0, 3), np.float32)
    return SplatArrays(**columns, harmonics=none if harmonics is None else np.asarray(harmonics, np.float32))
