"""Pixels without a measured depth among the samples: black ground that shows the backscatter, and things that move."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from swimm3r.cameras import image_directions
from swimm3r.io import images
from swimm3r.medium import backscatter
from swimm3r.scene.reconstruction import DepthMap, DepthMaps
from swimm3r.sfm.medium.dense_tracks import fuse_depth
from swimm3r.sfm.medium.samples import WaterSamples, collect_samples, quiet
from swimm3r.sfm.medium.seathru import fit_medium
from swimm3r.sfm.medium.settings import SeathruSettings

Where = Callable[[int], torch.Tensor]


def black_without_depth(dive, folder: Path, where: Where) -> WaterSamples:
    """Samples of the dive where masks of its frames are black, of the depth of the ground, and have none measured."""
    (folder / "images").mkdir()
    depth, frames = DepthMaps(folder / "z_depth"), []
    for k, frame in enumerate(dive.frames.frames):
        image, known = dive.frames.image(k).clone(), dive.rec.depth[frame.name]
        image[where(k)] = backscatter(known.z_depth[where(k)], dive.medium)
        images.write_rgb(folder / "images" / frame.name, image.numpy())
        depth.write(frame.name, DepthMap(torch.where(where(k), 0.0, known.z_depth), known.confidence))
        frames.append(replace(frame, path=folder / "images" / frame.name))
    rec, clip = replace(dive.rec, depth=depth), replace(dive.frames, frames=tuple(frames))
    return collect_samples(rec, clip, fuse_depth(rec, clip, SeathruSettings().tracks), SeathruSettings())


def ground(dive, k: int) -> torch.Tensor:
    """(x, y) of the seafloor in each pixel of a frame."""
    x, y, z = dive.rec.cameras.cam2world[k, :3, 3]
    return (image_directions(dive.rec.cameras[k]) * -z)[..., :2] + torch.stack([x, y])


def test_black_ground_without_a_measured_depth_bounds_the_backscatter(dive, tmp_path):
    samples = black_without_depth(dive, tmp_path, lambda k: (ground(dive, k) - 0.1).norm(dim=-1) < 0.45)
    assert samples.guessed is not None
    own, z = samples.I[samples.guessed], samples.ray_depth[samples.guessed]
    assert len(own) > 500
    B = backscatter(z, dive.medium)
    assert ((own - B).abs() < 0.02).all(-1).float().mean() > 0.8  # of the depth that it has
    found = fit_medium(samples, SeathruSettings(), "srgb").at(z)
    assert (backscatter(z, found) - B).mean(0).max() < 0.01


def test_a_black_thing_that_moves_over_the_ground_is_no_black_ground(dive, tmp_path):
    across = torch.arange(dive.frames.width)[None].expand(dive.frames.height, -1)
    samples = black_without_depth(dive, tmp_path, lambda k: (across - 11 * k - 14).abs() < 8)
    assert samples.guessed is not None
    own, z = samples.I[samples.guessed], samples.ray_depth[samples.guessed]
    assert len(own) > 500
    black = (own < backscatter(z, dive.medium) + 0.01).all(-1)
    assert black.float().mean() < 0.05


def test_pixels_of_guessed_depth_tell_of_nothing_but_the_darkest(dive):
    samples = collect_samples(
        dive.rec, dive.frames, fuse_depth(dive.rec, dive.frames, SeathruSettings().tracks), SeathruSettings()
    )
    assert samples.guessed is not None
    count = 20_000
    bright = replace(
        samples,
        I=torch.cat([samples.I, torch.full((count, 3), 0.9)]),
        ray_depth=torch.cat([samples.ray_depth, torch.full((count,), 2.0)]),
        frame=torch.cat([samples.frame, torch.zeros(count, dtype=torch.long)]),
        track=torch.cat([samples.track, torch.full((count,), -1)]),
        guessed=torch.cat([samples.guessed, torch.ones(count, dtype=torch.bool)]),
        direction=None,
    )
    before, after = (fit_medium(each, SeathruSettings(), "srgb") for each in (samples, bright))
    z = torch.linspace(1.0, 4.0, 20)
    torch.testing.assert_close(backscatter(z, after.at(z)), backscatter(z, before.at(z)), atol=0.01, rtol=0)
    assert after.z_range == before.z_range


def test_noise_makes_no_samples_darker_than_the_backscatter():
    B, everywhere = torch.tensor([0.1, 0.3, 0.25]), torch.ones(120, 160, dtype=torch.bool)
    image = B + 0.02 * torch.randn(120, 160, 3, generator=torch.Generator().manual_seed(0))
    averaged = quiet(image, everywhere)
    assert (torch.quantile(image.reshape(-1, 3), 0.005, dim=0) < B - 0.04).all()
    assert (torch.quantile(averaged.reshape(-1, 3), 0.005, dim=0) > B - 0.015).all()
    torch.testing.assert_close(averaged.mean((0, 1)), B, atol=1e-3, rtol=0)


def test_black_behind_a_mask_darkens_no_sample_beside_it():
    image, mask = torch.full((40, 60, 3), 0.4), torch.ones(40, 60, dtype=torch.bool)
    mask[:, :30], image[:, :30] = False, 0.0
    torch.testing.assert_close(quiet(image, mask)[mask], image[mask])
    assert (quiet(image, torch.ones_like(mask))[:, 30] < 0.3).all()
