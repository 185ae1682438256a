"""Many small systems at once, against numpy.linalg."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close, assert_equal

from fdnt_xp.nulltests.small_systems import all_of, inverse, largest, newton_step


@pytest.mark.parametrize("d", [1, 2, 4, 5])
def test_inverses_and_solutions(d, xp, dtype, to_xp, to_np):
    # Rows of sizes between which ten powers of ten lie, which pivots by size alone would mix up.
    rng = np.random.default_rng(d)
    rows = 10.0 ** rng.uniform(-5, 5, (40, d, 1))
    matrix = rows * (rng.standard_normal((40, d, d)) + 2.0 * np.eye(d)[rng.permutation(d)])
    f = rows[:, :, 0] * rng.standard_normal((40, d))
    rounded = to_np(to_xp(matrix, dtype)).astype(float)
    expected = np.linalg.inv(rounded)
    rtol = 1e-9 if "64" in str(dtype) else 2e-3
    found, regular = inverse(xp, to_xp(matrix, dtype))
    assert bool(xp.all(regular))
    scale = np.max(np.abs(expected * np.swapaxes(rows, 1, 2)), axis=(1, 2))
    error = np.abs(to_np(found) - expected) * np.swapaxes(rows, 1, 2)
    assert np.all(error < rtol * scale[:, None, None])
    step, regular = newton_step(xp, to_xp(f, dtype), to_xp(matrix, dtype))
    assert bool(xp.all(regular))
    assert_close(step, to_xp(-np.linalg.solve(rounded, f[:, :, None])[:, :, 0], dtype), rtol=rtol)


def test_a_matrix_without_an_inverse_harms_no_other(xp, dtype, to_xp, to_np):
    matrix = np.stack([np.eye(3), np.ones((3, 3)), np.full((3, 3), np.nan), np.zeros((3, 3))])
    found, regular = inverse(xp, to_xp(matrix, dtype))
    assert to_np(regular).tolist() == [True, False, False, False]
    expected = np.concatenate([np.eye(3)[None], np.zeros((3, 3, 3))])
    assert_equal(found, to_xp(expected, dtype))


def test_nothing_to_solve(xp, dtype, to_xp):
    found, regular = inverse(xp, to_xp(np.zeros((0, 4, 4)), dtype))
    assert tuple(found.shape) == (0, 4, 4)
    assert tuple(regular.shape) == (0,)


def test_short_axes(xp, dtype, to_xp, to_np):
    array = np.array([[1.0, -3.0, 2.0], [np.nan, 1.0, 0.0], [-np.inf, 1.0, 0.0]])
    assert_equal(largest(xp, to_xp(array, dtype)), to_xp(np.array([3.0, np.nan, np.inf]), dtype))
    assert to_np(all_of(xp, to_xp(array > -5))).tolist() == [True, False, False]
