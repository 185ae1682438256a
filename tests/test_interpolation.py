"""Cubic tables: exact for cubics, fourth order for the rest, flat beyond the end."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close, assert_equal
from hypothesis import given
from hypothesis import strategies as st

from fdnt_xp.fourier.interpolation import cubic_table
from tolerances import tolerance

N_NODE = 9
NODES = np.linspace(0.0, 1.0, N_NODE)
CUBICS = [np.poly1d(c) for c in ([2.0, -3.0, 0.5, 1.0], [-1.0, 0.0, 0.0, 2.0], [4.0, 0.0])]
T = np.array([0.0, 0.03, 0.125, 0.3, 0.5, 0.61, 0.75, 0.9, 0.999])
"""Inside cells, on nodes (multiples of 1/8), and near the ends."""


def tabulate(function, n_node=N_NODE, **options):
    return cubic_table(function(np.linspace(0.0, 1.0, n_node))[None, :], **options)


@pytest.fixture
def cubics(to_xp, dtype):
    """A table of each cubic."""
    return cubic_table(to_xp([cubic(NODES) for cubic in CUBICS], dtype))


def test_cubics_are_exact(xp, dtype, cubics, to_xp):
    t = to_xp(np.stack([T] * 3), dtype)
    value, slope = cubics.evaluate(t, to_xp([0, 1, 2]))
    expected = to_xp([cubic(T) for cubic in CUBICS], dtype)
    expected_slope = to_xp([cubic.deriv()(T) + 0.0 * T for cubic in CUBICS], dtype)
    tol = {key: 30.0 * v for key, v in tolerance("algebra", dtype).items()}  # slopes: x n_cell
    assert_close(value, expected, **tolerance("algebra", dtype), xp=xp)
    assert_close(slope, expected_slope, **tol, xp=xp)


def test_one_t_for_each_row(xp, dtype, cubics, to_xp):
    # One number per row, rows in any order and more than once.
    rows = [2, 0, 0, 1]
    value, slope = cubics.evaluate(to_xp(T[3:7], dtype), to_xp(rows))
    expected = [CUBICS[row](t) for row, t in zip(rows, T[3:7], strict=True)]
    assert_close(value, to_xp(expected, dtype), **tolerance("algebra", dtype), xp=xp)
    assert value.shape == slope.shape == (4,)


def test_the_only_table_needs_no_row(xp, dtype, cubics, to_xp):
    only = cubics.take(to_xp([1]))
    t = to_xp(np.stack([T, T[::-1]]), dtype)
    assert_equal(only.evaluate(t)[0], cubics.evaluate(t, to_xp([1, 1]))[0], xp=xp)


def test_take_reorders_and_repeats(xp, dtype, cubics, to_xp):
    taken = cubics.take(to_xp([2, 0, 2]))
    t = to_xp(np.stack([T] * 3), dtype)
    actual = taken.evaluate(t, to_xp([0, 1, 2]))
    expected = cubics.evaluate(t, to_xp([2, 0, 2]))
    for ours, theirs in zip(actual, expected, strict=True):
        assert_equal(ours, theirs, xp=xp)
    assert taken.n_cell == cubics.n_cell == N_NODE - 1


def test_beyond_the_end_it_is_flat(xp, dtype, cubics, to_xp):
    t = to_xp(np.array([[1.0, 1.0 + 1e-6, 2.0, 1e6, np.inf]] * 3), dtype)
    value, slope = cubics.evaluate(t, to_xp([0, 1, 2]))
    expected = to_xp([[cubic(1.0)] * 5 for cubic in CUBICS], dtype)
    assert_close(value, expected, **tolerance("algebra", dtype), xp=xp)
    assert_equal(slope, xp.zeros_like(value), xp=xp)


def test_it_passes_through_its_nodes(xp, dtype, to_xp):
    rough = np.random.default_rng(4).normal(size=(2, N_NODE))
    table = cubic_table(to_xp(rough, dtype))
    value, _ = table.evaluate(to_xp(np.stack([NODES] * 2), dtype), to_xp([0, 1]))
    assert_close(value, to_xp(rough, dtype), **tolerance("algebra", dtype), xp=xp)


def test_forced_end_is_smooth(xp, dtype, to_xp, to_np):
    # (1 - t)² + (1 - t) has slope -1 at the end; forced, the last cell bends to 0 there.
    table = cubic_table(to_xp([(1.0 - NODES) ** 2 + 1.0 - NODES], dtype), zero_beyond=True)
    near = 1.0 - np.array([[1e-1, 1e-2, 1e-3, 0.0]])
    value, slope = (to_np(part)[0] for part in table.evaluate(to_xp(near, dtype)))
    assert value[-1] == slope[-1] == 0.0
    assert np.all(slope[:-1] < 0.0)
    # Quadratic: the slope falls with the distance, the value with its square.
    np.testing.assert_allclose(slope[1] / slope[2], 10.0, rtol=0.2)
    np.testing.assert_allclose(value[1] / value[2], 100.0, rtol=0.2)


def test_no_rows_are_no_trouble(xp, dtype, cubics, to_xp):
    value, slope = cubics.evaluate(to_xp(np.empty((0, 4)), dtype), to_xp(np.empty(0, int)))
    assert value.shape == slope.shape == (0, 4)
    assert cubics.take(to_xp(np.empty(0, int))).coefficients[0].shape == (0,)


# --- on NumPy: how good, and how smooth ----------------------------------------------


def test_errors_are_of_fourth_order():
    t = np.linspace(0.2, 0.8, 1001)
    error = {}
    for n_node in (17, 33):
        value, slope = tabulate(np.exp, n_node).evaluate(t)
        error[n_node] = np.max(np.abs(value - np.exp(t))), np.max(np.abs(slope - np.exp(t)))
    ratio = np.divide(error[17], error[33])
    np.testing.assert_allclose(ratio, [16.0, 8.0], rtol=0.15)
    # Hermite's h^4/384 of the fourth derivative, and the rest from the slopes' h^5/30.
    assert error[33][0] < 1.3 * np.exp(0.8) / 32**4 / 384


def test_slope_is_the_derivative_of_the_value():
    table = tabulate(lambda t: np.exp(-3.0 * t) * np.cos(9.0 * t), zero_beyond=True)
    t = np.linspace(0.011, 0.987, 90)  # on no node, where the second derivative jumps
    h = 1e-5
    numeric = (table.evaluate(t + h)[0] - table.evaluate(t - h)[0]) / (2.0 * h)
    np.testing.assert_allclose(table.evaluate(t)[1], numeric, atol=1e-7)


@given(st.lists(st.floats(-1.0, 1.0), min_size=5, max_size=12))
def test_value_and_slope_have_no_jumps(values):
    table = cubic_table(np.array([values]))
    nodes = np.linspace(0.0, 1.0, len(values))[1:-1]
    below, above = (table.evaluate(nodes + side) for side in (-1e-12, 1e-12))
    np.testing.assert_allclose(below[0], above[0], atol=1e-9)
    np.testing.assert_allclose(below[1], above[1], atol=1e-7)


def test_a_rough_spot_does_not_ring():
    clean, spot = np.zeros((1, 21)), np.zeros((1, 21))
    spot[0, 10] = 1.0
    t = np.linspace(0.0, 1.0, 401)
    difference = np.abs(cubic_table(spot).evaluate(t)[0] - cubic_table(clean).evaluate(t)[0])
    assert np.max(difference[np.abs(t - 0.5) > 3.0 / 20 + 1e-9]) == 0.0
