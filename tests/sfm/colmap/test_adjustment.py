"""Bundle adjustment of a reconstruction that was shaken."""

from dataclasses import replace

import torch
from tests.sfm.colmap.two_planes import COUNT, camera_path, worst_rotation_deg

from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap.adjustment import bundle_adjust


def test_bundle_adjustment_mends_shaken_poses(rec: Reconstruction) -> None:
    generator = torch.Generator().manual_seed(0)
    shaken = rec.cameras.cam2world.clone()
    shaken[:, :3, 3] += 0.01 * rec.cameras.centers.std() * torch.randn(COUNT, 3, generator=generator)
    mended = bundle_adjust(replace(rec, cameras=replace(rec.cameras, cam2world=shaken)))
    assert mended.names == rec.names
    assert worst_rotation_deg(mended, camera_path()) < 0.3
    assert mended.points.error.mean() < 1.1 * rec.points.error.mean()
