"""Sparse global alignment on a scene with known cameras: spheres seen from inside, pointmaps exact or noisy."""

from dataclasses import dataclass, replace

import pytest
import torch

from swimm3r.cameras import Cameras, image_directions, project
from swimm3r.errors import RegistrationError, UsageError, WeightsError
from swimm3r.geometry import align_similarity, rotation_angle, so3_exp
from swimm3r.sfm.alignment import canonical, optimize
from swimm3r.sfm.alignment.canonical import AnchoredFrame
from swimm3r.sfm.alignment.optimize import align
from swimm3r.sfm.alignment.problem import AlignmentProblem, AnchoredPair, Known, Predicted, anchored_pair
from swimm3r.sfm.mast3r.matching import PixelMatches
from swimm3r.sfm.mast3r.settings import AlignmentSettings

HEIGHT, WIDTH, FOCAL = 96, 128, 120.0
SPHERES = [((0.0, 0.0, 0.0), 5.0), ((0.4, 0.1, 4.0), 1.0), ((-1.6, 0.5, 4.2), 0.8)]  # a room and two rocks
QUICK = AlignmentSettings(coarse_iterations=100, fine_iterations=100)


@dataclass(frozen=True)
class Scene:
    cameras: Cameras
    z_depth: torch.Tensor  # n h w
    frames: list[AnchoredFrame]
    pairs: list[AnchoredPair]
    views: list[canonical.CanonicalView]


def truth(n: int) -> Cameras:
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64).repeat(n, 1, 1)
    cam2world = torch.eye(4, dtype=torch.float64).repeat(n, 1, 1)
    for i in range(n):
        u = i / max(n - 1, 1) - 0.5
        cam2world[i, :3, :3] = so3_exp(torch.tensor([0.15 * u, -0.5 * u, 0.2 * u], dtype=torch.float64))
        cam2world[i, :3, 3] = torch.tensor([1.8 * u, 0.5 * u * u, 0.3 * u], dtype=torch.float64)
    return Cameras(K, torch.zeros(n, 0), cam2world, WIDTH, HEIGHT)


def rays_of(camera: Cameras) -> torch.Tensor:
    return image_directions(camera).double()


def surface(cameras: Cameras) -> torch.Tensor:
    """z depth of every pixel, n h w: the nearest crossing of each ray with a sphere ahead."""
    out = []
    for i in range(len(cameras)):
        rays = rays_of(cameras[i]) @ cameras.cam2world[i, :3, :3].T
        best = torch.full(rays.shape[:2], torch.inf, dtype=torch.float64)
        for middle, radius in SPHERES:
            o = cameras.centers[i] - torch.tensor(middle, dtype=torch.float64)
            a, b, c = (rays * rays).sum(-1), (rays @ o), o @ o - radius**2
            root = (b * b - a * c).clamp(min=0).sqrt()
            for t in ((-b - root) / a, (-b + root) / a):
                best = torch.where((b * b > a * c) & (t > 0) & (t < best), t, best)
        out.append(best)
    return torch.stack(out)


def make_scene(n: int = 4, noise: float = 0.0, scales: torch.Tensor | None = None, center: float = 0.5) -> Scene:
    """Predictions of a perfect (or noisy) network for n frames; `scales` are its errors of scale per frame."""
    generator = torch.Generator().manual_seed(0)
    cameras = truth(n)
    z = surface(cameras)
    sums: list[canonical.CanonicalSums | None] = [None] * n
    scales = torch.ones(n) if scales is None else scales
    graph = [(i, j) for i in range(n) for j in range(i + 1, n) if j - i <= 2]
    for i, j in graph:
        for f in (i, j):
            points = rays_of(cameras[f]) * z[f, ..., None] * scales[f]
            points = points * (1 + noise * torch.randn(*points.shape, generator=generator))
            sums[f] = canonical.add_pass(sums[f], points, torch.full((HEIGHT, WIDTH), 5.0))
    views = [canonical.canonical_view(s) for s in sums if s is not None]
    frames = [canonical.anchored_frame(v, pixel_center=center) for v in views]
    pairs = [match(cameras, z, views, i, j) for i, j in graph]
    return Scene(cameras, z, frames, pairs, views)


def match(cameras: Cameras, z: torch.Tensor, views: list, i: int, j: int) -> AnchoredPair:
    """Pixels of a grid over frame i that frame j sees too, at its nearest whole pixel there."""
    y, x = torch.meshgrid(torch.arange(1, HEIGHT, HEIGHT // 32), torch.arange(1, WIDTH, WIDTH // 42), indexing="ij")
    xy_i = torch.stack([x, y], dim=-1).reshape(-1, 2)
    seen = rays_of(cameras[i])[xy_i[:, 1], xy_i[:, 0]] * z[i, xy_i[:, 1], xy_i[:, 0], None]
    world = seen @ cameras.cam2world[i, :3, :3].T + cameras.centers[i]
    uv, depth = project(cameras[j], world[None])
    xy_j = uv[0].floor().long()
    inside = (xy_j >= 0).all(1) & (xy_j[:, 0] < WIDTH) & (xy_j[:, 1] < HEIGHT)
    xy_i, xy_j, depth = xy_i[inside], xy_j[inside], depth[0, inside]
    open_ = (z[j, xy_j[:, 1], xy_j[:, 0]] / depth - 1).abs() < 0.02
    xy_i, xy_j = xy_i[open_], xy_j[open_]
    matches = PixelMatches(xy_i, xy_j, torch.full((len(xy_i),), 5.0))
    return anchored_pair((i, j), matches, (views[i], views[j]))


def errors(found: optimize.Alignment, cameras: Cameras) -> tuple[float, float]:
    """Largest relative rotation error, degrees, and largest error of a center after a similarity, scene units."""
    R, S = found.cam2world[:, :3, :3], cameras.cam2world[:, :3, :3]
    rotation = rotation_angle((R[0].T @ R).mT @ (S[0].T @ S)).max()
    fit = align_similarity(found.cam2world[:, :3, 3], cameras.centers)
    moved = fit.points(found.cam2world[:, :3, 3])
    return float(rotation.rad2deg()), float((moved - cameras.centers).norm(dim=1).max())


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene()


@pytest.fixture(scope="module")
def aligned(scene: Scene) -> optimize.Alignment:
    return align(scene.frames, scene.pairs, QUICK)


def test_cameras_of_an_exact_scene_are_found(scene: Scene, aligned: optimize.Alignment):
    rotation, center = errors(aligned, scene.cameras)
    assert rotation < 0.3
    assert center < 0.02
    torch.testing.assert_close(aligned.K[:, 0, 0], scene.cameras.K[:, 0, 0], rtol=0.02, atol=0)
    torch.testing.assert_close(aligned.K[:, :2, 2], scene.cameras.K[:, :2, 2], rtol=0, atol=1e-4)


def test_noise_of_one_percent_costs_less_than_a_degree():
    noisy = make_scene(noise=0.01)
    found = align(noisy.frames, noisy.pairs, QUICK)
    assert errors(found, noisy.cameras)[0] < 1.0
    torch.testing.assert_close(found.K[:, 0, 0], noisy.cameras.K[:, 0, 0], rtol=0.03, atol=0)


def test_frames_of_different_scale_are_brought_together():
    wrong = make_scene(scales=torch.tensor([1.0, 1.3, 0.8, 1.1]))
    found = align(wrong.frames, wrong.pairs, QUICK)
    rotation, center = errors(found, wrong.cameras)
    assert rotation < 0.5
    assert center < 0.04


def test_dense_depth_is_the_scene(scene: Scene, aligned: optimize.Alignment):
    fit = align_similarity(aligned.cam2world[:, :3, 3], scene.cameras.centers)
    for i, view in enumerate(scene.views):
        z = optimize.dense_z_depth(
            aligned.anchor_z_depth[i], view.relative_depth, float(aligned.focal_before[i]), float(aligned.K[i, 0, 0])
        )
        ratio = fit.scale * z / scene.z_depth[i]
        assert (ratio - 1).abs().median() < 0.02


def test_points_of_matches_lie_on_the_scene(scene: Scene, aligned: optimize.Alignment):
    assert len(aligned.points) == sum(len(p.confidence) for p in scene.pairs)
    fit = align_similarity(aligned.cam2world[:, :3, 3], scene.cameras.centers)
    points = fit.points(aligned.points.double())
    distance = torch.stack([((points - torch.tensor(m)).norm(dim=1) - r).abs() for m, r in SPHERES]).amin(0)
    assert distance.median() < 0.15  # 3 % of the room's radius


def test_root_stays_and_nothing_drifts(scene: Scene, aligned: optimize.Alignment):
    longer = align(scene.frames, scene.pairs, replace(QUICK, fine_iterations=150))
    moved = (longer.cam2world - aligned.cam2world).abs().max()
    assert moved < 0.02


def test_known_intrinsics_are_not_moved(scene: Scene):
    K = scene.cameras.K.clone()
    K[:, 1, 1] *= 1.01
    found = align(scene.frames, scene.pairs, replace(QUICK, intrinsics="fixed"), Known(K=K))
    torch.testing.assert_close(found.K, K, atol=1e-3, rtol=0)
    assert errors(found, scene.cameras)[0] < 0.5


def test_prior_keeps_intrinsics_near_and_its_weight_says_how_near(scene: Scene):
    K = scene.cameras.K.clone()
    K[:, :2, :2] *= 1.1
    away = []
    for weight in (0.1, 1e6):
        settings = replace(QUICK, intrinsics="prior", prior_weight=weight)
        found = align(scene.frames, scene.pairs, settings, Known(K=K))
        away.append(float((found.K[:, 0, 0] / K[:, 0, 0] - 1).abs().max()))
    assert away[1] < 0.002 < 0.02 < away[0]


def test_shared_intrinsics_are_one(scene: Scene):
    found = align(scene.frames, scene.pairs, replace(QUICK, intrinsics="shared"))
    assert (found.K[:1] == found.K).all()
    torch.testing.assert_close(found.K[0, 0, 0].item(), FOCAL, rtol=0.02, atol=0)


def test_shared_intrinsics_leave_every_frame_its_own_first_focal_length(scene: Scene):
    """Depth relative to a block's anchor was measured under the pointmap's own focal length, whatever is shared."""
    own = torch.tensor([0.9, 1.0, 1.1, 1.2]) * FOCAL
    frames = [replace(f, focal=float(focal)) for f, focal in zip(scene.frames, own, strict=True)]
    shared = replace(QUICK, intrinsics="shared", coarse_iterations=0, fine_iterations=0)
    found = align(frames, scene.pairs, shared)
    torch.testing.assert_close(found.focal_before, own)
    torch.testing.assert_close(found.K[:, 0, 0].float(), torch.full((4,), 1.05 * FOCAL))
    # the focal plane keeps the size that the frame had under its own focal length: z = s m f / f0
    for frame, depth, focal in zip(frames, found.anchor_z_depth, own, strict=True):
        median = frame.anchor_depth.median()
        torch.testing.assert_close(depth, frame.anchor_depth + median * (1.05 * FOCAL / focal - 1))


def test_known_poses_are_kept_and_the_others_found(scene: Scene):
    posed = torch.tensor([True, False, True, True])
    known = Known(cam2world=scene.cameras.cam2world, posed=posed)
    found = align(scene.frames, scene.pairs, QUICK, known)
    torch.testing.assert_close(found.cam2world[posed], scene.cameras.cam2world[posed], atol=1e-6, rtol=0)
    assert (found.cam2world[1, :3, 3] - scene.cameras.centers[1]).norm() < 0.03  # in the known poses' own unit
    assert rotation_angle(found.cam2world[1, :3, :3].T @ scene.cameras.cam2world[1, :3, :3]).rad2deg() < 0.5


def test_known_poses_are_the_start_of_the_chain(scene: Scene):
    none = replace(QUICK, coarse_iterations=0, fine_iterations=0, intrinsics="fixed")
    known = Known(K=scene.cameras.K, cam2world=scene.cameras.cam2world)
    problem = AlignmentProblem.of(scene.frames, scene.pairs, none, known)
    start = optimize._Parameters.initial(problem, none, known)
    free = replace(problem, known_pose=None, posed=torch.zeros(4, dtype=torch.bool))
    chained = optimize._scene(start, free, none)
    torch.testing.assert_close(chained.R.double(), scene.cameras.cam2world[:, :3, :3], atol=1e-5, rtol=0)
    torch.testing.assert_close(chained.center.double(), scene.cameras.centers, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    "change",
    [
        {"optimize_principal_point": True},
        {"depth": "multiply"},
        {"exponential_depth": True},
        {"optimize_depth": False},
        {"tree": "spanning"},
        {"parity": True},
    ],
    ids=lambda c: next(iter(c)),
)
def test_every_variant_finds_the_cameras(change: dict):
    scene = make_scene(center=0.0 if "parity" in change else 0.5)
    found = align(scene.frames, scene.pairs, replace(QUICK, coarse_iterations=60, fine_iterations=60, **change))
    assert errors(found, scene.cameras)[0] < 0.8


def test_order_and_direction_of_the_pairs_do_not_matter(scene: Scene):
    short = replace(QUICK, coarse_iterations=10, fine_iterations=10)
    turned = [
        AnchoredPair(p.j, p.i, p.xy_j, p.xy_i, p.anchor_j, p.anchor_i, p.relative_j, p.relative_i, p.confidence)
        for p in scene.pairs[::-1]
    ]
    first, second = align(scene.frames, scene.pairs, short), align(scene.frames, turned, short)
    torch.testing.assert_close(second.cam2world, first.cam2world, atol=1e-4, rtol=0)
    torch.testing.assert_close(second.losses[1], first.losses[1], atol=1e-4, rtol=0)


def test_pair_without_confident_matches_is_held_by_its_pointmaps(scene: Scene):
    weak = []
    for p in scene.pairs:
        if 3 in (p.i, p.j):
            anchors = []
            for f, other in ((p.i, p.j), (p.j, p.i)):
                rays = rays_of(scene.cameras[f])[4::8, 4::8].reshape(-1, 3)
                world = rays * scene.z_depth[f, 4::8, 4::8].reshape(-1, 1)
                world = world @ scene.cameras.cam2world[f, :3, :3].T + scene.cameras.centers[f]
                local = (world - scene.cameras.centers[other]) @ scene.cameras.cam2world[other, :3, :3]
                anchors.append(Predicted(local.float(), torch.full((len(local),), 5.0)))
            p = replace(p, confidence=torch.full_like(p.confidence, 1.0), i_in_j=anchors[0], j_in_i=anchors[1])
        weak.append(p)
    settings = replace(QUICK, confidence_threshold=2.0)
    found = align(scene.frames, weak, settings)
    assert errors(found, scene.cameras)[0] < 2.0
    bare = [replace(p, i_in_j=None, j_in_i=None) for p in weak]
    with pytest.raises(ValueError, match="no confident match and no predicted anchors"):
        align(scene.frames, bare, settings)


def test_no_match_at_all_is_a_registration_error(scene: Scene):
    empty = torch.zeros(0, dtype=torch.int64)
    none = torch.zeros(0, 2, dtype=torch.int64)
    pair = AnchoredPair(0, 1, none, none, empty, empty, torch.zeros(0), torch.zeros(0), torch.zeros(0))
    for pairs in ([], [pair]):
        with pytest.raises(RegistrationError, match="not one pixel of the 4 frames matches") as caught:
            align(scene.frames, pairs)
        assert caught.value.exit_code == 6


def test_groups_that_nothing_joins_are_a_registration_error(scene: Scene):
    split = [p for p in scene.pairs if (p.i, p.j) in ((0, 1), (2, 3))]
    with pytest.raises(RegistrationError, match="2 groups without a match between them, of 2, 2 frames"):
        align(scene.frames, split)


def test_unknown_intrinsics_cannot_be_fixed(scene: Scene):
    with pytest.raises(UsageError, match="none are known"):
        align(scene.frames, scene.pairs, replace(QUICK, intrinsics="fixed"))


def test_progress_stops_the_alignment(scene: Scene):
    calls = []

    def stop(what: str, done: int, total: int) -> None:
        calls.append((what, done, total))
        if len(calls) == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        align(scene.frames, scene.pairs, QUICK, progress=stop)
    assert calls[-1] == ("coarse alignment", 4, 100)


def test_streamed_canonical_view_is_the_average_over_all_passes():
    generator = torch.Generator().manual_seed(1)
    cameras = truth(1)
    exact = rays_of(cameras[0]) * surface(cameras)[0, ..., None]
    passes = exact * (1 + 0.02 * torch.randn(5, *exact.shape, generator=generator))
    confidence = 1 + torch.rand(5, HEIGHT, WIDTH, generator=generator).double() * 9
    sums = None
    for X, C in zip(passes, confidence, strict=True):
        sums = canonical.add_pass(sums, X, C)
    assert sums is not None
    view = canonical.canonical_view(sums)
    w = confidence - 0.999
    mean = (w[..., None] * passes).sum(0) / w.sum(0)[..., None]
    torch.testing.assert_close(view.points.double(), mean, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(view.confidence.double(), (w**2).sum(0) / w.sum(0), atol=1e-6, rtol=1e-6)
    y, x = 13, 70
    anchor = passes[:, 12, 68]
    rho = (passes[:, y, x] - anchor)[:, :2].norm(dim=1)
    theta = torch.atan((passes[:, y, x, 2] - anchor[:, 2]) / rho)
    slope = torch.tan((w[:, y, x] * theta).sum() / w[:, y, x].sum())
    expected = 1 + rho.mean() * slope / mean[12, 68, 2]
    assert view.relative_depth[y, x] == pytest.approx(float(expected), abs=1e-6)
    assert view.relative_depth[12, 68] == 1.0


def test_exact_pointmap_implies_its_focal_length():
    points = rays_of(truth(1)) * surface(truth(1))[0, ..., None]
    assert canonical.implied_focal(points) == pytest.approx(FOCAL, rel=1e-5)


def test_pointmap_that_is_not_finite_is_refused():
    points = torch.ones(16, 16, 3)
    points[3, 4, 2] = torch.nan
    with pytest.raises(WeightsError, match=r"not finite at 1 of 256 pixels") as caught:
        canonical.add_pass(None, points, torch.ones(16, 16) * 2)
    assert caught.value.exit_code == 4


def test_point_behind_the_camera_leaves_finite_numbers():
    points = torch.randn(16, 16, 3, generator=torch.Generator().manual_seed(0))
    view = canonical.canonical_view(canonical.add_pass(None, points, torch.full((16, 16), 2.0)))
    assert view.relative_depth.isfinite().all()
    assert (view.relative_depth > 0).all()
    assert (canonical.anchored_frame(view).anchor_depth > 0).all()
