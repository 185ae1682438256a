"""The half-plane k grid, against sums over the whole plane of NumPy's full FFT."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close, assert_equal
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from fdnt_xp.fourier.grid import half_plane_disc
from tolerances import tolerance

SHAPES = [(9, 9), (8, 8), (7, 10), (10, 7)]
"""Odd, even, and not square: the Nyquist modes and the half plane differ in each."""
KMAX = 2.6
EVEN = [(0, 0), (2, 0), (1, 1), (0, 2), (4, 0), (3, 1), (2, 2), (1, 3), (0, 4)]
ODD = [(1, 0), (0, 1), (3, 0), (2, 1), (1, 2), (0, 3)]
GAMMA = np.array([0.3, -0.5])
S_GAMMA = expm(0.5 * np.array([[0.3, -0.5], [-0.5, -0.3]]))

each_shape = pytest.mark.parametrize("shape", SHAPES, ids=str)


def full_plane(shape):
    """Return kx and ky of all modes of `np.fft.fft2`, each of the shape of the image."""
    ny, nx = shape
    ky = 2.0 * np.pi * np.fft.fftfreq(ny)[:, None] + np.zeros(nx)
    kx = 2.0 * np.pi * np.fft.fftfreq(nx)[None, :] + np.zeros((ny, 1))
    return kx, ky


@pytest.fixture
def make_grid(xp, device):
    """Return `make(shape, kmax, dtype)`."""

    def make(shape, kmax, dtype):
        return half_plane_disc(xp, shape, kmax, dtype=dtype, device=device)

    return make


# --- the modes -----------------------------------------------------------------------


@each_shape
def test_a_mode_or_its_opposite_is_there_once(shape, xp, dtype, make_grid, to_np):
    grid = make_grid(shape, KMAX, dtype)
    kx, ky = full_plane(shape)
    inside = np.hypot(kx, ky) < KMAX
    cells = np.array([shape[1], shape[0]]) / (2.0 * np.pi)
    expected = {tuple(pair) for pair in np.rint(np.stack([kx, ky], -1)[inside] * cells).astype(int)}
    ours = np.rint(np.stack([to_np(grid.kx), to_np(grid.ky)], -1) * cells).astype(int)
    both = [*map(tuple, ours), *(tuple(-pair) for pair in ours if pair.any())]
    assert len(both) == len(set(both))
    assert set(both) == expected
    assert np.sum(to_np(grid.fold)) == len(both)
    assert grid.n_k == ours.shape[0]
    assert grid.kx.dtype == grid.ky.dtype == grid.fold.dtype == dtype


@each_shape
def test_index_names_the_mode_of_the_transform(shape, xp, dtype, make_grid, to_xp, to_np):
    # A plane wave has its transform at its own mode, and there alone.
    grid = make_grid(shape, KMAX, dtype)
    index = to_np(grid.index)
    y, x = np.indices(shape)
    cell_x, cell_y = (2.0 * np.pi / shape[1], 2.0 * np.pi / shape[0])
    for mode in range(0, grid.n_k, 5):
        nx = round(float(to_np(grid.kx)[mode]) / cell_x)
        ny = round(float(to_np(grid.ky)[mode]) / cell_y)
        wave = np.cos(nx * cell_x * x + ny * cell_y * y)
        spectrum = np.abs(np.fft.rfft2(wave)).ravel()[index]
        assert np.argmax(spectrum) == mode
    assert len(set(index.tolist())) == grid.n_k
    assert np.max(index) < grid.n_half_plane == np.fft.rfft2(np.zeros(shape)).size


def test_the_first_modes_are_those_of_a_smaller_disc(xp, dtype, make_grid, to_np):
    whole, small = make_grid((8, 9), KMAX, dtype), make_grid((8, 9), 0.6 * KMAX, dtype)
    radius = np.hypot(to_np(whole.kx), to_np(whole.ky))
    assert np.all(np.diff(radius) >= -1e-6)
    n_k = whole.n_inside(0.6 * KMAX)
    assert n_k == small.n_k < whole.n_k
    inner = whole.inner(n_k)
    for name in ("kx", "ky", "fold", "index"):
        assert_equal(getattr(inner, name), getattr(small, name), xp=xp)
    assert to_np(whole.number_of(inner.index)).tolist() == list(range(n_k))


def test_opposite_modes_count_twice_and_the_middle_once(dtype, make_grid, to_np):
    grid = make_grid((8, 9), KMAX, dtype)
    zero = (to_np(grid.kx) == 0) & (to_np(grid.ky) == 0)
    np.testing.assert_array_equal(to_np(grid.fold), np.where(zero, 1.0, 2.0))
    assert np.sum(zero) == 1


@each_shape
def test_the_largest_disc_has_no_nyquist_mode(shape, make_grid, xp, to_np):
    # They are their own conjugates and would need another weight.
    grid = make_grid(shape, np.pi, xp.float64)
    assert np.max(to_np(grid.kx)) < 3.14
    assert np.max(np.abs(to_np(grid.ky))) < 3.14


def test_the_smallest_disc_is_the_flux(make_grid, xp, to_np):
    grid = make_grid((8, 8), 1e-3, xp.float64)
    assert (grid.n_k, to_np(grid.index).tolist()) == (1, [0])


# --- sums over the plane -------------------------------------------------------------


@each_shape
def test_sums_are_those_over_the_whole_plane(shape, xp, dtype, make_grid, to_xp, to_np):
    images = np.random.default_rng(1).normal(size=(2, *shape))
    kx, ky = full_plane(shape)
    inside = np.hypot(kx, ky) < KMAX
    spectra = np.fft.fft2(images) * inside
    grid = make_grid(shape, KMAX, dtype)
    modes = np.fft.rfft2(images).reshape(2, -1)[:, to_np(grid.index)]
    even = xp.concat(grid.even_moments(to_xp(modes.real, dtype)), axis=-1)
    odd = xp.concat(grid.odd_moments(to_xp(modes.imag, dtype)), axis=-1)
    for actual, field, powers in ((even, spectra.real, EVEN), (odd, spectra.imag, ODD)):
        terms = np.stack([field * kx**i * ky**j for i, j in powers], -1)
        scale = np.sum(np.abs(terms), axis=(1, 2))
        expected = np.sum(terms, axis=(1, 2)) / scale
        actual = actual / to_xp(scale, dtype)
        assert_close(actual, to_xp(expected, dtype), **tolerance("sums", dtype), xp=xp)


def test_moments_come_by_degree(make_grid, xp, to_xp):
    field = to_xp(np.ones((3, make_grid((6, 6), 2.0, xp.float64).n_k)))
    grid = make_grid((6, 6), 2.0, xp.float64)
    assert [m.shape for m in grid.even_moments(field)] == [(3, 1), (3, 3), (3, 5)]
    assert [m.shape for m in grid.odd_moments(field)] == [(3, 2), (3, 4)]


def test_squares_have_no_weight(xp, dtype, make_grid, to_xp, to_np):
    grid = make_grid((7, 10), KMAX, dtype)
    kx, ky = to_np(grid.kx), to_np(grid.ky)
    expected = to_xp(np.stack([kx * kx, kx * ky, ky * ky]), dtype)
    assert_close(grid.squares, expected, **tolerance("algebra", dtype), xp=xp)


def test_a_batch_is_its_rows_and_may_be_empty(xp, dtype, make_grid, to_xp):
    grid = make_grid((7, 10), KMAX, dtype)
    field = to_xp(np.random.default_rng(2).normal(size=(3, grid.n_k)), dtype)
    tol = {"rtol": 0.0, "atol": 1e3 * tolerance("sums", dtype)["atol"], "xp": xp}
    for moments in (grid.even_moments, grid.odd_moments):
        together = moments(field)
        alone = [moments(field[i : i + 1, :]) for i in range(3)]
        for degree, moment in enumerate(together):
            assert_close(moment, xp.concat([row[degree] for row in alone], axis=0), **tol)
        empty = moments(field[:0, :])
        assert [m.shape for m in empty] == [(0, m.shape[1]) for m in together]


# --- counter-shears ------------------------------------------------------------------


def test_sheared_coordinates_are_s_gamma_k(xp, dtype, make_grid, to_xp, to_np):
    grid = make_grid((8, 9), KMAX, dtype)
    sheared = grid.sheared(to_xp(GAMMA, dtype))
    expected = S_GAMMA @ np.stack([to_np(grid.kx), to_np(grid.ky)]).astype(float)
    actual = xp.stack([sheared.kx, sheared.ky], axis=0)
    assert_close(actual, to_xp(expected, dtype), **tolerance("algebra", dtype), xp=xp)
    # The data stay where they are.
    assert_equal(sheared.index, grid.index, xp=xp)
    assert_equal(sheared.fold, grid.fold, xp=xp)
    assert sheared.shape == grid.shape


def test_sheared_moments_are_taken_at_the_sheared_coordinates(xp, dtype, make_grid, to_xp, to_np):
    grid = make_grid((8, 9), KMAX, dtype)
    field = np.random.default_rng(3).normal(size=(1, grid.n_k))
    _ = grid.even_moments(to_xp(field, dtype))  # what the grid keeps must not be kept
    actual = grid.sheared(to_xp(GAMMA, dtype)).even_moments(to_xp(field, dtype))[1]
    kx, ky = S_GAMMA @ np.stack([to_np(grid.kx), to_np(grid.ky)]).astype(float)
    terms = np.stack([kx * kx, kx * ky, ky * ky], -1) * (field[0] * to_np(grid.fold))[:, None]
    scale = np.sum(np.abs(terms), axis=0)[None, :]
    expected = to_xp(np.sum(terms, axis=0)[None, :] / scale, dtype)
    assert_close(actual / to_xp(scale, dtype), expected, **tolerance("sums", dtype), xp=xp)


@given(st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)).map(np.array))
def test_the_opposite_shear_gives_the_grid_back(gamma):
    grid = half_plane_disc(np, (7, 8), KMAX, dtype=np.float64, device="cpu")
    back = grid.sheared(gamma).sheared(-gamma)
    np.testing.assert_allclose([back.kx, back.ky], [grid.kx, grid.ky], atol=1e-13)


# --- names of the modes --------------------------------------------------------------


@each_shape
def test_rows_and_columns_name_the_modes(shape, dtype, make_grid, to_np):
    grid = make_grid(shape, KMAX, dtype)
    row, column = (to_np(part) for part in grid.row_and_column)
    kx = 2.0 * np.pi * np.fft.rfftfreq(shape[1])[column]
    ky = 2.0 * np.pi * np.fft.fftfreq(shape[0])[row]
    tolerances = tolerance("algebra", dtype)
    np.testing.assert_allclose(to_np(grid.kx), kx, **tolerances)
    np.testing.assert_allclose(to_np(grid.ky), ky, **tolerances)


@pytest.mark.parametrize("side", [8, 9])
def test_a_quarter_turn_of_the_image_moves_its_modes(side, make_grid, xp, to_np):
    grid = make_grid((side, side), KMAX, xp.float64)
    source, sign = (to_np(part) for part in grid.quarter_turn)
    image = np.random.default_rng(0).standard_normal((side, side))

    def modes(pixels):
        """Return the transform about the middle of the image."""
        kx, ky = to_np(grid.kx), to_np(grid.ky)
        x = np.arange(side) - 0.5 * (side - 1)
        waves = np.exp(-1j * (kx[:, None, None] * x + ky[:, None, None] * x[:, None]))
        return np.sum(pixels * waves, axis=(1, 2))

    # y is up: counter-clockwise is clockwise for NumPy.
    straight, turned = modes(image), modes(np.rot90(image, -1))
    np.testing.assert_allclose(turned.real, straight.real[source], atol=1e-12)
    np.testing.assert_allclose(turned.imag, sign * straight.imag[source], atol=1e-12)
