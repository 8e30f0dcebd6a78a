"""Group axioms, exactness at the difficult angles, alignment that recovers what was applied, epipolar truth."""

import math

import pytest
import torch

from swimm3r.geometry import (
    DegenerateAlignmentError,
    Similarity,
    align_poses,
    align_similarity,
    best_similarity,
    epipolar_distances,
    essential_from_poses,
    fundamental_from_poses,
    invert_poses,
    mean_rotation,
    pose_from,
    quaternion_from_rotation,
    relative_poses,
    rotation_angle,
    rotation_from_6d,
    rotation_from_quaternion,
    rotation_to_6d,
    skew,
    so3_exp,
    so3_log,
    symmetric_epipolar_error,
)

K = torch.tensor([[900.0, 0, 640], [0, 910, 360], [0, 0, 1]], dtype=torch.float64)


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def some_poses(n: int, seed: int = 0) -> torch.Tensor:
    g = rng(seed)
    return pose_from(
        so3_exp(torch.randn(n, 3, generator=g, dtype=torch.float64)),
        torch.randn(n, 3, generator=g, dtype=torch.float64),
    )


def some_similarity() -> Similarity:
    R = so3_exp(torch.tensor([0.3, -1.2, 0.7], dtype=torch.float64))
    t = torch.tensor([4.0, -2.0, 11.0], dtype=torch.float64)
    return Similarity(torch.tensor(2.7, dtype=torch.float64), R, t)


def test_quarter_turn_about_z_takes_x_to_y():
    q = torch.tensor([math.sqrt(0.5), 0, 0, math.sqrt(0.5)], dtype=torch.float64)
    x_axis = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    expected = torch.tensor([0.0, 1, 0], dtype=torch.float64)
    torch.testing.assert_close(rotation_from_quaternion(q) @ x_axis, expected)
    torch.testing.assert_close(so3_exp(torch.tensor([0, 0, math.pi / 2], dtype=torch.float64)) @ x_axis, expected)


def test_quaternions_and_matrices_are_inverse_in_every_branch():
    q = torch.nn.functional.normalize(torch.randn(2000, 4, generator=rng(), dtype=torch.float64), dim=-1)
    half_turns = torch.cat((torch.zeros(3, 1), torch.eye(3)), -1).double()
    q = torch.cat((q, half_turns, torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64)))
    q = torch.where(q[:, :1] < 0, -q, q)
    R = rotation_from_quaternion(q)
    torch.testing.assert_close(quaternion_from_rotation(R), q)
    torch.testing.assert_close(R @ R.mT, torch.eye(3).double().expand_as(R))
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(len(R)).double())


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-4, 1.0, math.pi - 1e-6])
def test_log_undoes_exp(angle):
    axis = torch.tensor([0.6, -0.0, 0.8], dtype=torch.float64)
    torch.testing.assert_close(so3_log(so3_exp(angle * axis)), angle * axis, rtol=1e-9, atol=1e-14)
    assert rotation_angle(so3_exp(angle * axis)).item() == pytest.approx(angle, rel=1e-7, abs=1e-14)


@pytest.mark.parametrize("scale", [0.0, 1e-5, 1.0])
def test_exp_and_log_have_the_gradients_of_finite_differences(scale):
    omega = (scale * torch.tensor([[0.3, -0.5, 0.9]], dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(so3_exp, omega)
    assert torch.autograd.gradcheck(lambda w: so3_log(so3_exp(w)), omega)


def test_six_numbers_give_the_rotation_whose_columns_they_are():
    R = so3_exp(torch.randn(50, 3, generator=rng(), dtype=torch.float64))
    torch.testing.assert_close(rotation_from_6d(rotation_to_6d(R)), R)
    stretched = torch.cat((3 * R[:, :, 0], R[:, :, 1] + 0.5 * R[:, :, 0]), -1)
    torch.testing.assert_close(rotation_from_6d(stretched), R)


def test_mean_of_two_rotations_is_half_way():
    turn = torch.tensor([0.2, 0.5, -0.3], dtype=torch.float64)
    both = torch.stack((so3_exp(turn), so3_exp(-0.4 * turn)))
    torch.testing.assert_close(mean_rotation(both), so3_exp(0.3 * turn))


def test_skew_is_the_cross_product():
    u, v = torch.randn(2, 7, 3, generator=rng(), dtype=torch.float64)
    torch.testing.assert_close((skew(v) @ u[..., None]).squeeze(-1), torch.linalg.cross(v, u))


def test_relative_pose_is_the_other_camera_seen_from_this_one():
    i, j = some_poses(2)
    relative = relative_poses(i, j)
    torch.testing.assert_close(i @ relative, j)
    torch.testing.assert_close(invert_poses(i) @ i, torch.eye(4).double())
    torch.testing.assert_close(relative[:3, 3], i[:3, :3].mT @ (j[:3, 3] - i[:3, 3]))


def test_alignment_recovers_the_similarity_that_was_applied():
    truth, poses = some_similarity(), some_poses(20)
    moved = truth.poses(poses)
    for found in (align_similarity(poses[:, :3, 3], moved[:, :3, 3]), align_poses(poses, moved)):
        torch.testing.assert_close(found.scale, truth.scale)
        torch.testing.assert_close(found.R, truth.R)
        torch.testing.assert_close(found.t, truth.t)


def test_alignment_never_mirrors():
    points = torch.randn(10, 3, generator=rng(), dtype=torch.float64)
    found = align_similarity(points, points * torch.tensor([1.0, 1.0, -1.0]))
    assert torch.linalg.det(found.R).item() == pytest.approx(1)


def test_alignment_is_the_least_squares_optimum():
    g = rng(3)
    source = torch.randn(15, 3, generator=g, dtype=torch.float64)
    target = some_similarity().points(source) + 0.3 * torch.randn(15, 3, generator=g, dtype=torch.float64)
    best = align_similarity(source, target)

    def cost(scale, turn, shift):
        moved = Similarity(best.scale * scale.exp(), so3_exp(turn) @ best.R, best.t + shift)
        return ((moved.points(source) - target) ** 2).sum()

    zero = torch.zeros(3, dtype=torch.float64)
    gradients = torch.autograd.functional.jacobian(cost, (torch.zeros((), dtype=torch.float64), zero, zero))
    for gradient in gradients:
        torch.testing.assert_close(gradient, torch.zeros_like(gradient), atol=1e-9, rtol=0)


def test_aligned_poses_stay_rigid_and_carry_their_points():
    similarity, pose = some_similarity(), some_poses(1)[0]
    moved = similarity.poses(pose)
    torch.testing.assert_close(moved[:3, :3] @ moved[:3, :3].mT, torch.eye(3).double())
    in_camera = torch.tensor([0.1, -0.4, 3.0], dtype=torch.float64)
    in_world = pose[:3, :3] @ in_camera + pose[:3, 3]
    seen_again = moved[:3, :3].mT @ (similarity.points(in_world) - moved[:3, 3])
    torch.testing.assert_close(seen_again, similarity.scale * in_camera)


def test_inverse_similarity_leads_back():
    similarity, points = some_similarity(), torch.randn(5, 3, generator=rng(), dtype=torch.float64)
    torch.testing.assert_close(similarity.inverse().points(similarity.points(points)), points)


def test_a_straight_track_is_refused_by_centers_and_aligned_by_orientations():
    truth, poses = some_similarity(), some_poses(8)
    poses[:, :3, 3] = torch.arange(8)[:, None] * torch.tensor([1.0, 2.0, -1.0]) + 5
    moved = truth.poses(poses)
    with pytest.raises(DegenerateAlignmentError, match="line"):
        align_similarity(poses[:, :3, 3], moved[:, :3, 3])
    found = align_poses(poses, moved)
    torch.testing.assert_close(found.poses(poses), moved)


def test_a_track_that_bends_a_little_is_turned_by_its_orientations():
    rng = torch.Generator().manual_seed(0)
    R = so3_exp(0.3 * torch.randn(12, 3, generator=rng, dtype=torch.float64))
    centers = torch.stack([torch.linspace(-3, 3, 12).double(), *0.05 * torch.randn(2, 12, generator=rng).double()], -1)
    theirs = pose_from(R, centers)
    bent = centers + 0.05 * torch.randn(12, 3, generator=rng).double()
    truth = Similarity(torch.tensor(2.0).double(), R[0], torch.tensor([1.0, 2.0, 3.0]).double())
    ours = truth.poses(pose_from(R, bent))
    found = best_similarity(theirs, ours)
    assert found is not None
    assert rotation_angle(found.R @ truth.R.mT) < 1e-6
    by_centers = align_similarity(theirs[:, :3, 3], ours[:, :3, 3])
    assert rotation_angle(by_centers.R @ truth.R.mT).rad2deg() > 3  # the turn about the track is anybody's guess


def test_orientations_that_contradict_the_track_leave_it_to_the_centers():
    centers = torch.randn(6, 3, generator=torch.Generator().manual_seed(1)).double()
    theirs = pose_from(torch.eye(3).double().expand(6, 3, 3), centers)
    about = torch.diag(torch.tensor([-1.0, -1.0, 1.0])).double()
    ours = pose_from(torch.eye(3).double().expand(6, 3, 3), centers @ about.mT)
    ours[:, 2, 3] *= 0  # flat, and turned half round
    theirs[:, 2, 3] *= 0
    found = best_similarity(theirs, ours)
    assert found is not None
    torch.testing.assert_close(found.poses(theirs)[:, :3, 3], ours[:, :3, 3], atol=1e-9, rtol=0)
    still = theirs[:1].expand(6, 4, 4)
    assert best_similarity(still, ours) is None


def test_what_holds_no_scale_is_refused():
    poses = some_poses(4)
    with pytest.raises(DegenerateAlignmentError, match="at least 3"):
        align_similarity(poses[:2, :3, 3], poses[:2, :3, 3])
    with pytest.raises(DegenerateAlignmentError, match="at least 2"):
        align_poses(poses[:1], poses[:1])
    on_one_spot = poses.clone()
    on_one_spot[:, :3, 3] = 1.7
    with pytest.raises(DegenerateAlignmentError, match="one spot"):
        align_poses(on_one_spot, poses)
    backwards = poses.clone()
    backwards[:, :3, 3] *= -1
    with pytest.raises(DegenerateAlignmentError, match="contradict"):
        align_poses(poses, backwards)


def seen_by_two(seed: int = 1) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Two poses and the pixels at which both see the same points."""
    i = pose_from(torch.eye(3).double(), torch.zeros(3).double())
    j = pose_from(so3_exp(torch.tensor([0.05, -0.1, 0.02]).double()), torch.tensor([0.6, 0.1, 0.2]).double())
    points = torch.randn(40, 3, generator=rng(seed), dtype=torch.float64) + torch.tensor([0, 0, 6.0])

    def project(pose):
        x = ((points - pose[:3, 3]) @ pose[:3, :3]) @ K.mT
        return x[:, :2] / x[:, 2:]

    return i, j, project(i), project(j)


def test_true_matches_have_no_epipolar_error():
    i, j, xy_i, xy_j = seen_by_two()
    F = fundamental_from_poses(i, j, K, K)
    assert epipolar_distances(F, xy_i, xy_j).max() < 1e-9
    normalized = [torch.cat((xy, torch.ones(40, 1)), -1) @ torch.linalg.inv(K).mT for xy in (xy_i, xy_j)]
    E = essential_from_poses(i, j)
    torch.testing.assert_close((normalized[1] * (normalized[0] @ E.mT)).sum(-1), torch.zeros(40).double())


def test_a_point_moved_across_its_epipolar_line_is_that_many_pixels_off():
    i, j, xy_i, xy_j = seen_by_two()
    F = fundamental_from_poses(i, j, K, K)
    line = torch.cat((xy_i, torch.ones(40, 1)), -1) @ F.mT
    normal = torch.nn.functional.normalize(line[:, :2], dim=-1)
    distances = epipolar_distances(F, xy_i, xy_j + 3 * normal)
    torch.testing.assert_close(distances[:, 1], torch.full((40,), 3.0).double())


@pytest.mark.parametrize("length", [1e-9, 1.0, 1e6])
def test_epipolar_error_does_not_know_the_scale_of_the_world(length):
    i, j, xy_i, xy_j = seen_by_two()
    xy_j = xy_j + torch.randn(40, 2, generator=rng(5), dtype=torch.float64)
    expected = epipolar_distances(fundamental_from_poses(i, j, K, K), xy_i, xy_j)
    j[:3, 3] *= length
    torch.testing.assert_close(epipolar_distances(fundamental_from_poses(i, j, K, K), xy_i, xy_j), expected)


def test_epipolar_error_is_symmetric_in_the_two_images_and_in_single_precision():
    i, j, xy_i, xy_j = seen_by_two()
    xy_j = xy_j + torch.randn(40, 2, generator=rng(5), dtype=torch.float64)
    F = fundamental_from_poses(i, j, K, K)
    error = symmetric_epipolar_error(F, xy_i, xy_j)
    torch.testing.assert_close(error, symmetric_epipolar_error(F.mT, xy_j, xy_i))
    d = epipolar_distances(F, xy_i, xy_j)
    torch.testing.assert_close(symmetric_epipolar_error(F, xy_i, xy_j, "root_sum_square"), (d**2).sum(-1).sqrt())
    single = symmetric_epipolar_error(F.float(), xy_i.float(), xy_j.float())
    torch.testing.assert_close(single.double(), error, rtol=1e-2, atol=5e-3)


def test_epipolar_error_has_a_gradient_in_the_pose():
    i, j, xy_i, xy_j = seen_by_two()
    xy_j = xy_j + 2.0

    def error(turn):
        moved = pose_from(j[:3, :3] @ so3_exp(turn), j[:3, 3])
        return symmetric_epipolar_error(fundamental_from_poses(i, moved, K, K), xy_i[:4], xy_j[:4])

    assert torch.autograd.gradcheck(error, torch.zeros(3, dtype=torch.float64, requires_grad=True))
