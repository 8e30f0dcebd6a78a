"""Two visits in one frame: the similarity, its uncertainty, and what the joint adjustment takes out."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float
from tests.visits.conftest import Visits

from swimm3r.cameras import Cameras, project
from swimm3r.errors import RegistrationError
from swimm3r.geometry import pose_from, so3_exp
from swimm3r.scene.reconstruction import DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.visits.adjustment import place
from swimm3r.visits.alignment import Alignment, align
from swimm3r.visits.matches import VisitMatches, landmarks_of, match_visits
from swimm3r.visits.settings import VisitSettings

FRAMES, POINTS = 8, 400
NAMES = ("spring", "autumn")


def dive(tmp_path, xyz: Float[np.ndarray, "p 3"], seed: int, noise: float) -> Reconstruction:
    """A line of cameras over points on the ground, observations with noise in pixels, in a frame of its own."""
    rng = np.random.default_rng(seed)
    scale, R, t = rng.uniform(0.3, 3), so3_exp(torch.from_numpy(rng.normal(0, 1, 3))[None])[0], rng.normal(0, 2, 3)
    down = torch.from_numpy(np.diag([1.0, -1.0, -1.0]))
    centers = np.stack([np.linspace(0.3, 2.7, FRAMES), np.full(FRAMES, 0.5), np.full(FRAMES, 1.2)], 1)
    centers += rng.normal(0, 0.05, centers.shape)
    world = pose_from(down.expand(FRAMES, 3, 3), torch.from_numpy(centers))
    K = torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]], dtype=torch.float64).repeat(FRAMES, 1, 1)
    cameras = Cameras(K, torch.zeros(FRAMES, 0, dtype=torch.float64), world, 320, 240)
    pixels, z = project(cameras, torch.from_numpy(xyz).expand(FRAMES, -1, 3))
    inside = (z > 0) & (pixels > 0).all(-1) & (pixels[..., 0] < 320) & (pixels[..., 1] < 240)
    frame, point = torch.nonzero(inside, as_tuple=True)
    observed = pixels[frame, point] + torch.from_numpy(rng.normal(0, noise, (len(frame), 2)))
    own = pose_from(R @ world[:, :3, :3], scale * world[:, :3, 3] @ R.mT + torch.from_numpy(t))
    moved = scale * torch.from_numpy(xyz) @ R.mT + torch.from_numpy(t)
    none = torch.zeros(0, dtype=torch.int64)
    return Reconstruction(
        names=tuple(f"{i}.png" for i in range(FRAMES)),
        cameras=replace(cameras, cam2world=own),
        points=Points(moved, torch.zeros(len(xyz), 3), torch.zeros(len(xyz), dtype=torch.float64)),
        tracks=Tracks(point, frame, observed),
        matches=Matches(none, none, torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0)),
        depth=DepthMaps(tmp_path),
        backend="truth",
    )


def ground(seed: int = 0) -> Float[np.ndarray, "p 3"]:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(0, 3, POINTS), rng.uniform(0, 1, POINTS), rng.normal(0, 0.05, POINTS)])


def matched(a: Reconstruction, b: Reconstruction, wrong: float = 0.0, seed: int = 0) -> VisitMatches:
    """The same points of both visits, a share of them with others."""
    rng, rows = np.random.default_rng(seed), []
    for point in range(POINTS):
        seen = [np.flatnonzero((rec.tracks.point == point).numpy()) for rec in (a, b)]
        if all(len(each) for each in seen):
            rows.append([int(each[0]) for each in seen])
    at_a, at_b = np.array(rows).T
    swapped = rng.permutation(len(at_b))[: int(wrong * len(at_b))]
    at_b = at_b.copy()
    at_b[swapped] = np.roll(at_b[swapped], 1)
    of = [(rec.tracks.point.numpy()[at], rec.tracks.frame.numpy()[at], rec.tracks.xy.numpy()[at]) for rec, at in
          ((a, at_a), (b, at_b))]  # fmt: skip
    return VisitMatches(of[0][0], of[1][0], of[0][1], of[1][1], of[0][2], of[1][2])


def apart(a: Reconstruction, b: Reconstruction, found: Alignment) -> float:
    """Root mean square distance of the points of both in the first visit's frame, by the size of the site."""
    off = found.a_from_b(b.points.xyz.numpy()) - a.points.xyz.numpy()
    size = float(np.ptp(a.points.xyz.numpy(), axis=0).max())
    return float(np.sqrt((off**2).sum(1).mean())) / size


def test_exact_visits_align_exactly_with_half_of_the_matches_wrong(tmp_path):
    a, b = dive(tmp_path, ground(), 1, 0.0), dive(tmp_path, ground(), 2, 0.0)
    found = align(a, b, matched(a, b, wrong=0.5), NAMES)
    assert apart(a, b, found) < 1e-6
    assert found.inlier.mean() == pytest.approx(0.5, abs=0.05)


def test_changed_ground_does_not_pull_the_alignment(tmp_path):
    later = ground()
    raised = later[:, 0] < 0.6  # a fifth of the ground is 1 cm higher: within the bound of outliers
    later[raised, 2] += 0.01
    a, b = dive(tmp_path, ground(), 1, 0.1), dive(tmp_path, later, 2, 0.1)
    found = align(a, b, matched(a, b), NAMES)
    off = found.a_from_b(b.points.xyz.numpy())[~raised] - a.points.xyz.numpy()[~raised]
    unit = float(np.ptp(a.points.xyz.numpy()[:, :], axis=0).max()) / 3  # a metre, about
    assert np.sqrt((off**2).sum(1).mean()) < 0.003 * unit


def test_the_stated_uncertainty_covers_the_error(tmp_path):
    ratios = []
    for seed in range(6):
        a, b = dive(tmp_path, ground(seed), 10 + seed, 0.5), dive(tmp_path, ground(seed), 20 + seed, 0.5)
        rng = np.random.default_rng(seed)
        noisy = [
            replace(
                rec,
                points=replace(rec.points, xyz=rec.points.xyz + torch.from_numpy(rng.normal(0, 0.002, (POINTS, 3)))),
            )
            for rec in (a, b)
        ]
        found = align(noisy[0], noisy[1], matched(a, b, seed=seed), NAMES)
        at = a.points.xyz.numpy()[:50]
        error = found.a_from_b(b.points.xyz.numpy()[:50]) - at
        ratios.append(np.sqrt((error**2).sum() / np.trace(found.covariance_at(at).sum(0))))
    assert 0.3 < np.median(ratios) < 3.0


def test_visits_of_different_places_are_refused_with_advice(tmp_path):
    a, b = dive(tmp_path, ground(1), 1, 0.3), dive(tmp_path, ground(2), 2, 0.3)
    with pytest.raises(RegistrationError, match="autumn could not be aligned with spring") as refused:
        align(a, b, matched(a, b, wrong=1.0), NAMES)
    assert refused.value.exit_code == 6
    assert "overlap" in refused.value.hint


def test_too_few_matches_are_refused(tmp_path):
    a, b = dive(tmp_path, ground(), 1, 0.0), dive(tmp_path, ground(), 2, 0.0)
    with pytest.raises(RegistrationError, match="0 of 10 matched points agree"):
        align(a, b, matched(a, b).select(np.arange(10)), NAMES)


def test_the_joint_adjustment_takes_a_bend_out(tmp_path):
    a = dive(tmp_path, ground(), 1, 0.2)
    bent = ground()
    bent[:, 2] += 0.02 * (bent[:, 0] - 1.5) ** 2  # 45 mm at the ends of 3 m
    b = dive(tmp_path, ground(), 2, 0.2)
    scale = float((b.points.xyz[0] - b.points.xyz[1]).norm()) / float(np.linalg.norm(ground()[0] - ground()[1]))
    shape = torch.from_numpy(bent - ground()) * scale
    R = torch.linalg.lstsq(torch.from_numpy(ground() - ground().mean(0)), b.points.xyz - b.points.xyz.mean(0)).solution
    bend = shape @ (R / scale)
    # the reconstruction is bent, its observations are not
    b = replace(b, points=replace(b.points, xyz=b.points.xyz + bend))
    matches = matched(a, b)
    found = align(a, b, matches, NAMES)
    before = found.a_from_b(b.points.xyz.numpy()) - a.points.xyz.numpy()
    placed = place(a, b, matches, found)
    after = placed.rec.points.xyz.numpy() - a.points.xyz.numpy()
    seen = np.unique(matches.point_b)
    misses = [float(np.median(np.linalg.norm(each[seen], axis=1))) for each in (before, after)]
    assert misses[1] < 0.25 * misses[0]
    assert len(placed.check.xyz_a) > 20


def test_real_features_align_visits_in_other_light_over_changed_ground(visits: Visits):
    a, b = visits.surveys()
    settings = VisitSettings()
    matches = match_visits(landmarks_of(a, 100), landmarks_of(b, 100), settings)
    found = align(a.rec, b.rec, matches, NAMES)
    placed = place(a.rec, b.rec, matches, found)
    off = a.place.to_local(placed.check.xyz_b - placed.check.xyz_a)
    assert len(off) > 30
    assert np.median(np.linalg.norm(off, axis=1)) < 0.003 * 1.3  # of the site's extent
    # depth maps come along, into the unit of the first visit
    name = placed.rec.names[0]
    assert float(placed.rec.depth[name].z_depth.median()) * a.scale == pytest.approx(1.0, abs=0.1)
