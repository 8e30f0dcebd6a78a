import torch

from swimm3r.medium import (
    AttenuationCurve,
    Medium,
    MediumFit,
    add_water,
    backscatter,
    linear_from_srgb,
    remove_water,
    rescale,
    srgb_from_linear,
    transmittances,
)

medium = Medium(torch.tensor([0.05, 0.4, 0.38]), torch.tensor([0.9, 0.2, 0.15]), torch.tensor([0.5, 0.3, 0.35]))
J = torch.rand(7, 5, 3, generator=torch.Generator().manual_seed(0))
ray_depth = torch.linspace(0.2, 3.0, 35).reshape(7, 5)


def fit(scale: float = 1.0) -> MediumFit:
    curve = AttenuationCurve(*(torch.full((3,), v) for v in (0.6, -0.4, 0.3, -0.1)))
    flags = {name: torch.ones(3, dtype=torch.bool) for name in ("Binf", "beta_D", "beta_B")}
    found = MediumFit(**vars(medium), curve=curve, std=medium, identifiable=flags, z_range=(0.5, 4.0), encoding="srgb")
    return rescale(found, scale)


def test_remove_water_undoes_add_water():
    torch.testing.assert_close(remove_water(add_water(J, ray_depth, medium), ray_depth, medium), J)


def test_water_of_no_depth_changes_nothing():
    torch.testing.assert_close(add_water(J, torch.zeros(7, 5), medium), J)


def test_far_scene_fades_into_the_veiling_light():
    far = add_water(torch.ones(3), torch.tensor(200.0), medium)
    torch.testing.assert_close(far, medium.Binf)


def test_backscatter_is_what_a_black_object_shows():
    torch.testing.assert_close(backscatter(ray_depth, medium), add_water(torch.zeros(7, 5, 3), ray_depth, medium))


def test_transmittance_over_two_legs_is_the_product():
    a, b = torch.tensor(0.7), torch.tensor(1.9)
    for of_sum, of_a, of_b in zip(
        transmittances(a + b, medium), transmittances(a, medium), transmittances(b, medium), strict=True
    ):
        torch.testing.assert_close(of_sum, of_a * of_b)


def test_rescaling_lengths_leaves_the_image_unchanged():
    scaled = fit(2.5)
    z = torch.linspace(0.5, 4.0, 20)
    for here, there in zip(transmittances(z, fit().at(z)), transmittances(2.5 * z, scaled.at(2.5 * z)), strict=True):
        torch.testing.assert_close(here, there)


def test_curve_is_held_constant_outside_the_depths_it_has_seen():
    outside = fit().at(torch.tensor([0.1, 9.0]))
    torch.testing.assert_close(outside.beta_D, fit().curve.at(torch.tensor([0.5, 4.0])))


def test_srgb_encoding_round_trip():
    torch.testing.assert_close(linear_from_srgb(srgb_from_linear(J)), J)
    torch.testing.assert_close(linear_from_srgb(torch.tensor([0.0, 0.5, 1.0])), torch.tensor([0.0, 0.21404114, 1.0]))
