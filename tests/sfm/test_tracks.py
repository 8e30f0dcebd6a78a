"""Tracks from matches: who belongs together, who is thrown out."""

import torch

from swimm3r.cameras import Cameras, project
from swimm3r.sfm.tracks import FrameMatches, consistent, join, most_seen, reprojection_errors, without

WIDTH, HEIGHT = 40, 30


def matches(*rows: tuple[int, tuple[int, int], int, tuple[int, int], float]) -> FrameMatches:
    i, xy_i, j, xy_j, confidence = zip(*rows, strict=True)
    xyz = torch.arange(3.0 * len(rows)).reshape(-1, 3)
    a, b, at_a, at_b, sure = (torch.tensor(column) for column in (i, j, xy_i, xy_j, confidence))
    return FrameMatches(a, b, at_a, at_b, sure, xyz)


def observations(tracks) -> set[frozenset[tuple[int, int, int]]]:
    rows = list(zip(tracks.point.tolist(), tracks.frame.tolist(), tracks.xy.tolist(), strict=True))
    return {frozenset((f, *xy) for p, f, xy in rows if p == point) for point in range(len(tracks.xyz))}


def test_matches_that_share_a_pixel_are_one_track():
    found = join(
        matches(
            (0, (1, 2), 1, (3, 4), 1.0),
            (1, (3, 4), 2, (5, 6), 1.0),
            (0, (9, 9), 2, (8, 8), 1.0),
            (1, (4, 3), 2, (6, 5), 1.0),
        ),
        WIDTH,
        HEIGHT,
    )
    assert observations(found) == {
        frozenset({(0, 1, 2), (1, 3, 4), (2, 5, 6)}),
        frozenset({(0, 9, 9), (2, 8, 8)}),
        frozenset({(1, 4, 3), (2, 6, 5)}),
    }


def test_a_track_that_comes_back_to_a_frame_keeps_the_surer_pixel():
    found = join(
        matches((0, (1, 1), 1, (2, 2), 1.0), (1, (2, 2), 2, (3, 3), 2.0), (0, (5, 5), 2, (3, 3), 3.0)), WIDTH, HEIGHT
    )
    assert observations(found) == {frozenset({(0, 5, 5), (1, 2, 2), (2, 3, 3)})}


def test_the_point_is_the_mean_of_its_matches_by_confidence():
    found = join(matches((0, (1, 1), 1, (2, 2), 1.0), (1, (2, 2), 2, (3, 3), 3.0)), WIDTH, HEIGHT)
    torch.testing.assert_close(found.xyz, torch.tensor([[2.25, 3.25, 4.25]], dtype=torch.float64))


def test_points_left_in_one_frame_are_dropped_and_the_most_seen_stay():
    found = join(
        matches(
            (0, (1, 1), 1, (2, 2), 1.0),
            (1, (2, 2), 2, (3, 3), 1.0),
            (0, (7, 7), 1, (8, 8), 1.0),
            (0, (9, 9), 1, (6, 6), 1.0),
        ),
        WIDTH,
        HEIGHT,
    )
    bad = (found.frame == 0) & (found.xy == torch.tensor([7, 7])).all(1)
    kept = without(found, bad)
    assert observations(kept) == {frozenset({(0, 1, 1), (1, 2, 2), (2, 3, 3)}), frozenset({(0, 9, 9), (1, 6, 6)})}
    assert observations(most_seen(kept, 10)) == observations(kept)
    assert observations(most_seen(kept, 1)) == {frozenset({(0, 1, 1), (1, 2, 2), (2, 3, 3)})}


def camera_pair() -> Cameras:
    K = torch.tensor([[30.0, 0, 20], [0, 30, 15], [0, 0, 1]], dtype=torch.float64).repeat(2, 1, 1)
    pose = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    pose[1, 0, 3] = 0.3
    return Cameras(K, torch.zeros(2, 0), pose, WIDTH, HEIGHT)


def test_reprojection_errors_are_pixels_and_infinite_behind_the_camera():
    cameras = camera_pair()
    xyz = torch.tensor([[0.1, 0.2, 2.0], [0.1, 0.2, -2.0]], dtype=torch.float64)
    xy = project(cameras[1], xyz[None])[0][0] + torch.tensor([3.0, 4.0])
    errors = reprojection_errors(cameras, torch.tensor([1, 1]), xy, xyz)
    torch.testing.assert_close(errors[0], torch.tensor(5.0, dtype=torch.float64))
    assert errors[1] == torch.inf


def test_a_match_must_fit_in_both_frames():
    cameras = camera_pair()
    xyz = torch.tensor([[0.1, 0.2, 2.0], [0.1, 0.2, 2.0]], dtype=torch.float64)
    uv = project(cameras, xyz.expand(2, 2, 3))[0].floor().long()
    off = uv[1] + torch.tensor([[0, 0], [9, 0]])
    found = FrameMatches(torch.zeros(2).long(), torch.ones(2).long(), uv[0], off, torch.ones(2), xyz)
    assert consistent(found, cameras, 1.5).tolist() == [True, False]
