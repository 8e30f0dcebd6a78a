"""Points for given poses: of images that have lenses of their own, too."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from tests.sfm.colmap.two_planes import camera_path, render

from swimm3r.cameras import project
from swimm3r.geometry import essential_from_poses
from swimm3r.io.imports.read import read_foreign
from swimm3r.sfm.backends.imported import from_foreign
from swimm3r.sfm.colmap.triangulation import triangulate
from swimm3r.sfm.features.database import FeatureDatabase
from swimm3r.sfm.features.settings import FeatureSettings

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def test_frames_of_two_lenses_get_points_each_under_its_own(tmp_path: Path) -> None:
    one = camera_path()[:4]
    longer = torch.tensor([1.0, 1.4, 1.0, 1.4], dtype=torch.float64)
    K = one.K.clone()
    K[:, :2, :2] *= longer[:, None, None]
    truth = replace(one, K=K)
    frames = render(truth, tmp_path / "images")
    frames = replace(frames, frames=tuple(replace(frame, name=frame.path.name) for frame in frames))
    rows = [
        {
            "file_path": frame.name,
            "transform_matrix": (truth.cam2world[i].numpy() @ _OPENGL).tolist(),
            **{"fl_x": K[i, 0, 0].item(), "fl_y": K[i, 1, 1].item(), "cx": K[i, 0, 2].item(), "cy": K[i, 1, 2].item()},
            **{"w": frames.width, "h": frames.height},
        }
        for i, frame in enumerate(frames)
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", "frames": rows}))
    given = from_foreign(frames, read_foreign(tmp_path / "transforms.json"), tmp_path / "sfm")
    found = triangulate(given, frames, FeatureSettings(), tmp_path / "sfm")
    torch.testing.assert_close(found.cameras.K, truth.K)
    uv, _ = project(truth, found.points.xyz.expand(len(truth), -1, -1))
    off = (uv[found.tracks.frame, found.tracks.point] - found.tracks.xy).norm(dim=-1)
    assert len(found.points.xyz) > 500
    assert off.median() < 0.3
    assert torch.bincount(found.tracks.frame, minlength=4).min() > 200

    with FeatureDatabase(tmp_path / "sfm" / "database.db", 4).open() as database:
        E = torch.tensor(database.read_two_view_geometry(1, 2).E)
    expected = essential_from_poses(truth.cam2world[0], truth.cam2world[1])
    assert (E * expected).sum().abs() > 0.999 * E.norm() * expected.norm() > 0
