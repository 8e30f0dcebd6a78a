"""Exposure and white balance of single frames, told from the water by points that several frames see."""

from dataclasses import replace

import pytest
import torch

from swimm3r.appearance import ORDERS, about_identity, cosines, identity_maps
from swimm3r.imaging.frame_colors import ColorTracks, GroundColors, fit_frame_colors

FRAMES, POINTS = 24, 3000
BINF, BETA_D, BETA_B = torch.tensor([0.1, 0.5, 0.5]), torch.tensor([0.4, 0.15, 0.12]), torch.tensor([0.3, 0.25, 0.2])


def dive(gains: torch.Tensor, rise: float = 0.0, noise: float = 0.006) -> ColorTracks:
    """Points seen by a third of the frames, from distances that grow by `rise` over the dive."""
    rng = torch.Generator().manual_seed(0)
    J = 0.15 + 0.6 * torch.rand(POINTS, 3, generator=rng)
    first = torch.randint(0, FRAMES - FRAMES // 3 + 1, (POINTS,), generator=rng)
    point = torch.arange(POINTS).repeat_interleave(FRAMES // 3)
    frame = first[point] + torch.arange(FRAMES // 3).repeat(POINTS)
    z = 2.0 + torch.rand(POINTS, generator=rng)[point] + 0.8 * torch.rand(len(point), generator=rng)
    z = z + rise * frame / FRAMES
    T_D, B = torch.exp(-BETA_D * z[:, None]), BINF * -torch.expm1(-BETA_B * z[:, None])
    color = gains[frame] * (J[point] * T_D + B) + noise * torch.randn(len(point), 3, generator=rng)
    return ColorTracks(color, z, point, frame, FRAMES, T_D, B)


def jitter() -> torch.Tensor:
    rng = torch.Generator().manual_seed(1)
    gains = 1 + 0.12 * (2 * torch.rand(FRAMES, 3, generator=rng) - 1) + 0.15 * torch.randn(FRAMES, 1, generator=rng)
    return gains / gains.mean(0)


STEADY = torch.ones(FRAMES, 3)


def test_the_gains_of_frames_are_found_in_known_water():
    found = fit_frame_colors(dive(jitter()))
    assert found is not None
    assert found.evidence.by_frames > 0.8
    for S in (torch.tensor([0.15, 0.3, 0.3]), torch.tensor([0.25, 0.4, 0.4])):
        shown = found.maps[..., :3] @ S + found.maps[..., 3]
        assert float(((shown / S - jitter()) ** 2).mean().sqrt()) < 0.02


@pytest.mark.parametrize("gains", [STEADY, jitter()])
def test_the_maps_are_the_identity_on_average(gains):
    found = fit_frame_colors(dive(gains))
    assert found is not None
    torch.testing.assert_close(found.maps.mean(0), identity_maps(1)[0], atol=1e-6, rtol=0)


@pytest.mark.parametrize("rise", [0.0, 1.5])
def test_water_is_not_read_as_frames(rise):
    found = fit_frame_colors(dive(STEADY, rise))
    assert found is not None
    assert found.evidence.by_water > 0.5
    assert found.evidence.by_frames < 0.05
    assert float((found.maps - identity_maps(FRAMES)).abs().max()) < 0.03


def test_a_camera_that_rises_while_it_exposes_keeps_both_apart():
    found = fit_frame_colors(dive(jitter(), rise=1.5))
    assert found is not None
    S = torch.tensor([0.2, 0.4, 0.4])
    shown = (found.maps[..., :3] @ S + found.maps[..., 3]) / S
    assert float((shown - jitter()).square().mean().sqrt()) < 0.03


def test_noise_alone_is_explained_by_nothing():
    rng = torch.Generator().manual_seed(0)
    tracks = dive(STEADY)
    noise = (0.4 + 0.02 * torch.randn(len(tracks.point), 3, generator=rng)).clamp(0, 1)
    found = fit_frame_colors(replace(tracks, color=noise, T_D=None, backscatter=None))
    assert found is not None
    assert found.evidence.by_frames < 0.02
    assert found.evidence.by_water < 0.02


def test_few_points_say_nothing():
    tracks = dive(STEADY)
    few = tracks.point < 30
    for rows in (few, few & False):
        color, z, point, frame = tracks.color[rows], tracks.ray_depth[rows], tracks.point[rows], tracks.frame[rows]
        assert fit_frame_colors(ColorTracks(color, z, point, frame, FRAMES)) is None


def test_maps_about_the_identity_relate_frames_as_before():
    rng = torch.Generator().manual_seed(2)
    maps = identity_maps(5) + 0.1 * torch.randn(5, 3, 4, generator=rng)
    centered = about_identity(maps)
    torch.testing.assert_close(centered.mean(0), identity_maps(1)[0], atol=1e-6, rtol=0)

    def from_first_to_last(m: torch.Tensor) -> torch.Tensor:
        S = torch.linalg.inv(m[0, :, :3]) @ (torch.tensor([0.2, 0.5, 0.4]) - m[0, :, 3])
        return m[-1, :, :3] @ S + m[-1, :, 3]

    torch.testing.assert_close(from_first_to_last(centered), from_first_to_last(maps))


def recorded(stops: float = 0.6) -> torch.Tensor:
    """Gains on linear light of a camera that exposes and balances anew all the time."""
    rng = torch.Generator().manual_seed(3)
    exposure = stops * (2 * torch.rand(FRAMES, 1, generator=rng) - 1)
    return 0.02 * 2 ** (exposure + 0.3 * stops * torch.randn(FRAMES, 3, generator=rng))


def as_stored(gains: torch.Tensor, slope: float = 0.45) -> torch.Tensor:
    factors = gains**slope
    return factors / factors.mean(0)


def test_recorded_gains_explain_the_frames_through_the_slope_of_the_tone_curve():
    found = fit_frame_colors(replace(dive(as_stored(recorded()), rise=1.5), gains=recorded()))
    assert found is not None
    e = found.evidence
    assert e.by_record is not None
    assert e.slope is not None
    assert abs(e.slope - 0.45) < 0.03
    assert e.by_record > 0.9 * e.by_frames > 0.5


def test_small_changes_of_exposure_are_told_by_the_record_alone():
    small = recorded(0.05)
    with_record = fit_frame_colors(replace(dive(as_stored(small), noise=0.012), gains=small))
    assert with_record is not None
    assert with_record.evidence.by_record is not None
    assert 0.05 < with_record.evidence.by_record < 0.5
    assert with_record.evidence.slope == pytest.approx(0.45, abs=0.1)


def test_a_record_holds_frames_that_see_little():
    tracks = replace(dive(as_stored(recorded())), gains=recorded())
    poor = tracks.frame == 7
    kept = ~poor | (torch.cumsum(poor, 0) <= 2)
    few = {name: getattr(tracks, name)[kept] for name in ("color", "ray_depth", "point", "frame", "T_D", "backscatter")}
    S = torch.tensor([0.2, 0.4, 0.4])

    def error(gains: torch.Tensor | None) -> float:
        found = fit_frame_colors(replace(tracks, **few, gains=gains))
        assert found is not None
        shown = (found.maps[7, :, :3] @ S + found.maps[7, :, 3]) / S
        return float((shown / as_stored(recorded())[7] - 1).abs().max())

    assert error(recorded()) < 0.03 < error(None)


def test_a_camera_that_held_its_settings_changes_nothing():
    tracks = dive(jitter())
    without = fit_frame_colors(tracks)
    held = fit_frame_colors(replace(tracks, gains=0.02 * torch.tensor([3.6, 1.0, 1.6]).expand(FRAMES, 3)))
    assert held is not None
    assert without is not None
    assert torch.equal(held.maps, without.maps)
    assert held.evidence == without.evidence


def test_a_record_of_something_else_explains_nothing_and_leaves_the_maps_as_they_are():
    tracks = dive(jitter())
    without, other = fit_frame_colors(tracks), fit_frame_colors(replace(tracks, gains=recorded()))
    assert without is not None
    assert other is not None
    assert other.evidence.by_record is not None
    assert other.evidence.by_record < 0.3 < without.evidence.by_frames
    assert (other.maps - without.maps).abs().max() < 0.02


def shaded(tracks: ColorTracks, size: float) -> tuple[ColorTracks, torch.Tensor]:
    """The same tracks at random places of their images, in gains that change over each image."""
    rng = torch.Generator().manual_seed(4)
    waves = cosines(torch.rand(len(tracks.point), 2, generator=rng))
    shading = size * torch.randn(FRAMES, len(ORDERS), 1, generator=rng).expand(-1, -1, 3)
    shading = shading - shading.mean(0)
    gain = torch.einsum("ok,okc->oc", waves, shading[tracks.frame]).exp()
    return replace(tracks, color=tracks.color * gain, cosines=waves), shading


@pytest.mark.parametrize("known_water", [True, False])
def test_gains_that_change_over_the_image_are_found(known_water):
    tracks, shading = shaded(dive(jitter()), 0.05)
    if not known_water:
        tracks = replace(tracks, T_D=None, backscatter=None)
    found = fit_frame_colors(tracks)
    assert found is not None
    assert found.evidence.by_shading is not None
    assert found.evidence.by_shading > 0.7
    assert found.shaded is not None
    assert float((found.shaded.shading - shading).square().mean().sqrt()) < 0.012
    torch.testing.assert_close(found.shaded.shading.mean(0), torch.zeros(len(ORDERS), 3), atol=1e-6, rtol=0)


def test_water_and_exposure_are_not_read_as_gains_over_the_image():
    tracks = dive(jitter(), rise=1.5)
    # places that tell the distance, as ground that recedes toward the upper border does
    far = (tracks.ray_depth - tracks.ray_depth.min()) / (tracks.ray_depth.max() - tracks.ray_depth.min())
    aside = torch.rand(len(far), generator=torch.Generator().manual_seed(6))
    found = fit_frame_colors(replace(tracks, cosines=cosines(torch.stack([aside, 1 - far], -1))))
    assert found is not None
    assert found.evidence.by_shading is not None
    assert found.evidence.by_shading < 0.05
    assert found.shaded is not None
    assert float(found.shaded.shading.abs().mean()) < 0.01


def test_shadings_are_alike_in_all_channels():
    """Of gains that change over the image in one channel alone, as water does, the common part is taken."""
    tracks = dive(STEADY)
    waves = cosines(torch.rand(len(tracks.point), 2, generator=torch.Generator().manual_seed(4)))
    slow = 0.1 * waves[:, ORDERS.index((1, 0))] * torch.where(tracks.frame % 2 == 0, 1.0, -1.0)
    found = fit_frame_colors(
        replace(tracks, color=tracks.color * (slow[:, None] * torch.eye(3)[2]).exp(), cosines=waves)
    )
    assert found is not None
    assert found.shaded is not None
    shading = found.shaded.shading
    assert torch.equal(shading[..., 0], shading[..., 2])
    assert float(shading[::2, ORDERS.index((1, 0)), 0].mean()) == pytest.approx(0.1 / 3, rel=0.4)


def test_ground_that_reflects_alike_tells_of_light_that_no_point_tells_of():
    """Two lines of a survey without a point in common, each in its own light, whose points keep their places."""
    tracks, half = dive(STEADY, noise=0.003), FRAMES // 2
    lines = torch.where(tracks.frame < half, 0, 1)
    alone = lines == lines[tracks.point.new_tensor(range(len(tracks.point))) // (FRAMES // 3) * (FRAMES // 3)]
    rows = {
        name: getattr(tracks, name)[alone] for name in ("color", "ray_depth", "point", "frame", "T_D", "backscatter")
    }
    tracks = replace(tracks, **rows)
    rng = torch.Generator().manual_seed(7)
    waves = cosines(torch.rand(POINTS, 2, generator=rng))
    across = ORDERS.index((1, 0))
    tilt = torch.where(torch.arange(FRAMES) < half, 0.3, -0.3)
    at = waves[tracks.point]
    gain = (at[:, across] * tilt[tracks.frame]).exp()[:, None]
    tracks = replace(tracks, color=tracks.color * gain, cosines=at)
    x, y = torch.meshgrid((torch.arange(6) + 0.5) / 6, (torch.arange(4) + 0.5) / 4, indexing="ij")
    parts, frame = (
        cosines(torch.stack([x, y], -1).reshape(-1, 2)).repeat(FRAMES, 1),
        torch.arange(FRAMES).repeat_interleave(24),
    )
    T_D, B = (torch.full((len(frame), 3), value) for value in (0.5, 0.1))
    J = 0.4 * (0.1 * torch.randn(len(frame), 3, generator=rng)).exp()
    light = (parts[:, across] * tilt[frame]).exp()[:, None]
    ground = GroundColors(light * (J * T_D + B), T_D, B, frame, parts)

    def told(ground: GroundColors | None) -> float:
        found = fit_frame_colors(replace(tracks, ground=ground))
        assert found is not None
        assert found.shaded is not None
        found_tilt = found.shaded.shading[:, across].mean(-1)
        return float((found_tilt[:half].mean() - found_tilt[half:].mean()) / 0.6)

    assert abs(told(None)) < 0.15
    assert 0.5 < told(ground) < 1.1
