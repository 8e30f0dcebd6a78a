"""A run folder of a small dive whose structure from motion is the truth, and settings that train in a second."""

import json
from pathlib import Path

import pytest
import torch

from swimm3r.cameras import pixel_grid, unproject
from swimm3r.pipeline.presets import PRESETS, to_yaml
from swimm3r.prepare import read_frames
from swimm3r.scene.ground_truth import FOLDER, read_ground_truth
from swimm3r.scene.reconstruction import DepthMap, DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.scene.run_folder import SCHEMA
from swimm3r.scene.settings import FrameSettings
from swimm3r.splat.settings import (
    DensifySettings,
    InitialSettings,
    MediumFieldSettings,
    PoseRefinementSettings,
    UwbsSettings,
)
from swimm3r.synthetic import write_dive
from swimm3r.synthetic.settings import DiveSettings

_WIDTH, _HEIGHT = 192, 128


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine frames, two of them held back; every point is seen by every frame, to the pixel."""
    folder = tmp_path_factory.mktemp("bench")
    write_dive(DiveSettings(frames=9, width=_WIDTH, height=_HEIGHT), folder / "dive")
    truth, out = read_ground_truth(folder / "dive" / FOLDER), folder / "run"
    frames = read_frames(folder / "dive", FrameSettings(), out / "prepare")
    names = frames.train.names
    rows_of = [truth.names.index(name) for name in names]
    cameras, depth, points, colors = truth.cameras[rows_of], DepthMaps(out / "sfm" / "z_depth"), [], []
    for k, name in enumerate(names):
        z = truth.z_depth(name)
        assert z is not None
        depth.write(name, DepthMap(z, (z > 0).float()))
        sample = torch.arange(0, z.numel(), 97)
        pixels = pixel_grid(_HEIGHT, _WIDTH).reshape(-1, 2)[None, sample]
        xyz = unproject(cameras[k], pixels, z.flatten()[None, sample])[0]
        points.append(xyz[z.flatten()[sample] > 0])
        colors.append(frames.train.image(k).reshape(-1, 3)[sample][z.flatten()[sample] > 0])
    xyz, none = torch.cat(points).double(), torch.zeros(0, dtype=torch.int64)
    rec = Reconstruction(
        names, cameras, Points(xyz, torch.cat(colors), torch.zeros(len(xyz), dtype=torch.float64)),
        Tracks(none, none, torch.zeros(0, 2, dtype=torch.float64)),
        Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)), depth, "truth", metric=True,
    )  # fmt: skip
    rec.save(out / "sfm", frames)
    about = {
        "schema": SCHEMA,
        "input": {"path": str(folder / "dive"), "fingerprint": "f"},
        "stages": {"prepare": {"status": "done", "key": "p"}, "sfm": {"status": "done", "key": "k"}},
    }
    (out / "summary.json").write_text(json.dumps(about))
    (out / "settings.yaml").write_text(to_yaml(PRESETS["fast"]))
    return out


@pytest.fixture
def tiny() -> UwbsSettings:
    return UwbsSettings(
        iterations=8,
        long_side=48,
        initial=InitialSettings(primitives=200),
        densify=DensifySettings(cap_max=220),
        medium=MediumFieldSettings(hidden=8),
    )


@pytest.fixture
def quick() -> PoseRefinementSettings:
    return PoseRefinementSettings(steps=1, long_side=48)
