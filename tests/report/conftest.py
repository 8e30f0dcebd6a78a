"""Small finished runs, written without the pipeline: three bumps on a floor, filmed by cameras on a line."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from swimm3r.cameras import Cameras, image_directions
from swimm3r.imaging.depth_colors import depth_image
from swimm3r.io import images
from swimm3r.medium import AttenuationCurve, Encoding, Medium, MediumFit
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import (
    DenseCloud,
    DepthMap,
    DepthMaps,
    Matches,
    Points,
    QualityWarning,
    Reconstruction,
    Tracks,
)
from swimm3r.scene.run_folder import SCHEMA

WIDTH, HEIGHT, COUNT = 96, 64, 10
FLOOR = 4.0  # z of the ground
NAMES = tuple(f"dive/{i:04d}.png" for i in range(COUNT))
WATER = Medium(torch.tensor([0.1, 0.5, 0.45]), torch.tensor([0.5, 0.16, 0.1]), torch.tensor([0.4, 0.2, 0.2]))


@dataclass(frozen=True)
class Asked:
    """The run that a test asks for."""

    determined: tuple[bool, bool, bool] = (True, False, False)
    attenuation_std: float = 0.02
    metric: bool = False
    water: bool = True
    stage: str = "eval"  # the last one that is done
    warnings: tuple[QualityWarning, ...] = ()
    title: str = "reef & <wall>"
    times: bool = True
    recorded: str | None = None


def fit(asked: Asked, encoding: Encoding = "linear") -> MediumFit:
    """A water of which the channels' attenuation is known as asked."""
    zero, flags = torch.zeros(3), torch.tensor(asked.determined)
    spread = Medium(torch.full((3,), 0.01), torch.full((3,), asked.attenuation_std), torch.full((3,), 0.03))
    known = {"Binf": flags, "beta_D": flags, "beta_B": torch.zeros(3, dtype=torch.bool)}
    curve = AttenuationCurve(WATER.beta_D, zero, zero, zero)
    return MediumFit(**vars(WATER), curve=curve, std=spread, identifiable=known, z_range=(1.0, 5.0), encoding=encoding)


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., Path]:
    """Writes a run folder; options are those of `Asked`."""

    def make(**options: Any) -> Path:
        return write_run(tmp_path / f"run{len(list(tmp_path.iterdir()))}", Asked(**options))

    return make


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One of them with every stage, and with a warning; tests leave it as it is."""
    warning = QualityWarning("The path is <one> straight line.", "Swim a loop.")
    return write_run(
        tmp_path_factory.mktemp("report") / "run", Asked(warnings=(warning,), recorded="2024-05-03T10:21:00")
    )


def write_run(folder: Path, asked: Asked) -> Path:
    """A run folder up to the stage asked for."""
    cameras = _cameras()
    images_ = [_image(cameras, i) for i in range(COUNT)]
    frames = _frames(folder, images_, asked)
    frames.save(folder / "prepare")
    (folder / "settings.yaml").write_text("frames:\n  fps: 5.0\n")
    (folder / "versions.json").write_text(json.dumps({"python": "3.11", "swimm3r": "0.2.0"}))
    (folder / "log.jsonl").write_text('{"time": "2026-11-22T17:12:43+0000", "event": "opened"}\n')
    stages = ("prepare", "sfm", "splat", "eval")
    done = stages[: stages.index(asked.stage) + 1]
    if "sfm" in done:
        _write_sfm(folder / "sfm", cameras, frames, images_, asked)
    if "eval" in done:
        _write_map(folder, frames, images_)
    summary = _summary(asked, done)
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


def _cameras() -> Cameras:
    poses = torch.eye(4, dtype=torch.float64).repeat(COUNT, 1, 1)
    poses[:, 0, 3] = torch.linspace(-2, 2, COUNT)
    K = torch.tensor([[80.0, 0, WIDTH / 2], [0, 80.0, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    return Cameras(K.repeat(COUNT, 1, 1), torch.zeros(COUNT, 0, dtype=torch.float64), poses, WIDTH, HEIGHT)


def _floor(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    bumps = ((-1.5, 0.2), (0.4, -0.4), (1.7, 0.5))
    return FLOOR - torch.stack([0.8 * torch.exp(-3 * ((x - a) ** 2 + (y - b) ** 2)) for a, b in bumps]).sum(0)


def _image(cameras: Cameras, i: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Clear colors and z depth of a frame, to the first order of the relief."""
    rays = image_directions(cameras[i])
    x, y = rays[..., 0] * FLOOR + cameras.cam2world[i, 0, 3], rays[..., 1] * FLOOR
    clear = torch.stack(
        [0.5 + 0.4 * torch.sin(9 * x), 0.5 + 0.4 * torch.sin(8 * y), 0.5 + 0.4 * torch.sin(5 * (x + y))], -1
    )
    return clear.float(), _floor(x, y).float()


def _frames(folder: Path, made: list[tuple[torch.Tensor, torch.Tensor]], asked: Asked) -> Frames:
    listed = []
    for i, (name, (clear, _)) in enumerate(zip(NAMES, made, strict=True)):
        path = folder.parent / f"{folder.name}-source" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        images.write_rgb(path, (clear * torch.tensor([0.3, 0.9, 0.8])).numpy())
        time = i / 5 if asked.times else float(i)
        listed.append(Frame(name, path, time, 1.0, "test" if i % 8 == 0 else "train"))
    return Frames(tuple(listed), WIDTH, HEIGHT, ordered=True, recorded=asked.recorded)


def _write_sfm(
    folder: Path, cameras: Cameras, frames: Frames, made: list[tuple[torch.Tensor, torch.Tensor]], asked: Asked
) -> None:
    train = [i for i, frame in enumerate(frames) if frame.split == "train"]
    rng = torch.Generator().manual_seed(0)
    x, y = 8 * torch.rand(4000, generator=rng) - 4, 4 * torch.rand(4000, generator=rng) - 2
    xyz = torch.stack([x, y, _floor(x, y)], 1)
    color = torch.stack([0.5 + 0.4 * torch.sin(9 * x), 0.5 + 0.4 * torch.sin(8 * y), 0.5 + 0 * x], 1)
    few, index, none = xyz[:50], torch.arange(50), torch.zeros(0, dtype=torch.long)
    depth = DepthMaps(folder / "z_depth")
    rec = Reconstruction(
        tuple(NAMES[i] for i in train),
        cameras[train],
        Points(few.double(), color[:50], torch.full((50,), 0.4).double()),
        Tracks(index, index % len(train), torch.full((50, 2), 20.0).double()),
        Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)),
        depth,
        "colmap",
        metric=asked.metric,
        medium=fit(asked, "srgb") if asked.water else None,
        medium_linear=fit(asked) if asked.water else None,
        cloud=DenseCloud(xyz.float(), (color * torch.tensor([0.3, 0.9, 0.8])).float(), color.float())
        if asked.water
        else None,
        warnings=asked.warnings,
    )
    rec.save(folder)
    for i in train:
        clear, z_depth = made[i]
        depth.write(NAMES[i], DepthMap(z_depth, torch.ones_like(z_depth)))
        if asked.water:
            images.write_rgb(folder / "restored" / f"{NAMES[i]}.png", clear.numpy())


def _write_map(folder: Path, frames: Frames, made: list[tuple[torch.Tensor, torch.Tensor]]) -> None:
    (folder / "splat").mkdir()
    (folder / "splat" / "map.safetensors").write_bytes(b"\0" * 1234)
    rows = [{"step": k, "loss": 0.2 / k, "l1": 0.1 / k, "primitives": 100.0 + k} for k in range(1, 40)]
    (folder / "splat" / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    for i, frame in enumerate(frames):
        if frame.split == "test":
            clear, z_depth = made[i]
            stem = folder / "renders" / "test" / frame.name.removesuffix(".png")
            for kind, image in {"rgb": clear * torch.tensor([0.3, 0.9, 0.8]), "clear": clear}.items():
                images.write_rgb(Path(f"{stem}_{kind}.png"), image.numpy())
            images.write_rgb(Path(f"{stem}_z_depth.png"), depth_image(z_depth.numpy(), 3.0, 4.0))


def _summary(asked: Asked, done: tuple[str, ...]) -> dict[str, Any]:
    stage = {"seconds": 75.2, "cpu_seconds": 131.0, "peak_mb": 1024, "status": "done", "key": "k"}
    summary: dict[str, Any] = {
        "schema": SCHEMA,
        "input": {"path": f"/films/{asked.title}", "fingerprint": "f"},
        "stages": {name: stage for name in done},
        "warnings": [vars(warning) for warning in asked.warnings],
    }
    if "sfm" in done:
        summary["sfm"] = {
            "backend": "colmap", "frames": 8, "registered": 8, "points": 50, "dense_points": 4000 * asked.water,
            "reprojection_px": 0.4, "epipolar_px": None, "epipolar_px_reason": "no matches", "inlier_1px": None,
            "metric": asked.metric,
        }  # fmt: skip
    if "eval" in done:
        scores = {"uiqm": 3.0, "uciqe": 26.4, "urank": None, "urank_reason": "not published"}
        restored = {**scores, "shown": scores}
        of_water = {"clear_psnr": 31.25, "T_D_abs": [0.01, 0.02, 0.03], "beta_B_rel": [None, None, None]}
        summary |= {
            "splat": {"recipe": "uwbs-static", "primitives": 5000, "iterations": 2000},
            "test": {
                "psnr": 31.02, "ssim": 0.88, "lpips": None, "lpips_reason": "its network is not here", "views": 2,
                "blur4_psnr": 29.9, "sharpness": 0.94, "protocol": "every 8th frame",
            },
            "restored": {"sfm": restored, "splat": restored},
            "truth": {"rotation_deg": 0.013, "ate": 0.0005, "depth_absrel": 0.0097, "sfm": of_water, "splat": of_water},
        }  # fmt: skip
    return summary


def pixels(png: bytes) -> np.ndarray:
    """The decoded pixels of a screenshot."""
    import cv2

    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR).astype(np.int32)
