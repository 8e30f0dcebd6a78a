"""Rows exposed one after another: planted observations of cameras whose path and readout time are known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from swimm3r.cameras import Cameras, project
from swimm3r.errors import UsageError
from swimm3r.geometry import rotation_angle
from swimm3r.prepare import read_frames
from swimm3r.scene.reconstruction import DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.sfm.colmap.poses import reconstruct
from swimm3r.sfm.colmap.shutter.readout import adjust_rolling, motion_of
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.synthetic import make_dive, write_dive
from swimm3r.synthetic.settings import DiveSettings

WIDTH, HEIGHT, FOCAL = 480, 360, 450.0
TIMES = np.arange(24) * 0.2
NOISE = 0.2  # px


def path(times: np.ndarray) -> Float[np.ndarray, "n 4 4"]:
    """cam2world 1.5 m over the ground, swaying by a few degrees, 0.4 m/s ahead."""
    yaw, pitch, roll = (
        a * np.sin(2 * np.pi * times / T + b) for a, T, b in ((0.2, 2.9, 0), (0.12, 2.3, 1), (0.15, 3.7, 2))
    )
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    down = Rotation.from_euler("x", 180, degrees=True)
    poses[:, :3, :3] = (down * Rotation.from_euler("zyx", np.stack([yaw, pitch, roll], 1))).as_matrix()
    poses[:, :3, 3] = np.stack([0.3 * np.sin(times), 0.4 * times, 1.5 + 0.1 * np.sin(1.7 * times)], 1)
    return poses


def cameras_at(times: np.ndarray, squeeze: float = 1.0) -> Cameras:
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL * squeeze, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    model, k = ("SIMPLE_RADIAL", [0.02]) if squeeze == 1 else ("OPENCV", [0.02, 0, 0, 0])
    distortion = torch.tensor(k, dtype=torch.float64).repeat(len(times), 1)
    return Cameras(K.repeat(len(times), 1, 1), distortion, torch.from_numpy(path(times)), WIDTH, HEIGHT, model)


def filmed(readout: float, squeeze: float = 1.0) -> Reconstruction:
    """The truth at half of every exposure, with observations of rows that were exposed within `readout` seconds."""
    rng = np.random.default_rng(5)
    ground = np.stack([rng.uniform(-1.4, 1.4, 2500), rng.uniform(-1.2, 3.0, 2500), 0.25 * rng.normal(size=2500)], 1)
    xyz = torch.from_numpy(ground)
    rows: list[tuple[int, int, list[float]]] = []
    for i, time in enumerate(TIMES):
        moments = np.full(len(xyz), time)
        for _ in range(4):  # a point is seen when its row is exposed
            xy, z = project(cameras_at(moments, squeeze), xyz[:, None])
            moments = time + (xy[:, 0, 1].numpy() / HEIGHT - 0.5) * readout
        seen = (z[:, 0] > 0) & (xy[:, 0] > 0).all(-1) & (xy[:, 0, 0] < WIDTH) & (xy[:, 0, 1] < HEIGHT)
        noisy = xy[:, 0] + NOISE * torch.from_numpy(rng.normal(size=(len(xyz), 2)))
        rows += [(p, i, noisy[p].tolist()) for p in seen.nonzero().flatten().tolist()]
    often = torch.bincount(torch.tensor([p for p, _, _ in rows]), minlength=len(xyz)) >= 3
    rows, new = [row for row in rows if often[row[0]]], often.cumsum(0) - 1
    point, frame = new[torch.tensor([p for p, _, _ in rows])], torch.tensor([i for _, i, _ in rows])
    xyz = xyz[often]
    none = torch.zeros(0, dtype=torch.int64)
    return Reconstruction(
        names=tuple(f"{i:04d}.png" for i in range(len(TIMES))),
        cameras=cameras_at(TIMES, squeeze),
        points=Points(xyz, torch.rand(len(xyz), 3), torch.full((len(xyz),), NOISE, dtype=torch.float64)),
        tracks=Tracks(point, frame, torch.tensor([row[2] for row in rows], dtype=torch.float64)),
        matches=Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)),
        depth=DepthMaps(Path("z_depth")),
        backend="truth",
    )


def degrees_off(cameras: Cameras, truth: np.ndarray | None = None) -> Float[torch.Tensor, " n"]:
    """Angles to the true orientations after the rotation that fits them best."""
    poses = cameras.cam2world.numpy(), path(TIMES) if truth is None else truth
    found, true = (Rotation.from_matrix(each[:, :3, :3]) for each in poses)
    best = (true * found.inv()).mean()
    return torch.rad2deg(rotation_angle(torch.from_numpy((true.inv() * best * found).as_matrix())))


@pytest.mark.parametrize(
    ("readout", "squeeze"),
    [(0.02, 1.0), pytest.param(-0.02, 1.0, marks=pytest.mark.long), pytest.param(0.01, 4 / 3, marks=pytest.mark.long)],
)
def test_readout_poses_and_lens_are_found_from_the_frames(readout: float, squeeze: float):
    film = filmed(readout, squeeze)
    at_once = adjust_rolling(film, TIMES.tolist(), 0.0, lens=True).reconstruction
    rolled = adjust_rolling(at_once, TIMES.tolist(), None, lens=True)
    assert rolled.warning is None
    assert rolled.std is not None
    assert rolled.readout == pytest.approx(readout, abs=0.0015)
    assert abs(rolled.readout - readout) < 4 * rolled.std
    found = rolled.reconstruction
    assert degrees_off(found.cameras).max() < 0.05 < degrees_off(at_once.cameras).max()
    K = found.cameras.K[0]
    assert K[0, 0].item() == pytest.approx(FOCAL, rel=0.002)
    assert (K[1, 1] / K[0, 0]).item() == pytest.approx(squeeze, abs=1e-12)
    assert (found.cameras.height, found.cameras.model) == (HEIGHT, film.cameras.model)
    torch.testing.assert_close(found.tracks.xy, film.tracks.xy, rtol=0, atol=0)


def test_a_readout_that_is_given_is_used_and_a_lens_that_is_held_stays():
    film = filmed(0.02)
    rolled = adjust_rolling(film, TIMES.tolist(), 0.02, lens=False)
    assert (rolled.readout, rolled.std, rolled.warning) == (0.02, None, None)
    assert degrees_off(rolled.reconstruction.cameras).max() < 0.04
    torch.testing.assert_close(rolled.reconstruction.cameras.K, film.cameras.K, rtol=0, atol=0)


@pytest.mark.parametrize("still", [False, True])
def test_frames_that_show_no_rolling_shutter_stay_as_they_are(still: bool):
    film = filmed(0.0)
    times = [0.0] * len(TIMES) if still else TIMES.tolist()  # without times there is no motion
    rolled = adjust_rolling(film, times, None, lens=True)
    assert rolled.reconstruction is film
    assert rolled.readout == 0.0
    assert rolled.warning is not None
    assert "do not show a rolling shutter" in rolled.warning.what


def test_velocities_are_those_of_the_path_and_none_across_a_gap():
    times = np.concatenate([TIMES[:12], TIMES[12:] + 5.0, [99.0]])
    motion = motion_of(cameras_at(times), times.tolist())
    inner = [*range(2, 10), *range(14, 22)]
    before, after = (path(times + dt) for dt in (-1e-4, 1e-4))
    R = Rotation.from_matrix(path(times)[:, :3, :3])
    moving = R.inv().apply((after[:, :3, 3] - before[:, :3, 3]) / 2e-4)
    turning = (
        Rotation.from_matrix(before[:, :3, :3]).inv() * Rotation.from_matrix(after[:, :3, :3])
    ).as_rotvec() / 2e-4
    np.testing.assert_allclose(motion.moving[inner], moving[inner], atol=0.01)
    np.testing.assert_allclose(motion.turning[inner], turning[inner], atol=0.01)
    assert not motion.moving[-1].any()
    assert not motion.turning[-1].any()
    shuffled = np.random.default_rng(0).permutation(len(times))
    again = motion_of(cameras_at(times[shuffled]), times[shuffled].tolist())
    np.testing.assert_allclose(again.turning, motion.turning[shuffled], atol=1e-12)


@pytest.mark.long
def test_a_dive_through_a_rolling_shutter_is_straightened(tmp_path: Path):
    settings = DiveSettings(frames=24, width=240, height=160, fps=2.0, readout=0.05)
    write_dive(settings, tmp_path / "dive")
    frames = read_frames(tmp_path / "dive", folder=tmp_path / "prepare").train
    stills = ColmapSettings(shutter="rolling", readout=0.05 * settings.fps, threads=2)  # in intervals
    plain = reconstruct(frames, replace(stills, shutter="global", readout=None), tmp_path / "sfm")
    rec = reconstruct(frames, stills, tmp_path / "sfm")  # the database knows nothing of the shutter
    dive = make_dive(settings)
    truth = dive.cameras.cam2world[[dive.names.index(name) for name in rec.names]].numpy()
    assert degrees_off(rec.cameras, truth).mean() < 0.4 * degrees_off(plain.cameras, truth).mean()
    assert rec.points.error.mean() < plain.points.error.mean()
    assert not [warning for warning in rec.warnings if "rolling" in warning.what]


@pytest.mark.parametrize(
    ("asked", "words"),
    [({"readout": 0.01}, "--readout needs"), ({"shutter": "rolling", "housing": "flat"}, "exclude each other")],
)
def test_settings_that_contradict_themselves_are_refused(asked: dict[str, object], words: str):
    with pytest.raises(UsageError, match=words):
        ColmapSettings(**asked)  # type: ignore[arg-type]
