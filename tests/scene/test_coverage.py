"""Ground that training frames saw."""

from dataclasses import replace

import torch
from tests.splat.conftest import TinyDive, tiny_dive  # noqa: F401 - a fixture

from swimm3r.scene.coverage import TrainingCoverage
from swimm3r.scene.reconstruction import DenseCloud


def test_what_no_training_frame_saw_is_not_covered(tiny_dive: TinyDive):  # noqa: F811
    x, y = torch.meshgrid(torch.linspace(-2.6, 2.6, 150), torch.linspace(-2.1, 2.1, 120), indexing="ij")
    wall = torch.stack([x, y, torch.full_like(x, 3.0)], -1).reshape(-1, 3)
    rec = replace(tiny_dive.rec, cloud=DenseCloud(wall, wall, wall))
    camera = tiny_dive.cameras[4]
    assert TrainingCoverage(rec).of(camera).all()
    away = camera.cam2world.clone()
    away[0, 0, 3] += 3.0  # the wall ends at x = 2.6
    beyond = TrainingCoverage(rec).of(replace(camera, cam2world=away))
    assert beyond[:, :10].all()
    assert not beyond[:, 50:].any()


def test_ground_at_a_guessed_distance_is_not_covered(tiny_dive: TinyDive):  # noqa: F811
    x, y = torch.meshgrid(torch.linspace(-2.6, 2.6, 150), torch.linspace(-2.1, 2.1, 120), indexing="ij")
    wall = torch.stack([x, y, torch.full_like(x, 3.0)], -1).reshape(-1, 3)
    measured, guessed = wall[wall[:, 0] < 0.2], wall[wall[:, 0] >= 0.2]
    cloud, backdrop = (DenseCloud(part, part, part) for part in (measured, guessed))
    camera = tiny_dive.cameras[4]
    shares = [
        TrainingCoverage(rec).of(camera).float().mean()
        for rec in (replace(tiny_dive.rec, cloud=cloud), replace(tiny_dive.rec, cloud=cloud, backdrop=backdrop))
    ]
    assert shares[0] == shares[1] < 0.9
