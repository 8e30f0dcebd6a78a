"""Rows of primitives keep their memory where they stay, and start anew where they come or are copied."""

import torch

from swimm3r.splat.densify.rows import appended, in_place, moments_after, only, unchanged
from swimm3r.splat.optimizer import Moments
from swimm3r.splat.primitives.beta import trained
from swimm3r.splat.primitives.gaussian import GaussianPrimitives


def gaussians(n: int) -> GaussianPrimitives:
    """Primitives whose numbers are those of their rows."""
    row = torch.arange(n).float()
    columns = {"xyz": 3, "scale": 3, "quaternion": 4, "color": 3}
    shaped = {name: row[:, None].repeat(1, width) for name, width in columns.items()}
    harmonics = row[:, None, None].repeat(1, 15, 3)
    return GaussianPrimitives(**shaped, opacity=row.clone(), harmonics=harmonics, footprint=row.clone())


def memory(p: GaussianPrimitives) -> dict[str, Moments]:
    """Moments that say which row they belong to, and one of the water's."""
    of_rows = {name: Moments(1 + values, 101 + values, torch.tensor(7.0)) for name, values in trained(p).items()}
    return {**of_rows, "field.weight": Moments(torch.ones(2), torch.ones(2), torch.tensor(7.0))}


def test_a_round_without_changes_leaves_memory_alone():
    p = gaussians(5)
    after = moments_after(memory(p), unchanged(p))
    assert all(torch.equal(after[k].first, m.first) for k, m in memory(p).items())


def test_rows_in_place_keep_the_memory_of_their_place_and_new_ones_have_none():
    p = gaussians(6)
    source = torch.tensor([3, 1, 2, 3, 4, 4])  # 0 takes the values of 3; 5 is new, of 4
    done = in_place(p, source, 5, torch.tensor([3, 4, 5]), relocated=1)
    assert done.numbers == {"relocated": 1.0, "added": 1.0}
    assert done.changed.tolist() == [0, 3, 4, 5]
    after = moments_after(memory(gaussians(5)), done)
    assert after["opacity"].first.tolist() == [1, 2, 3, 0, 0, 0]
    assert after["xyz"].second[:, 0].tolist() == [101, 102, 103, 0, 0, 0]
    assert after["opacity"].steps == 7
    assert after["field.weight"].first.tolist() == [1, 1]


def test_what_is_appended_changes_nothing_before_it():
    done = appended(gaussians(3), gaussians(2))
    assert done.primitives.opacity.tolist() == [0, 1, 2, 0, 1]
    assert done.added == 2
    after = moments_after(memory(gaussians(3)), done)
    assert after["opacity"].first.tolist() == [1, 2, 3, 0, 0]


def test_rows_that_leave_take_their_memory_with_them():
    done = appended(gaussians(3), gaussians(2))
    kept = torch.tensor([False, True, True, False, True])
    left = only(done, kept)
    assert left.primitives.opacity.tolist() == [1, 2, 1]
    assert left.restarted.tolist() == [2]
    assert moments_after(memory(gaussians(3)), left)["opacity"].first.tolist() == [2, 3, 0]
