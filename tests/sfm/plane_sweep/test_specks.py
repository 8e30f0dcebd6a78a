"""Small patches of depth: which stay, which go."""

import numpy as np
import pytest

from swimm3r.sfm.plane_sweep.specks import without_specks

AREA = 20
GROUND = 0.5  # inverse depth
BLOB = (slice(40, 46), slice(60, 68))  # 48 pixels, of 20 to 160


def ground() -> np.ndarray:
    """A tilted floor that ends at column 55, with nothing known beyond."""
    q = np.full((72, 96), GROUND, np.float32) * np.linspace(0.95, 1.05, 72, dtype=np.float32)[:, None]
    q[:, 55:] = 0
    return q


def is_kept(q: np.ndarray, *, certain: bool) -> bool:
    out = without_specks(q, np.full(q.shape, certain), AREA)
    np.testing.assert_array_equal(out[:, :55], q[:, :55])
    return bool((out[BLOB] == q[BLOB]).all())


@pytest.mark.parametrize("times", [0.45, 2.0])
def test_a_small_patch_off_its_surroundings_stays_only_where_enough_frames_see_it(times: float):
    q = ground()
    q[BLOB] = times * GROUND
    assert not is_kept(q, certain=False)
    assert is_kept(q, certain=True)


def test_a_small_patch_that_fits_its_surroundings_stays():
    q = ground()
    q[BLOB] = 1.15 * GROUND
    assert is_kept(q, certain=False)


def test_a_large_patch_stays_wherever_it_lies():
    q = ground()
    q[30:50, 60:80] = 2 * GROUND
    assert is_kept(q, certain=False)


def test_a_patch_with_nothing_around_has_to_fit_the_image():
    q = ground()
    q[:, 20:55] = 0
    q[BLOB] = 2 * GROUND
    alone = without_specks(q, np.zeros(q.shape, bool), AREA)
    assert (alone[BLOB] == 0).all()
    q[:, :20] = 0
    q[BLOB] = 2 * GROUND
    assert (without_specks(q, np.zeros(q.shape, bool), AREA) == q).all()  # nothing to fit


def test_specks_go_and_unknown_stays_unknown():
    q = ground()
    q[40:44, 60:64] = GROUND
    out = without_specks(q, np.ones(q.shape, bool), AREA)
    np.testing.assert_array_equal(out, ground())
    assert out.dtype == q.dtype
    assert (without_specks(np.zeros_like(q), np.zeros(q.shape, bool), AREA) == 0).all()
