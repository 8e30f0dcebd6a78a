"""Two visits in one frame: the similarity, its uncertainty, and what the joint adjustment takes out."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float
from tests.visits.conftest import Visits

from swimm3r.cameras import Cameras, project
from swimm3r.errors import RegistrationError
from swimm3r.geometry import align_similarity, pose_from, so3_exp
from swimm3r.progress import silent
from swimm3r.scene.reconstruction import DepthMap, DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.sim3 import Sim3
from swimm3r.visits.alignment.depth import with_depth
from swimm3r.visits.alignment.joint import Joint, Link, map_jointly, moved, shape_similarity
from swimm3r.visits.alignment.matches import VisitMatches
from swimm3r.visits.alignment.misfit import Bends, Fit, fits_between
from swimm3r.visits.alignment.place import place_visits
from swimm3r.visits.alignment.similarity import Alignment, Known, align
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
    return VisitMatches(of[0][0], of[1][0], of[0][1], of[1][1], of[0][2], of[1][2], np.zeros(len(at_a), bool))


def joined(a: Reconstruction, b: Reconstruction, matches: VisitMatches, found: Alignment) -> Joint:
    """Both visits after joint mapping."""
    verified = matches.select(found.verified)
    return map_jointly((a, moved(b, found.a_from_b)), [Link(0, 1, verified, found.inlier[found.verified])])


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


@pytest.mark.long
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
    joint = joined(a, b, matches, found)
    after = joint.recs[1].points.xyz.numpy() - joint.recs[0].points.xyz.numpy()
    seen = np.unique(matches.point_b)
    misses = [float(np.median(np.linalg.norm(each[seen], axis=1))) for each in (before, after)]
    assert misses[1] < 0.25 * misses[0]
    assert len(joint.checks[0]) > 20


def test_the_frame_and_the_unit_stay_those_of_the_first_visit(tmp_path):
    a, b = dive(tmp_path, ground(), 1, 0.3), dive(tmp_path, ground(), 2, 0.3)
    matches = matched(a, b)
    first = joined(a, b, matches, align(a, b, matches, NAMES)).recs[0]
    stays = shape_similarity(a, first)
    assert stays.scale == pytest.approx(1.0, abs=1e-4)
    assert pytest.approx(np.eye(3), abs=1e-6) == stays.R
    off = first.cameras.centers - a.cameras.centers
    size = float((a.cameras.centers[0] - a.cameras.centers[-1]).norm())
    assert 0 < float(off.norm(dim=1).max()) < 0.01 * size  # it is not held, and does not wander


def test_the_bend_of_the_first_visit_is_taken_out_by_a_later_one(tmp_path):
    """A first visit whose frames share too few points to be stiff, and a later one that spans them."""
    a, b = dive(tmp_path, ground(), 1, 0.2), dive(tmp_path, ground(), 2, 0.2)
    size = float((a.cameras.centers[0] - a.cameras.centers[-1]).norm())
    bent = a.cameras.cam2world.clone()
    bent[:, :3, 3] += 0.01 * size * torch.linspace(-1, 1, FRAMES)[:, None].double() ** 2 * bent[0, :3, 2]
    crooked = replace(a, cameras=replace(a.cameras, cam2world=bent))
    matches = matched(a, b)
    first = joined(crooked, b, matches, align(a, b, matches, NAMES)).recs[0]
    before, after = (align_similarity(r.cameras.centers, a.cameras.centers) for r in (crooked, first))
    misses = [
        float((by.points(r.cameras.centers) - a.cameras.centers).norm(dim=1).mean())
        for by, r in ((before, crooked), (after, first))
    ]
    assert misses[1] < 0.3 * misses[0]


def test_points_on_changed_ground_become_no_common_points(tmp_path):
    later = ground()
    raised = later[:, 0] < 0.6
    later[raised, 2] += 0.05
    a, b = dive(tmp_path, ground(), 1, 0.1), dive(tmp_path, later, 2, 0.1)
    matches = matched(a, b)
    joint = joined(a, b, matches, align(a, b, matches, NAMES))
    unit = float(np.ptp(a.points.xyz.numpy(), axis=0).max()) / 3
    off = (joint.recs[1].points.xyz - joint.recs[0].points.xyz).norm(dim=1).numpy() / unit
    both = np.unique(matches.point_a)
    assert np.median(off[both][~raised[both]]) < 0.004
    assert np.median(off[both][raised[both]]) == pytest.approx(0.05, abs=0.02)


def test_depth_maps_follow_the_adjusted_poses(tmp_path):
    a = dive(tmp_path, ground(), 1, 0.0)
    depth = DepthMaps(tmp_path)
    for name in a.names:
        depth.write(name, DepthMap(torch.full((4, 4), 2.0), torch.ones(4, 4)))
    larger = moved(a, Sim3(3.0, np.eye(3), np.zeros(3)))
    placed = with_depth(a, larger, 1.0)
    assert placed.depth[a.names[0]].z_depth == pytest.approx(6.0)
    nowhere = replace(a, tracks=Tracks(*(values[:0] for values in (a.tracks.point, a.tracks.frame, a.tracks.xy))))
    assert with_depth(nowhere, larger, 2.5).depth[a.names[0]].z_depth == pytest.approx(5.0)


def test_georeferences_add_to_what_few_points_say(tmp_path):
    a, b = dive(tmp_path, ground(), 1, 0.3), dive(tmp_path, ground(), 2, 0.3)
    matches = matched(a, b)
    by_images = align(a, b, matches, NAMES)
    tight = Known(by_images.a_from_b, np.diag([1e-4, *[1e-4] * 3, *[1e-3] * 3]) ** 2, by_images.pivot)
    with_both = align(a, b, matches, NAMES, tight)
    at = a.points.xyz.numpy()[:50]
    stds = [np.trace(each.covariance_at(at).sum(0)) for each in (by_images, with_both)]
    assert stds[1] < stds[0]
    assert with_both.off_georeference == pytest.approx(0.0, abs=0.5)
    shift = np.array([0.1, 0.0, 0.0])
    elsewhere = replace(tight, a_from_b=Sim3(tight.a_from_b.scale, tight.a_from_b.R, tight.a_from_b.t + shift))
    off = align(a, b, matches, NAMES, elsewhere).off_georeference
    assert off is not None
    assert off > 3


def test_two_markers_align_visits_whose_images_do_not_match(tmp_path):
    a, b = dive(tmp_path, ground(), 1, 0.2), dive(tmp_path, ground(), 2, 0.2)
    corners = matched(a, b).select(np.arange(0, 320, 40))
    coded = replace(corners, coded=np.ones(len(corners), bool))
    with pytest.raises(RegistrationError):
        align(a, b, corners, NAMES)
    found = align(a, b, coded, NAMES)
    assert found.source == "markers"
    assert apart(a, b, found) < 0.01


@pytest.mark.long
def test_real_features_align_visits_in_other_light_over_changed_ground(visits: Visits):
    a, b = visits.surveys()
    first, later = place_visits((a, b), NAMES, VisitSettings(), silent)
    assert first.fit is None
    assert later.fit is not None
    assert later.fit.check_points > 30
    assert later.fit.level < 0.003 * 1.3  # of the site's extent
    assert later.fit.up < 0.003 * 1.3
    # depth maps come along, into the unit of the first visit
    rec = later.survey.rec
    assert float(rec.depth[rec.names[0]].z_depth.median()) * a.scale == pytest.approx(1.0, abs=0.1)


def test_ground_far_from_shared_points_is_as_uncertain_as_most_of_them():
    """Bends of 0.02 but for one neighborhood at the rim, which happens to lie right: the ground beyond it need not."""
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 1, (200, 2))
    off = np.full((200, 3), 0.02)
    bent = Bends(xy, off)
    rim = int(xy[:, 0].argmax())
    off = off.copy()
    off[rim] = 0.0
    lucky = Bends(xy, off)
    beyond, beside = xy[rim][None] + [[0.5, 0.0]], xy[rim][None] + [[1e-6, 0.0]]
    for k in range(2):
        assert lucky.at(beyond)[k][0] > 0.95 * bent.at(beyond)[k][0]
        np.testing.assert_allclose(lucky.at(beside)[k], lucky.spread[k], rtol=1e-3)  # never less than a typical one


def test_ground_beside_shared_points_has_their_offset():
    xy = np.stack(np.meshgrid(np.arange(10.0), np.arange(10.0)), -1).reshape(-1, 2)
    off = np.full((100, 3), 0.01)
    off[:10] = 0.09
    level, up = Bends(xy, off).at(xy)
    np.testing.assert_allclose(up[:10], 0.09, rtol=1e-6)
    np.testing.assert_allclose(level[50:], Bends(xy, off).spread[0], rtol=1e-6)


@pytest.mark.parametrize(
    ("onto", "earlier", "later", "between"),
    [
        ({"b": "a"}, "a", "b", "b"),
        ({"b": "a", "c": "a"}, "b", "c", "bc"),
        ({"b": "a", "c": "b"}, "b", "c", "c"),
        ({"b": "a", "c": "a", "d": "b"}, "c", "d", "cdb"),
        ({"b": "a", "c": "b", "d": "a"}, "c", "d", "cbd"),
    ],
)
def test_two_visits_are_as_uncertain_as_all_steps_from_one_to_the_other(onto, earlier, later, between):
    none = np.zeros(0, bool)
    alignment = Alignment("images", Sim3(1.0, np.eye(3), np.zeros(3)), np.zeros((7, 7)), np.zeros(3), none, none, 0)
    fits = {name: Fit(to, alignment, ord(name), 0, None, 0.0, 0.0, None) for name, to in onto.items()}
    found = fits_between(earlier, later, {"a": None, **fits})
    assert [chr(fit.check_points) for fit in found] == list(between)
