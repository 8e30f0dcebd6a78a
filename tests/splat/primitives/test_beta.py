"""The set that training starts from, and what a change of unit does to it."""

from dataclasses import replace

import torch

from swimm3r.cameras import Cameras
from swimm3r.splat.primitives.beta import initial_primitives, inverse_softplus, rescaled
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import InitialSettings


def test_with_mean_directions_most_primitives_are_visible_at_first_and_with_uniform_ones_few(tiny_dive):
    from swimm3r.splat.projection.conditioning import condition, queries

    share = {}
    for directions in ("mean", "uniform"):
        settings = InitialSettings(primitives=1000, directions=directions)
        p = initial_primitives(tiny_dive.rec, settings, torch.Generator().manual_seed(0))
        seen = condition(p, queries(p.xyz, tiny_dive.rec.cameras.centers[3].float()))
        share[directions] = (seen.opacity > 0.05).double().mean()
    assert share["mean"] > 0.9
    assert share["uniform"] < 0.3


def test_without_a_dense_cloud_the_sparse_points_are_taken(tiny_dive):
    p = initial_primitives(replace(tiny_dive.rec, cloud=None), InitialSettings(), torch.Generator().manual_seed(0))
    torch.testing.assert_close(p.xyz.double(), tiny_dive.rec.points.xyz, atol=1e-6, rtol=0)


def test_a_bounded_share_of_the_primitives_starts_on_ground_of_guessed_depth(tiny_dive):
    cloud = tiny_dive.rec.cloud
    behind = replace(cloud, xyz=cloud.xyz + 10.0)
    rec = replace(tiny_dive.rec, backdrop=behind)
    settings = InitialSettings(primitives=len(cloud.xyz), backdrop=0.25)
    p = initial_primitives(rec, settings, torch.Generator().manual_seed(0))
    guessed = (p.xyz[:, None] - behind.xyz[None]).abs().amax(-1).amin(-1) < 1e-4
    assert 0.15 * len(cloud.xyz) < guessed.sum() < 0.3 * len(cloud.xyz)
    assert len(p.xyz) < 1.02 * settings.primitives
    without = initial_primitives(rec, replace(settings, backdrop=0.0), torch.Generator().manual_seed(0))
    assert len(without.xyz) == len(cloud.xyz)
    assert (without.xyz < behind.xyz.amin(0)).any(-1).all()


def test_softplus_undoes_its_inverse():
    s = torch.tensor([1e-6, 1e-3, 0.5, 4.0, 30.0])
    torch.testing.assert_close(torch.nn.functional.softplus(inverse_softplus(s)), s, rtol=1e-5, atol=1e-9)


def test_a_scene_in_another_unit_looks_the_same(wall, camera):
    """Lengths times ten and coefficients by ten: the same image from the camera moved as far."""
    scene, view = wall(400), camera()
    pose = view.cam2world.clone()
    pose[:, :3, 3] *= 10
    other = wall(400)
    other.field.length.fill_(10.0)
    ten = SplatMap(rescaled(scene.primitives, 10.0), other.field, scene.settings, True, 10.0)
    a, b = scene.render(view), ten.render(Cameras(view.K, view.distortion, pose, view.width, view.height))
    torch.testing.assert_close(a.rgb, b.rgb, atol=2e-4, rtol=0)
    torch.testing.assert_close(10 * a.z_depth, b.z_depth, atol=2e-2, rtol=0)
