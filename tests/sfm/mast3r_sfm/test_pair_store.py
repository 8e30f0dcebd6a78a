"""Streaming through running sums on disk gives what holding every pointmap in memory gives."""

from pathlib import Path

import pytest
import torch

from swimm3r.cameras import Cameras, image_directions
from swimm3r.geometry import so3_exp
from swimm3r.sfm.alignment.canonical import CanonicalView, anchored_frame, anchors_of, spread_anchors
from swimm3r.sfm.alignment.optimize import align
from swimm3r.sfm.alignment.problem import AnchoredPair, Predicted
from swimm3r.sfm.mast3r.matching import PixelMatches
from swimm3r.sfm.mast3r.settings import AlignmentSettings
from swimm3r.sfm.mast3r_sfm.pair_store import FrameStore, PairRecord, PairStore

HEIGHT, WIDTH, FOCAL, N = 64, 96, 88.0, 4
NAMES = [f"frame {i}" for i in range(N)]
PAIRS = [(i, j) for i in range(N) for j in range(i + 1, N)]
PARTNERS = [{j for j in range(N) if j != i} for i in range(N)]


def scene() -> tuple[Cameras, torch.Tensor]:
    """Cameras inside a room, a sphere of radius 5 around the origin, and their z depths."""
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64).repeat(N, 1, 1)
    pose = torch.eye(4, dtype=torch.float64).repeat(N, 1, 1)
    for i in range(N):
        pose[i, :3, :3] = so3_exp(torch.tensor([0.05 * i, -0.12 * i, 0.03 * i], dtype=torch.float64))
        pose[i, :3, 3] = torch.tensor([0.5 * i, 0.1 * i * i, -1 + 0.2 * i], dtype=torch.float64)
    cameras = Cameras(K, torch.zeros(N, 0), pose, WIDTH, HEIGHT)
    depths = []
    for i in range(N):
        rays = image_directions(cameras[i]).double() @ pose[i, :3, :3].T
        a, b, c = (rays * rays).sum(-1), rays @ pose[i, :3, 3], pose[i, :3, 3] @ pose[i, :3, 3] - 25
        depths.append((-b + (b * b - a * c).sqrt()) / a)
    return cameras, torch.stack(depths)


@pytest.fixture(scope="module")
def passes() -> dict[tuple[int, int], tuple[torch.Tensor, torch.Tensor]]:
    """(frame, partner): a pointmap with 2 % noise and its confidence."""
    cameras, z_depth = scene()
    generator = torch.Generator().manual_seed(0)
    said = {}
    for i, others in enumerate(PARTNERS):
        for j in sorted(others):
            points = image_directions(cameras[i]).double() * z_depth[i, ..., None]
            points = points * (1 + 0.02 * torch.randn(points.shape, generator=generator))
            said[i, j] = points.float(), 1 + 9 * torch.rand(HEIGHT, WIDTH, generator=generator)
    return said


def in_memory(stacked: torch.Tensor, confidence: torch.Tensor) -> CanonicalView:
    """The canonical view by its formula over all passes at once (MASt3R-SfM, sec. 3.1 of the specification)."""
    points, w = stacked.double(), confidence.double() - 0.999
    mean = (w[..., None] * points).sum(0) / w.sum(0)[..., None]
    anchor = torch.stack([spread_anchors(p, 8) for p in points])
    rho = (points - anchor)[..., :2].norm(dim=-1).clamp(min=1e-8)
    theta = torch.atan((points[..., 2] - anchor[..., 2]) / rho)
    slope = torch.tan((w * theta).sum(0) / w.sum(0))
    relative = 1 + rho.mean(0) * slope / spread_anchors(mean, 8)[..., 2]
    return CanonicalView(mean.float(), relative.float(), ((w * w).sum(0) / w.sum(0)).float())


def stream(folder: Path, passes: dict, max_bytes: int, pairs: list[tuple[int, int]]) -> FrameStore:
    store = FrameStore(folder, NAMES, PARTNERS, max_bytes)
    for i, j in pairs:
        store.add(i, j, *passes[i, j])
        store.add(j, i, *passes[j, i])
    store.flush()
    return store


@pytest.fixture(scope="module")
def views(passes: dict) -> list[CanonicalView]:
    return [in_memory(*(torch.stack(p) for p in zip(*(passes[i, j] for j in sorted(PARTNERS[i])), strict=True)))
            for i in range(N)]  # fmt: skip


@pytest.mark.parametrize("max_bytes", [1, 1 << 30])
def test_streamed_views_are_the_ones_of_everything_in_memory(
    passes: dict, views: list[CanonicalView], max_bytes: int, tmp_path: Path
):
    store = stream(tmp_path, passes, max_bytes, PAIRS)
    for i, view in enumerate(views):
        record = store.read(i)
        torch.testing.assert_close(record.view.relative_depth, view.relative_depth, atol=1e-6, rtol=0)
        torch.testing.assert_close(record.view.confidence, view.confidence, atol=1e-6, rtol=1e-6)
        frame = anchored_frame(view)
        torch.testing.assert_close(record.anchored.anchor_depth, frame.anchor_depth, atol=1e-6, rtol=0)
        assert record.anchored.focal == pytest.approx(frame.focal, rel=1e-6)
        assert record.anchored.confidence == pytest.approx(frame.confidence, rel=1e-6)
    assert not list(tmp_path.glob("*.sums.safetensors"))


@pytest.mark.parametrize(("iterations", "tolerance"), [(3, 1e-4), (300, 1e-3)])
def test_poses_from_streamed_views_are_those_from_memory(
    passes: dict, views: list[CanonicalView], iterations: int, tolerance: float, tmp_path: Path
):
    store = stream(tmp_path, passes, 1, PAIRS)
    records = [store.read(i) for i in range(N)]
    settings = AlignmentSettings(coarse_iterations=iterations, fine_iterations=iterations)
    found = []
    for all_views, frames in (
        (views, [anchored_frame(view) for view in views]),
        ([r.view for r in records], [r.anchored for r in records]),
    ):
        poses = align(frames, [exact_pair(all_views, *pair) for pair in PAIRS], settings).cam2world
        found.append(torch.linalg.inv(poses[0]) @ poses)
    torch.testing.assert_close(found[1], found[0], atol=tolerance, rtol=0)


def exact_pair(views: list[CanonicalView], i: int, j: int) -> AnchoredPair:
    cameras, z_depth = scene()
    y, x = torch.meshgrid(torch.arange(2, HEIGHT, 5), torch.arange(2, WIDTH, 5), indexing="ij")
    xy_i = torch.stack([x, y], -1).reshape(-1, 2)
    rays = image_directions(cameras[i]).double()[xy_i[:, 1], xy_i[:, 0]]
    world = (rays * z_depth[i][xy_i[:, 1], xy_i[:, 0], None]) @ cameras.cam2world[i, :3, :3].T + cameras.centers[i]
    seen = (world - cameras.centers[j]) @ cameras.cam2world[j, :3, :3]
    xy_j = (seen[:, :2] / seen[:, 2:] * FOCAL + torch.tensor([WIDTH / 2, HEIGHT / 2])).floor().long()
    inside = ((xy_j >= 0) & (xy_j < torch.tensor([WIDTH, HEIGHT]))).all(1)
    xy_i, xy_j = xy_i[inside], xy_j[inside]
    anchors = [anchors_of(view, xy) for view, xy in ((views[i], xy_i), (views[j], xy_j))]
    confidence = torch.full((len(xy_i),), 5.0)
    return AnchoredPair(i, j, xy_i, xy_j, anchors[0][0], anchors[1][0], anchors[0][1], anchors[1][1], confidence)


def test_a_store_opened_again_adds_nothing_twice_and_leaves_nothing_out(
    passes: dict, views: list[CanonicalView], tmp_path: Path
):
    first = stream(tmp_path, passes, 1 << 30, PAIRS[:3])
    first.add(1, 2, *passes[1, 2])  # and killed before it was written
    again = FrameStore(tmp_path, NAMES, PARTNERS, 1 << 30)
    assert again.has(1, 0)
    assert not again.has(1, 2)
    store = stream(tmp_path, passes, 1 << 30, PAIRS)
    for i, view in enumerate(views):
        torch.testing.assert_close(store.read(i).view.relative_depth, view.relative_depth, atol=1e-6, rtol=0)


def test_looking_for_the_frames_that_are_done_keeps_to_the_memory_that_is_allowed(
    passes: dict, views: list[CanonicalView], tmp_path: Path
):
    stream(tmp_path, passes, 1 << 30, PAIRS[:3])
    one = 7 * 8 * HEIGHT * WIDTH
    again = FrameStore(tmp_path, NAMES, PARTNERS, one)
    done = {(i, j) for i in range(N) for j in PARTNERS[i] if again.has(i, j)}
    assert done == {(i, j) for i, j in ((0, 1), (0, 2), (0, 3), (1, 0), (2, 0), (3, 0))}
    assert len(again._held) == 1
    for i in range(1, N):
        for j in sorted(PARTNERS[i] - {0}):
            again.add(i, j, *passes[i, j])
    for i, view in enumerate(views):
        torch.testing.assert_close(again.read(i).view.relative_depth, view.relative_depth, atol=1e-6, rtol=0)


def test_other_partners_are_another_view(passes: dict, tmp_path: Path):
    stream(tmp_path, passes, 1 << 30, PAIRS)
    fewer = FrameStore(tmp_path, NAMES, [{1}, {0}, set(), set()], 1 << 30)
    assert not fewer.has(0, 1)
    renamed = FrameStore(tmp_path, ["another image", *NAMES[1:]], PARTNERS, 1 << 30)
    assert not renamed.has(0, 1)
    assert not renamed.has(1, 0)


def test_a_pair_comes_back_as_it_was_kept(tmp_path: Path):
    matches = PixelMatches(torch.tensor([[3, 500], [7, 9]]), torch.tensor([[0, 1], [511, 2]]), torch.tensor([0.5, 9.0]))
    weak, back = (Predicted(torch.rand(6, 3), torch.rand(6)) for _ in range(2))
    store = PairStore(tmp_path, "settings")
    store.write("a", "b", PairRecord(matches))
    store.write("a", "c", PairRecord(matches, weak, back))
    plain, full = store.read("a", "b"), store.read("a", "c")
    assert torch.equal(plain.matches.xy2, matches.xy2)
    assert torch.equal(plain.matches.confidence, matches.confidence)
    assert plain.i_in_j is None
    assert torch.equal(full.j_in_i.points, back.points)
    assert torch.equal(full.i_in_j.confidence, weak.confidence)
    assert not store.has("b", "c")
    assert not PairStore(tmp_path, "other settings").has("a", "b")
