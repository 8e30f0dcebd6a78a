"""The MASt3R back end on a synthetic dive, with a network that says the truth, or the truth and 1 % noise."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.sfm.backends.exact_network import QUICK, Dive, ExactNetwork

import swimm3r
from swimm3r.cameras import cameras_of, image_directions, project
from swimm3r.evaluate.poses import absolute_pose_errors
from swimm3r.geometry import align_similarity
from swimm3r.io import images
from swimm3r.io.cameras_json import CameraTable
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction, unfiltered_matches
from swimm3r.sfm.mast3r.settings import MatchingSettings

pytestmark = pytest.mark.usefixtures("dry")


def errors(rec: Reconstruction, dive: Dive) -> tuple[float, float]:
    """Mean rotation error, degrees, and relative error of the focal length."""
    focal = rec.cameras.K[0, 0, 0] / dive.cameras.K[0, 0, 0] - 1
    return absolute_pose_errors(rec.cameras.cam2world, dive.cameras.cam2world).rotation_deg, abs(float(focal))


@pytest.mark.long
@pytest.mark.parametrize(("noise", "degrees"), [(0.0, 0.5), (0.01, 1.0)])
def test_cameras_of_a_dive_at_full_size_are_found(
    noise: float,
    degrees: float,
    large: Dive,
    tmp_path: Path,
    take: Callable[[ExactNetwork], None],
    record_property: Callable[[str, float], None],
):
    take(large.network(noise))
    rec = swimm3r.reconstruct(large.frames, large.settings, tmp_path)
    rotation, focal = errors(rec, large)
    record_property("rotation_deg", rotation)
    record_property("focal", focal)
    assert rotation < degrees
    assert focal < 0.02


def test_all_training_frames_and_no_other_are_placed(small: Dive, finished: tuple[Reconstruction, Path]):
    rec, _ = finished
    assert rec.names == small.frames.train.names
    assert errors(rec, small)[0] < 0.5
    assert errors(rec, small)[1] < 0.02


def test_what_is_stored_is_what_other_back_ends_store(finished: tuple[Reconstruction, Path]):
    rec, folder = finished
    again = load_reconstruction(folder)
    assert again.backend == "mast3r"
    assert not again.metric  # the network's metres are a guess
    torch.testing.assert_close(again.cameras.cam2world, rec.cameras.cam2world, atol=1e-6, rtol=0)
    assert len(again.points.xyz) == len(rec.points.xyz) > 500
    assert torch.equal(again.matches.confidence, rec.matches.confidence)
    assert len(rec.matches.i) > 1000
    assert rec.medium is not None
    assert rec.cloud is not None
    for name in rec.names:
        assert (folder / "restored" / f"{name}.png").is_file()
    assert not (folder / "mast3r").exists()


def test_dense_depth_is_the_dive(small: Dive, finished: tuple[Reconstruction, Path]):
    rec, _ = finished
    scale = align_similarity(rec.cameras.centers, small.cameras.centers).scale
    for name in rec.names:
        found, true = rec.depth[name], small.truth.z_depth(name)
        known = (found.z_depth > 0) & (true > 0)
        assert known.float().mean() > 0.6
        assert (found.z_depth[known] * scale / true[known] - 1).abs().median() < 0.02
        torch.testing.assert_close(found.confidence[known].median(), torch.tensor(1 - 1 / 9), atol=1e-3, rtol=0)


def test_tracks_see_each_frame_once_and_reproject(finished: tuple[Reconstruction, Path]):
    rec, _ = finished
    place = torch.stack([rec.tracks.point, rec.tracks.frame], -1)
    assert len(torch.unique(place, dim=0)) == len(place)
    assert (torch.bincount(rec.tracks.point) >= 2).all()
    assert (torch.bincount(rec.tracks.point) >= 3).sum() > 20
    assert rec.points.error.max() < 4.5
    assert rec.points.error.mean() < 1
    assert ((rec.points.rgb >= 0) & (rec.points.rgb <= 1)).all()


def test_pixels_have_their_centers_at_a_half_at_the_frames_own_resolution(
    small: Dive, tmp_path: Path, take: Callable[[ExactNetwork], None]
):
    half = replace(small, settings=replace(small.settings, size=64, matching=MatchingSettings(subsample=4)))
    take(half.network())
    rec = swimm3r.reconstruct(half.frames, half.settings, tmp_path)
    assert errors(rec, half)[1] < 0.02
    torch.testing.assert_close(rec.cameras.K[0, :2, 2], torch.tensor([64.0, 48.0], dtype=torch.float64))
    misses = []
    for i, j in {(int(a), int(b)) for a, b in zip(rec.matches.i, rec.matches.j, strict=True)}:
        rows = (rec.matches.i == i) & (rec.matches.j == j)
        xy = rec.matches.xy_i[rows].double()
        z = half.truth.z_depth(rec.names[i])[xy[:, 1].long(), xy[:, 0].long()].double()
        rays = image_directions(half.cameras[i])[xy[:, 1].long(), xy[:, 0].long()].double()
        world = (rays * z[:, None]) @ half.cameras.cam2world[i, :3, :3].T + half.cameras.centers[i]
        misses.append((project(half.cameras[j], world[None])[0][0] - rec.matches.xy_j[rows])[z > 0])
    # a whole number of network pixels would be a center; an error of half of one is 1 pixel here
    assert torch.cat(misses).median(0).values.abs().max() < 0.6


def test_bundle_adjustment_keeps_poses_and_depth_together(
    small: Dive, tmp_path: Path, take: Callable[[ExactNetwork], None]
):
    take(small.network())
    rec = swimm3r.reconstruct(small.frames, replace(small.settings, bundle_adjustment=True), tmp_path)
    assert errors(rec, small)[0] < 0.5
    scale = align_similarity(rec.cameras.centers, small.cameras.centers).scale
    found, true = rec.depth[rec.names[2]], small.truth.z_depth(rec.names[2])
    known = (found.z_depth > 0) & (true > 0)
    assert (found.z_depth[known] * scale / true[known] - 1).abs().median() < 0.02


def test_known_focal_length_is_held(small: Dive, tmp_path: Path, take: Callable[[ExactNetwork], None]):
    focal = float(small.cameras.K[0, 0, 0]) * 1.05
    take(small.network())
    settings = replace(small.settings, focal=focal, alignment=replace(QUICK, intrinsics="fixed"))
    rec = swimm3r.reconstruct(small.frames, settings, tmp_path)
    torch.testing.assert_close(rec.cameras.K[:, 0, 0], torch.full((6,), focal, dtype=torch.float64), rtol=1e-6, atol=0)


def test_known_cameras_of_a_file_are_kept_and_the_others_found_in_its_unit(
    small: Dive, tmp_path: Path, take: Callable[[ExactNetwork], None]
):
    moved = small.cameras.cam2world.clone()  # in another unit, at another place
    moved[:, :3, 3] = 2 * moved[:, :3, 3] + torch.tensor([5.0, -3.0, 1.0], dtype=torch.float64)
    named = [0, 1, 3, 5]
    names = small.frames.train.names
    table = CameraTable(
        tuple(names[k] for k in named), 128, 96, "PINHOLE", small.cameras.K[named].numpy(),
        small.cameras.distortion[named].numpy(), moved[named].numpy(), "metres",
    )  # fmt: skip
    cameras_of(table).save(tmp_path / "cameras.json", table.names, table.times, table.units)
    take(small.network())
    settings = replace(small.settings, known=tmp_path / "cameras.json", alignment=replace(QUICK, intrinsics="fixed"))
    rec = swimm3r.reconstruct(small.frames, settings, tmp_path / "sfm")
    assert rec.metric
    torch.testing.assert_close(rec.cameras.cam2world[named], moved[named], atol=1e-5, rtol=0)
    torch.testing.assert_close(rec.cameras.K, small.cameras.K, rtol=1e-6, atol=0)
    assert (rec.cameras.centers[[2, 4]] - moved[[2, 4], :3, 3]).norm(dim=1).max() < 0.1
    found, true = rec.depth[rec.names[2]].z_depth, small.truth.z_depth(rec.names[2])
    assert true is not None
    true = 2 * true
    known = (found > 0) & (true > 0)
    assert (found[known] / true[known] - 1).abs().median() < 0.03


class _Stop(Exception):  # noqa: N818
    pass


def test_a_killed_run_goes_on_and_ends_where_an_undisturbed_one_does(
    small: Dive, finished: tuple[Reconstruction, Path], tmp_path: Path, take: Callable[[ExactNetwork], None]
):
    def kill(what: str, done: int, total: int) -> None:
        if what == "two-view network" and done == 4:
            raise _Stop

    first = small.network()
    take(first)
    with pytest.raises(_Stop):
        swimm3r.reconstruct(small.frames, replace(small.settings, memory_mb=1), tmp_path, kill)
    second = small.network()
    take(second)
    rec = swimm3r.reconstruct(small.frames, replace(small.settings, memory_mb=1), tmp_path)
    assert len(first.passes) == 8  # two per pair
    assert len(second.passes) < 2 * 9
    assert second.encoded == [0]  # the plan's measurement only
    torch.testing.assert_close(rec.cameras.cam2world, finished[0].cameras.cam2world, atol=1e-4, rtol=0)
    torch.testing.assert_close(rec.points.xyz, finished[0].points.xyz, atol=1e-3, rtol=0)


def test_a_shared_cache_serves_other_alignments_but_no_other_image(
    small: Dive, tmp_path: Path, take: Callable[[ExactNetwork], None]
):
    settings = replace(small.settings, cache=tmp_path / "cache", graph="swin-1")
    for folder, expected in (("a", 10), ("b", 0)):
        network = small.network()
        take(network)
        swimm3r.reconstruct(small.frames, settings, tmp_path / folder)
        assert len(network.passes) == expected
    frame = small.frames.train.frames[1]
    brighter = tmp_path / "other.png"
    images.write_rgb(brighter, (images.read_rgb(frame.path).astype(np.float32) / 255 * 0.9).clip(0, 1))
    changed = [replace(f, path=brighter) if f is frame else f for f in small.frames.frames]
    frames = replace(small.frames, frames=tuple(changed))
    network = replace(small, frames=frames).network()
    take(network)
    swimm3r.reconstruct(frames, settings, tmp_path / "c")
    # frame 2 is averaged over its passes with frames 1 and 3, so both are needed again; frames 4 and 5 are far away
    assert {frozenset(p) for p in network.passes} == {frozenset(p) for p in ((0, 1), (1, 2), (2, 3))}


def test_masked_pixels_neither_match_nor_have_depth(small: Dive, tmp_path: Path, take: Callable[[ExactNetwork], None]):
    hidden = tmp_path / "mask.png"
    mask = np.full((96, 128, 3), 255, np.uint8)
    mask[:, :48] = 0
    images.write_rgb(hidden, mask)
    frames = replace(small.frames, frames=tuple(replace(f, mask=hidden) for f in small.frames.frames))
    take(replace(small, frames=frames).network())
    rec = swimm3r.reconstruct(frames, replace(small.settings, graph="swin-1"), tmp_path / "sfm")
    assert rec.matches.xy_i[:, 0].min() > 48
    assert rec.matches.xy_j[:, 0].min() > 48
    assert (rec.depth[rec.names[0]].z_depth[:, :48] == 0).all()
    assert (rec.depth[rec.names[0]].z_depth[:, 56:] > 0).float().mean() > 0.5


def test_the_plan_is_told_before_the_work(
    small: Dive, tmp_path: Path, take: Callable[[ExactNetwork], None], caplog: pytest.LogCaptureFixture
):
    caplog.set_level("INFO", logger="swimm3r")
    take(small.network())

    def stop(what: str, done: int, total: int) -> None:
        raise _Stop

    with pytest.raises(_Stop):
        swimm3r.reconstruct(small.frames, replace(small.settings, graph="video-2-1"), tmp_path, stop)
    assert "6 frames, up to 15 pairs" in caplog.text
    assert "MB of memory" in caplog.text


def test_thinned_matches_are_spread_over_all_pairs(small: Dive, tmp_path: Path, take: Callable[[ExactNetwork], None]):
    take(small.network())
    rec = swimm3r.reconstruct(small.frames, replace(small.settings, max_matches=900), tmp_path)
    assert len(rec.matches.i) <= 900
    assert len({(int(a), int(b)) for a, b in zip(rec.matches.i, rec.matches.j, strict=True)}) == 9
    assert errors(rec, small)[0] < 0.5


def test_capped_points_and_dropped_matches_are_still_counted(
    small: Dive, finished: tuple[Reconstruction, Path], tmp_path: Path, take: Callable[[ExactNetwork], None]
):
    whole, folder = finished
    assert whole.points_found == len(whole.points.xyz)
    take(small.network())
    capped = swimm3r.reconstruct(small.frames, replace(small.settings, max_points=100), tmp_path)
    assert len(capped.points.xyz) == 100
    assert load_reconstruction(tmp_path).points_found == capped.points_found == whole.points_found
    handed = unfiltered_matches(folder, whole)
    assert len(handed.i) >= len(whole.matches.i)
    kept = set(zip(whole.matches.i.tolist(), map(tuple, whole.matches.xy_i.tolist()), strict=True))
    assert kept <= set(zip(handed.i.tolist(), map(tuple, handed.xy_i.tolist()), strict=True))
