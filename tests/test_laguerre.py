"""Gauss-Laguerre functions against SciPy's polynomials, quadrature and the FFT."""

from __future__ import annotations

import math

import numpy as np
import pytest
from array_api_extra.testing import assert_close
from scipy.special import eval_genlaguerre, gammaln

from fdnt_xp.errors import RangeError
from fdnt_xp.shapes.laguerre import (
    MAX_ORDER,
    LaguerreBasis,
    check_order,
    complex_coefficients,
    degrees,
    generators,
    n_coefficients,
    pixel_positions,
    position,
    round_functions,
)
from fdnt_xp.shear import shear_matrix
from tolerances import tolerance

ETA = np.array([[0.5, -0.4], [0.0, 0.0], [-0.2, 0.7]])
CENTROID = np.array([[0.4, -1.3], [0.0, 0.0], [-2.1, 0.6]])
SIZE = np.array([3.4, 2.9, 3.1])


def psi(p, q, u, v):
    """Return psi_pq, p >= q, from its definition."""
    r, m = np.hypot(u, v), p - q
    norm = (-1) ** q * np.exp(0.5 * (gammaln(q + 1) - gammaln(p + 1))) / math.sqrt(math.pi)
    radial = r**m * np.exp(-0.5 * r**2) * eval_genlaguerre(q, m, r**2)
    return norm * radial * np.exp(1j * m * np.arctan2(v, u))


def pairs(order):
    return [(n - q, q) for n in range(order + 1) for q in range(n // 2 + 1)]


@pytest.fixture
def make_basis(to_xp):
    """Return `make(order, dtype)`, the basis of three galaxies."""

    def make(order, dtype="float64"):
        eta, centroid, size = (to_xp(a, dtype) for a in (ETA, CENTROID, SIZE))
        return LaguerreBasis(order=order, eta=eta, centroid=centroid, size=size)

    return make


def pixels(side):
    y, x = np.mgrid[:side, :side] - 0.5 * (side - 1)
    return x.ravel(), y.ravel()


# --- the functions -------------------------------------------------------------------


def test_functions_are_those_of_the_definition(xp, dtype, to_xp):
    u, v = 3.0 * np.random.default_rng(1).normal(size=(2, 1, 300))
    functions = round_functions(xp, MAX_ORDER, to_xp(u, dtype), to_xp(v, dtype))
    expected = np.zeros(functions.shape)
    for p, q in pairs(MAX_ORDER):
        value = psi(p, q, u, v) * (math.sqrt(2.0) if p > q else 1.0)
        expected[:, position(p, q)] = value.real
        if p > q:
            expected[:, position(p, q, sine=True)] = value.imag
    assert_close(functions, to_xp(expected, dtype), **tolerance("laguerre", dtype), xp=xp)


def test_each_function_has_its_place():
    places = [position(p, q) for p, q in pairs(MAX_ORDER)]
    places += [position(p, q, sine=True) for p, q in pairs(MAX_ORDER) if p > q]
    assert sorted(places) == list(range(n_coefficients(MAX_ORDER)))
    degree = degrees(MAX_ORDER)
    assert all(degree[position(p, q)] == p + q for p, q in pairs(MAX_ORDER))


def test_a_lower_order_is_a_beginning_of_a_higher_one(xp, make_basis, to_xp):
    x, y = (to_xp(a) for a in pixels(6))
    low, high = (make_basis(order).in_x(x, y) for order in (5, 9))
    assert_close(low, high[:, : n_coefficients(5), :], rtol=0.0, atol=0.0, xp=xp)


def test_far_away_they_are_zero(xp, dtype, to_xp, to_np):
    far = to_xp(np.array([[30.0, 1e3, 1e18]]), dtype)
    values = to_np(round_functions(xp, MAX_ORDER, far, -far))
    assert np.all(np.isfinite(values))
    assert np.max(np.abs(values)) < 1e-30


def test_a_galaxy_without_a_basis_is_nan_alone(xp, make_basis, to_xp, to_np):
    x, y = (to_xp(a) for a in pixels(6))
    good = make_basis(4)
    size = to_xp(np.array([SIZE[0], np.nan, SIZE[2]]))
    bad = LaguerreBasis(order=4, eta=good.eta, centroid=good.centroid, size=size)
    values = to_np(bad.in_x(x, y))
    assert np.all(np.isnan(values[1]))
    np.testing.assert_array_equal(values[[0, 2]], to_np(good.in_x(x, y))[[0, 2]])


# --- orthonormal and self-dual -------------------------------------------------------


def test_the_round_functions_are_orthonormal():
    # The trapezoidal rule: the functions and their transforms end within 10.
    step = 0.3
    u, v = (step * a[None, :] for a in pixels(67))
    functions = round_functions(np, MAX_ORDER, u, v)[0]
    gram = step**2 * functions @ functions.T
    np.testing.assert_allclose(gram, np.eye(len(gram)), atol=1e-9)


def test_elliptical_functions_are_orthonormal_over_the_pixels(xp, dtype, make_basis, to_xp):
    x, y = (to_xp(a, dtype) for a in pixels(64))
    functions = make_basis(4, dtype).in_x(x, y)
    gram = xp.matmul(functions, xp.matrix_transpose(functions))
    expected = to_xp(np.stack([np.eye(n_coefficients(4))] * 3), dtype)
    assert_close(gram, expected, **tolerance("laguerre sums", dtype), xp=xp)


def test_each_is_its_own_transform(dtype, make_basis, to_xp, to_np):
    side, order = 64, 4
    x, y = pixels(side)
    basis = make_basis(order, dtype)
    images = to_np(basis.in_x(to_xp(x, dtype), to_xp(y, dtype)))
    spectra = np.fft.fft2(images.astype(float).reshape(3, -1, side, side)).reshape(3, -1, side**2)
    k = 2.0 * np.pi * np.fft.fftfreq(side)
    kx, ky = np.tile(k, side), np.repeat(k, side)
    phase = np.exp(-1j * (kx * CENTROID[:, 0:1] + ky * CENTROID[:, 1:2]))
    from_corner = np.exp(-0.5j * (side - 1) * (kx + ky))
    in_k = to_np(basis.in_k(to_xp(kx, dtype), to_xp(ky, dtype)))
    factor = (-1j) ** np.array(degrees(order))
    expected = factor[:, None] * in_k * (phase * from_corner)[:, None, :]
    limit = 60.0 * tolerance("laguerre sums", dtype)["atol"]
    np.testing.assert_allclose(spectra, expected, atol=limit)


def test_transform_and_image_are_sums_of_functions(xp, dtype, make_basis, to_xp, to_np):
    order = 7
    b = np.random.default_rng(2).normal(size=(3, n_coefficients(order)))
    x, y = pixels(12)
    basis = make_basis(order, dtype)
    place = to_xp(x, dtype), to_xp(y, dtype)
    image = basis.image(to_xp(b, dtype), *place)
    expected = np.einsum("gj,gjx->gx", b, to_np(basis.in_x(*place)))
    assert_close(image, to_xp(expected, dtype), **tolerance("laguerre", dtype), xp=xp)

    k = to_xp(0.1 * x, dtype), to_xp(0.1 * y, dtype)
    factor = (-1j) ** np.array(degrees(order))
    expected = np.einsum("gj,gjk->gk", factor * b, to_np(basis.in_k(*k)))
    re, im = basis.transform(to_xp(b, dtype), *k)
    tol = {"rtol": 0.0, "atol": 30.0 * tolerance("laguerre", dtype)["atol"], "xp": xp}
    assert_close(re, to_xp(expected.real, dtype), **tol)
    assert_close(im, to_xp(expected.imag, dtype), **tol)


def test_packed_coefficients_are_the_complex_ones(xp, dtype, make_basis, to_xp, to_np):
    order = 5
    b = np.random.default_rng(3).normal(size=(3, n_coefficients(order)))
    unpacked = complex_coefficients(to_xp(b, dtype), order)
    assert set(unpacked) == set(pairs(order))
    u, v = np.random.default_rng(4).normal(size=(2, 20))
    # b_qp psi_qp is the conjugate of b_pq psi_pq.
    image = sum(
        (2.0 if p > q else 1.0) * np.real(to_np(value)[:, None] * psi(p, q, u, v))
        for (p, q), value in unpacked.items()
    )
    functions = round_functions(np, order, u[None, :], v[None, :])[0]
    limit = 30.0 * tolerance("laguerre", dtype)["atol"]
    np.testing.assert_allclose(image, b @ functions, atol=limit)


# --- what moves them -----------------------------------------------------------------


def test_generators_are_derivatives():
    order, step = 6, 1e-5
    # Of order 4, so that nothing leaves the six.
    b = np.zeros(n_coefficients(order))
    b[: n_coefficients(4)] = np.random.default_rng(5).normal(size=n_coefficients(4))
    u, v = np.random.default_rng(6).normal(size=(2, 1, 50))

    def image(u, v, b=b):
        return b @ round_functions(np, order, u, v)[0]

    by_u = (image(u + step, v) - image(u - step, v)) / (2.0 * step)
    by_v = (image(u, v + step) - image(u, v - step)) / (2.0 * step)
    expected = [by_u, by_v, u * by_u + v * by_v, u * by_u - v * by_v]
    expected += [u * by_v + v * by_u, u * by_v - v * by_u]
    for matrix, derivative in zip(generators(order), expected, strict=True):
        np.testing.assert_allclose(image(u, v, matrix @ b), derivative.ravel(), atol=1e-8)


def test_generators_that_turn_and_move_keep_the_norm():
    turn = generators(6)[5]
    np.testing.assert_allclose(turn, -turn.T, atol=1e-14)
    for move in generators(6)[:2]:
        np.testing.assert_allclose(move, -move.T, atol=1e-14)


@pytest.mark.parametrize("unknown", range(5))
def test_moves_are_derivatives_of_round_positions(unknown, make_basis, to_xp, to_np):
    # The image seen in the changed basis: a generator for each of the five unknowns.
    length, step = np.array([2.0, 1.0, 3.0]), 1e-5
    point = np.array([[0.7], [-0.4]])

    def place(sign):
        change = np.zeros((3, 5))
        change[:, unknown] = sign * step
        eta, centroid = ETA + change[:, 2:4], CENTROID + length[:, None] * change[:, :2]
        half = 0.5 * np.hypot(*eta.T)[:, None, None]
        n = np.stack([np.stack([eta[:, 0], eta[:, 1]], -1), np.stack([eta[:, 1], -eta[:, 0]], -1)])
        n = np.moveaxis(n, 0, 1)
        s = np.cosh(half) * np.eye(2) + 0.5 * np.sinh(half) / np.maximum(half, 1e-300) * n
        return centroid[:, :, None] + (SIZE * np.exp(change[:, 4]))[:, None, None] * s @ point

    moved = (place(1.0) - place(-1.0)) / (2.0 * step)
    # du = S^-1 dx/sigma.
    expected = (np.linalg.inv(shear_matrix(ETA)) @ moved / SIZE[:, None, None])[:, :, 0]
    u, v = point[:, 0]
    fields = np.array([[1, 0], [0, 1], [u, v], [u, -v], [v, u], [-v, u]])
    weights = to_np(make_basis(2).moves(to_xp(length)))[:, unknown, :]
    np.testing.assert_allclose(weights @ fields, expected, atol=1e-8)


# --- batches, and what is refused ----------------------------------------------------


def test_a_batch_is_its_rows_and_may_be_empty(xp, make_basis, to_xp):
    x, y = (to_xp(a) for a in pixels(8))
    basis = make_basis(4)
    together = basis.in_x(x, y)
    for i in range(3):
        alone = basis.take(to_xp(np.array([i]))).in_x(x, y)
        assert_close(alone, together[i : i + 1, :, :], rtol=0.0, atol=1e-15, xp=xp)
    none = basis.take(to_xp(np.array([], dtype=np.int64)))
    assert none.in_x(x, y).shape == (0, n_coefficients(4), 64)


def test_pixels_count_from_the_centre_of_the_stamp(xp, dtype, to_xp, to_np):
    x, y = pixel_positions(xp, to_xp(np.zeros((1, 3, 4)), dtype))
    assert x.dtype == y.dtype == dtype
    np.testing.assert_array_equal(to_np(x), np.tile([-1.5, -0.5, 0.5, 1.5], 3))
    np.testing.assert_array_equal(to_np(y), np.repeat([-1.0, 0.0, 1.0], 4))


@pytest.mark.parametrize("order", [-1, 21, 2.5])
def test_there_is_no_such_order(order):
    with pytest.raises(RangeError, match="order"):
        check_order(order)
