"""The MASt3R back end on a synthetic dive, with a network that says the truth, or the truth and 1 % noise."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import swimm3r
from swimm3r.cameras import Cameras, cameras_of, image_directions, project, resized
from swimm3r.errors import DeviceError, InputError, RegistrationError, Swimm3rError, UsageError, WeightsError
from swimm3r.evaluate.poses import absolute_pose_errors
from swimm3r.geometry import align_similarity
from swimm3r.io import images
from swimm3r.io.cameras_json import CameraTable
from swimm3r.scene.frames import Frames
from swimm3r.scene.ground_truth import GroundTruth, read_ground_truth
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction, unfiltered_matches
from swimm3r.sfm.backends import mast3r as mast3r_backend
from swimm3r.sfm.mast3r.network import Architecture, Decoded, Descriptors, Encoded, Mast3r, Pointmap
from swimm3r.sfm.mast3r.settings import AlignmentSettings, MatchingSettings
from swimm3r.sfm.mast3r_sfm import run_pairs
from swimm3r.sfm.mast3r_sfm.network_frames import network_images
from swimm3r.sfm.settings import Mast3rSettings
from swimm3r.synthetic import DiveSettings, write_dive

QUICK = AlignmentSettings(intrinsics="shared", coarse_iterations=80, fine_iterations=80)


CONFIDENCE = 10.0
WAVELENGTHS = (8.0, 2.0, 0.5, 0.125)  # m, along three directions each: 24 numbers that tell places apart to millimetres


class ExactNetwork(Mast3r):
    """Takes the network's place: recognizes its images and says where every pixel's surface truly is."""

    def __init__(self, images: list[Tensor], cameras: Cameras, z_depth: Tensor, noise: float = 0.0) -> None:
        """`z_depth` (n h w) and `cameras` are of the network's images; noise is relative, per pass and pixel."""
        torch.nn.Module.__init__(self)
        self.architecture = Architecture()
        self.mask_token = torch.nn.Parameter(torch.full((1,), noise))
        self.enc_norm = torch.nn.LayerNorm(8)
        self.images, self.cameras, self.z_depth, self.noise = images, cameras, z_depth.double(), noise
        self.encoded, self.passes = [], []
        self.generator = torch.Generator().manual_seed(0)

    def encode(self, images: Tensor, portrait: Tensor | None = None) -> Encoded:
        i = next(k for k, image in enumerate(self.images) if torch.equal(image, images[0]))
        self.encoded.append(i)
        height, width = images.shape[2:]
        count = height * width // 256
        tokens = torch.full((1, count, 8), float(i))
        tokens[..., 1] = 1
        return Encoded(tokens, torch.zeros(1, count, 2, dtype=torch.int64), height, width)

    def decode(self, view1: Encoded, view2: Encoded) -> tuple[Decoded, Decoded]:
        self.passes.append((int(view1.tokens[0, 0, 0]), int(view2.tokens[0, 0, 0])))
        both = (view1.tokens, view2.tokens)
        return Decoded(both, view1.height, view1.width), Decoded(both, view2.height, view2.width)

    def pointmap(self, view: Decoded, which: int) -> Pointmap:
        first, own = self._frames(view, which)
        points = (self._world(own) - self.cameras.centers[first]) @ self.cameras.cam2world[first, :3, :3]
        if self.noise:
            points = points * (1 + self.noise * torch.randn(points.shape, generator=self.generator))
        confidence = torch.full(points.shape[:2], CONFIDENCE)
        return Pointmap(points.float()[None], confidence[None])

    def descriptors(self, view: Decoded, which: int) -> Descriptors:
        world = self._world(self._frames(view, which)[1])
        if self.noise:
            world = world * (1 + self.noise / 10 * torch.randn(world.shape, generator=self.generator))
        waves = torch.tensor([2 * torch.pi / w for w in WAVELENGTHS], dtype=torch.float64)
        phase = (world[..., None] * waves).flatten(2)
        described = torch.cat([phase.cos(), phase.sin()], -1) / 12**0.5
        known = self.z_depth[self._frames(view, which)[1]] > 0
        return Descriptors(described.float()[None], torch.where(known, CONFIDENCE, 1e-3)[None].float())

    @staticmethod
    def _frames(view: Decoded, which: int) -> tuple[int, int]:
        numbers = [int(tokens[0, 0, 0]) for tokens in view.tokens]
        return numbers[0], numbers[which - 1]

    def _world(self, i: int) -> Tensor:
        z = torch.where(self.z_depth[i] > 0, self.z_depth[i], 30.0)  # open water is far away
        seen = image_directions(self.cameras[i]).double() * z[..., None]
        return seen @ self.cameras.cam2world[i, :3, :3].T + self.cameras.centers[i]


@dataclass(frozen=True)
class Dive:
    frames: Frames
    truth: GroundTruth
    settings: Mast3rSettings

    @property
    def cameras(self) -> Cameras:
        """The true cameras of the training frames."""
        return self.truth.cameras[[self.truth.names.index(name) for name in self.frames.train.names]]

    def network(self, noise: float = 0.0, kind: type[ExactNetwork] = ExactNetwork) -> ExactNetwork:
        """One that knows this dive; the network's images are a whole fraction of the frames."""
        train = self.frames.train
        images = network_images(train, self.settings)
        frame = images.framing
        assert (frame.left, frame.top) == (0, 0)
        step = self.frames.width // frame.network_width
        cameras = resized(self.cameras, frame.network_width, frame.network_height)
        depths = [self.truth.z_depth(name) for name in train.names]
        seen = [exact_depth(z_depth, step) for z_depth in depths if z_depth is not None]
        return kind([images.image(i) for i in range(len(train))], cameras, torch.stack(seen), noise)


def exact_depth(z_depth: torch.Tensor, step: int) -> torch.Tensor:
    """On a grid coarser by a whole factor, at the middle of its pixels."""
    if step == 1:
        return z_depth
    return z_depth[step // 2 :: step, step // 2 :: step]  # half a fine pixel off; see the tolerances


@pytest.fixture(autouse=True)
def dry(monkeypatch: pytest.MonkeyPatch) -> None:
    """The water has its own tests; `finished` is made with it."""
    monkeypatch.setattr(mast3r_backend, "with_water", lambda rec, *_: rec)


@pytest.fixture
def take(monkeypatch: pytest.MonkeyPatch) -> Callable[[ExactNetwork], None]:
    """Makes the back end find a network where it looks for a checkpoint."""

    def place(network: ExactNetwork) -> None:
        monkeypatch.setattr(run_pairs.checkpoint, "load", lambda path, device, dtype: network)

    return place


def make_dive(folder: Path, **settings: Any) -> tuple[Frames, GroundTruth]:
    write_dive(DiveSettings(**settings), folder)
    return swimm3r.read_frames(folder, folder=folder / "prepared"), read_ground_truth(folder / "truth")


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Dive:
    """Six training frames of 128 x 96, which the network sees as they are."""
    folder = tmp_path_factory.mktemp("small")
    frames, truth = make_dive(folder, frames=7, width=128, height=96)
    settings = Mast3rSettings(weights=Path(__file__), graph="swin-2", size=128, alignment=QUICK)
    return Dive(frames, truth, settings)


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Dive:
    """Five training frames of the network's own size. A thin graph, fewer searches and half the iterations keep it
    short; SWIMM3R_FULL=1 takes every default instead."""
    frames, truth = make_dive(tmp_path_factory.mktemp("large"), frames=6, width=512, height=384)
    if os.environ.get("SWIMM3R_FULL"):
        return Dive(frames, truth, Mast3rSettings(weights=Path(__file__)))
    settings = Mast3rSettings(
        weights=Path(__file__),
        graph="swin-1",
        matching=MatchingSettings(subsample=16),
        alignment=replace(QUICK, coarse_iterations=150, fine_iterations=150),
    )
    return Dive(frames, truth, settings)


@pytest.fixture(scope="module")
def finished(small: Dive, tmp_path_factory: pytest.TempPathFactory) -> tuple[Reconstruction, Path]:
    folder = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        network = small.network()
        patch.setattr(run_pairs.checkpoint, "load", lambda *_: network)
        return swimm3r.reconstruct(small.frames, small.settings, folder), folder


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


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"focal": 100.0}, UsageError, "--known and --focal contradict each other"),
        ({"bundle_adjustment": True}, UsageError, "--known and --bundle-adjustment contradict"),
        ({}, InputError, "none of the 6 frames is in"),
    ],
    ids=lambda value: next(iter(value), "names") if isinstance(value, dict) else "",
)
def test_known_cameras_that_do_not_fit_are_refused(
    change: dict, error: type[Swimm3rError], message: str, small: Dive, tmp_path: Path
):
    table = CameraTable(
        ("reef.jpg",), 128, 96, "PINHOLE", small.cameras.K[:1].numpy(), np.zeros((1, 0)), np.eye(4)[None]
    )
    cameras_of(table).save(tmp_path / "cameras.json", table.names, table.times, table.units)
    with pytest.raises(error, match=message):
        swimm3r.reconstruct(small.frames, replace(small.settings, known=tmp_path / "cameras.json", **change), tmp_path)


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


class Strangers(ExactNetwork):
    """Frames of the two halves of the dive have nothing in common; `alone` makes all frames strangers."""

    alone = False

    def descriptors(self, view, which):
        found = super().descriptors(view, which)
        a, b = (int(tokens[0, 0, 0]) for tokens in view.tokens)
        if self.alone or (a < self.border) != (b < self.border):
            found.descriptors[:] = 0.2
        return found

    border = 3


class OneStranger(Strangers):
    border = 5


class Hermits(Strangers):
    alone = True


class NotANumber(ExactNetwork):
    def pointmap(self, view, which):
        found = super().pointmap(view, which)
        found.points[0, 5, 7] = torch.nan
        return found


@pytest.mark.parametrize(
    ("kind", "error", "code", "message"),
    [
        (Hermits, RegistrationError, 6, "not one pixel of the 6 frames matches"),
        (Strangers, RegistrationError, 6, "2 groups without enough matches between them, of 3, 3 frames"),
        (NotANumber, WeightsError, 4, "pointmap is not finite at 1 of 12,288 pixels"),
    ],
)
def test_what_the_network_may_say_wrong(
    kind: type[ExactNetwork],
    error: type[Swimm3rError],
    code: int,
    message: str,
    small: Dive,
    tmp_path: Path,
    take: Callable[[ExactNetwork], None],
):
    take(small.network(kind=kind))
    with pytest.raises(error) as caught:
        swimm3r.reconstruct(small.frames, small.settings, tmp_path)
    assert message in caught.value.what
    assert caught.value.exit_code == code
    assert caught.value.hint


def test_a_single_stray_frame_is_left_out_under_a_warning(
    small: Dive, tmp_path: Path, take: Callable[[ExactNetwork], None]
):
    take(small.network(kind=OneStranger))
    rec = swimm3r.reconstruct(small.frames, replace(small.settings, min_share=0.8), tmp_path)
    assert rec.names == small.frames.train.names[:5]
    assert "1 of 6 frames match no other" in rec.warnings[0].what


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"graph": "vidoe"}, UsageError, "no pair graph 'vidoe'"),
        ({"focal": 2.8}, UsageError, "a focal length of 2.8 px does not fit"),
        ({"camera": "OPENCV", "k1": 0.1}, UsageError, "must be known before the network"),
        ({"focal": 200.0, "k1": 0.1}, UsageError, "PINHOLE has no k1"),
        ({"weights": Path("/nowhere/mast3r.pth")}, WeightsError, "there are no weights at /nowhere/mast3r.pth"),
        ({"device": "mps"}, DeviceError, "there is no mps device"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_settings_that_cannot_work_are_refused(
    change: dict, error: type[Swimm3rError], message: str, small: Dive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    with pytest.raises(error, match=message):
        swimm3r.reconstruct(small.frames, replace(small.settings, **change), tmp_path)


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
