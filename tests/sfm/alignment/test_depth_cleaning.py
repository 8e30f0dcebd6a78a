"""Floaters of aligned depth maps: seen through by surer neighbors, and only by those that are asked."""

import torch

from swimm3r.cameras import Cameras
from swimm3r.sfm.alignment.depth_cleaning import clean_confidence, confidence_share

H, W = 8, 12


def setting() -> tuple[Cameras, list[torch.Tensor], list[torch.Tensor]]:
    """Two cameras at one place before a wall 4 away; the first believes, weakly, in something at 2 in its middle."""
    K = torch.tensor([[10.0, 0, 6], [0, 10, 4], [0, 0, 1]], dtype=torch.float64).repeat(2, 1, 1)
    cameras = Cameras(K, torch.zeros(2, 0), torch.eye(4, dtype=torch.float64).repeat(2, 1, 1), W, H)
    depth = [torch.full((H, W), 4.0) for _ in range(2)]
    confidence = [torch.full((H, W), 5.0) for _ in range(2)]
    depth[0][3:5, 5:7] = 2.0
    confidence[0][3:5, 5:7] = 2.0
    return cameras, depth, confidence


def test_a_weak_point_before_a_surer_surface_is_a_floater():
    cameras, depth, confidence = setting()
    cleaned = clean_confidence(0, [1], cameras, lambda i: (depth[i], confidence[i]))
    assert (cleaned[3:5, 5:7] == 0).all()
    assert (cleaned == 5).sum() == H * W - 4


def test_a_surer_point_stays_and_so_does_one_nobody_else_sees():
    cameras, depth, confidence = setting()
    confidence[0][3:5, 5:7] = 9.0
    assert (clean_confidence(0, [1], cameras, lambda i: (depth[i], confidence[i])) > 0).all()
    confidence[0][3:5, 5:7] = 2.0
    assert (clean_confidence(0, [], cameras, lambda i: (depth[i], confidence[i])) > 0).all()
    cameras.cam2world[1, 0, 3] = 100.0
    assert (clean_confidence(0, [1], cameras, lambda i: (depth[i], confidence[i])) > 0).all()


def test_confidence_becomes_a_share():
    shares = confidence_share(torch.tensor([[1.0, 2.0, 10.0, torch.inf]]))
    torch.testing.assert_close(shares, torch.tensor([[0.0, 0.5, 0.9, 1.0]]))
