"""The weight of the null tests and its size equation, against formulae and quadrature."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close, assert_equal
from scipy.integrate import quad

from fdnt_xp.fourier.psf import Psf
from fdnt_xp.nulltests.weights import make_weight
from images import gaussian_covariance, gaussian_image
from tolerances import tolerance

FLOOR = 1e-2
SIGMAS = (1.5, 2.0)
"""Sizes of two round Gaussian PSFs."""
SHAPE = (22, 25)
STARS = [gaussian_image(gaussian_covariance((0.0, 0.0), sigma), SHAPE) for sigma in SIGMAS]
LARGEST = 5.0
SHRINK = np.array([1.0, 1.25, 1.8])
SIZES = np.array([1.2, 2.0, 4.5])
"""Of the weight, in units of the shrink factor."""


def circular_power(k, sigma, kmax):
    """Return 𝒯 of a round Gaussian PSF, ended as `P (1 - t⁸ P_end/P)²`, t = k/kmax."""
    power = np.exp(-((k * sigma) ** 2))
    end = (k / kmax) ** 8 * np.exp(-((kmax * sigma) ** 2))
    return np.where(k < kmax, (power - end) ** 2 / power, 0.0)


def slope_by_square(k, sigma, kmax):
    """Return its derivative by k²."""
    power, by_square = np.exp(-((k * sigma) ** 2)), -(sigma**2) * np.exp(-((k * sigma) ** 2))
    rest = power - (k / kmax) ** 8 * np.exp(-((kmax * sigma) ** 2))
    by_square_rest = by_square - 4.0 * (power - rest) / k**2
    slope = 2.0 * rest * by_square_rest / power - rest**2 * by_square / power**2
    return np.where(k < kmax, slope, 0.0)


def mean_powers(width, shrink, sigma, kmax):
    """Return <k²> and <k⁴> under `𝒯(s k) exp(-k² width/2) k dk`, by quadrature."""

    def moment(n):
        def integrand(k):
            return (
                k ** (n + 1) * circular_power(shrink * k, sigma, kmax) * np.exp(-0.5 * k**2 * width)
            )

        return quad(integrand, 0.0, kmax / shrink, epsabs=0.0, epsrel=1e-11, limit=200)[0]

    return moment(2) / moment(0), moment(4) / moment(0)


@pytest.fixture
def shared(dtype, to_xp):
    """The weight of one PSF for all galaxies."""
    return make_weight(Psf.from_image(to_xp(STARS[0], dtype), floor=FLOOR), LARGEST)


@pytest.fixture
def each(dtype, to_xp):
    """The weights of two PSFs, for two galaxies."""
    return make_weight(Psf.from_image(to_xp(STARS, dtype), floor=FLOOR), LARGEST)


def kmax_of(weight, to_np):
    return to_np(weight.kmax).astype(float)


# --- the part of the PSF -------------------------------------------------------------


def test_psf_factor_is_the_circular_power_of_s_k(xp, dtype, shared, to_xp, to_np):
    kmax = kmax_of(shared, to_np)[0]
    # From a twentieth of the disc, the first mode of a small grid, to beyond its end.
    k = np.linspace(0.05, 1.1, 12)[None, :] * kmax / SHRINK[:, None]
    value, slope = shared.psf_factor(to_xp(k**2, dtype), to_xp(SHRINK, dtype))
    u = SHRINK[:, None] * k
    expected = to_xp(circular_power(u, SIGMAS[0], kmax), dtype)
    assert_close(value, expected, **tolerance("weight", dtype), xp=xp)
    # d/dq = s² d/du², of the order of s² sigma².
    expected = to_xp(slope_by_square(u, SIGMAS[0], kmax) / SIGMAS[0] ** 2, dtype)
    unit = to_xp(SHRINK[:, None] ** 2 * SIGMAS[0] ** 2, dtype)
    assert_close(slope / unit, expected, **tolerance("weight slope", dtype), xp=xp)


def test_psf_factor_at_zero_and_beyond_the_disc(xp, dtype, shared, to_xp, to_np):
    kmax = kmax_of(shared, to_np)[0]
    square = np.stack([0.0 * SHRINK, (1.001 * kmax / SHRINK) ** 2, 100.0 * SHRINK], axis=1)
    value, slope = shared.psf_factor(to_xp(square, dtype), to_xp(SHRINK, dtype))
    expected = to_xp([[1.0, 0.0, 0.0]] * 3, dtype)
    assert_close(value, expected, **tolerance("weight", dtype), xp=xp)
    # At k = 0 the derivative is only ever multiplied by q: any finite number would do.
    assert bool(xp.all(xp.isfinite(slope[:, 0])))
    assert_equal(slope[:, 1:], xp.zeros_like(slope[:, 1:]), xp=xp)


def test_psf_factor_of_each_galaxy(xp, dtype, each, to_xp, to_np):
    kmax = kmax_of(each, to_np)
    k = np.linspace(0.1, 1.05, 5)[None, :] * kmax[:, None]
    value, _ = each.psf_factor(to_xp(k**2, dtype), to_xp([1.0, 1.0], dtype))
    expected = np.stack([circular_power(k[i], SIGMAS[i], kmax[i]) for i in (0, 1)])
    assert_close(value, to_xp(expected, dtype), **tolerance("weight", dtype), xp=xp)
    assert abs(kmax[0] / kmax[1] - SIGMAS[1] / SIGMAS[0]) < 2e-3


def test_slope_of_the_psf_factor_is_its_derivative():
    weight = make_weight(Psf.from_image(STARS[0], floor=FLOOR), LARGEST)
    shrink, h = np.array([1.3]), 1e-6
    square = np.linspace(0.01, 0.9, 73)[None, :] * (weight.kmax[0] / 1.3) ** 2
    above, below = (weight.psf_factor(square + d, shrink)[0] for d in (h, -h))
    numeric = (above - below) / (2.0 * h)
    np.testing.assert_allclose(weight.psf_factor(square, shrink)[1], numeric, atol=1e-6)


# --- the size equation ---------------------------------------------------------------


def test_matched_width_inverts_the_mean_square(xp, dtype, shared, to_xp, to_np):
    # Of a weight of known width, by quadrature; with the slope from <k⁴>, as
    # d<k²>/dwidth = -Var(k²)/2.
    kmax = kmax_of(shared, to_np)[0]
    widths = (SIZES * SHRINK) ** 2
    pairs = zip(widths, SHRINK, strict=True)
    second, fourth = np.transpose([mean_powers(w, s, SIGMAS[0], kmax) for w, s in pairs])
    width, slope, at_bound = shared.matched_width(to_xp(1.0 / second, dtype), to_xp(SHRINK, dtype))
    unit = to_xp(1.0 / widths, dtype)
    tol = tolerance("matched width", dtype)
    assert_close(width * unit, xp.ones_like(width), **tol, xp=xp)
    expected = 2.0 * second**2 / (fourth - second**2)
    tol = {key: 30.0 * value for key, value in tol.items()}  # a derivative of the table
    assert_close(slope, to_xp(expected, dtype), **tol, xp=xp)
    assert not bool(xp.any(at_bound))


def test_matched_width_of_each_galaxy(xp, dtype, each, to_xp, to_np):
    kmax = kmax_of(each, to_np)
    second = [mean_powers(9.0, 1.5, SIGMAS[i], kmax[i])[0] for i in (0, 1)]
    shrink = to_xp([1.5, 1.5], dtype)
    width, _, at_bound = each.matched_width(to_xp(1.0 / np.array(second), dtype), shrink)
    tol = tolerance("matched width", dtype)
    assert_close(width / 9.0, xp.ones_like(width), **tol, xp=xp)
    assert not bool(xp.any(at_bound))


def test_the_width_is_held_at_its_bounds(xp, dtype, shared, to_xp, to_np):
    # <k²> too large for the narrowest weight, sigma kmax/s = 0.5; too small for LARGEST s.
    kmax = kmax_of(shared, to_np)[0]
    shrink = np.array([1.0, 2.0, 1.0, 2.0])
    inverse = to_xp([0.0, 1e-3, 1e30, 1e4], dtype)
    width, slope, at_bound = shared.matched_width(inverse, to_xp(shrink, dtype))
    narrow, wide = 0.5 * shrink[:2] / kmax, LARGEST * shrink[2:]
    expected = to_xp(np.concatenate([narrow, wide]) ** 2, dtype)
    assert_close(width, expected, **tolerance("default", dtype), xp=xp)
    assert_equal(slope, xp.zeros_like(slope), xp=xp)
    assert bool(xp.all(at_bound))


def test_the_bounds_are_where_the_equation_says(dtype, shared, to_xp, to_np):
    kmax = kmax_of(shared, to_np)[0]
    for size in (0.5 / kmax, LARGEST):
        inverse = 1.0 / mean_powers(size**2, 1.0, SIGMAS[0], kmax)[0]
        one = to_xp([1.0, 1.0], dtype)
        _, _, at_bound = shared.matched_width(to_xp(np.array([0.999, 1.001]) * inverse, dtype), one)
        assert to_np(at_bound).tolist() == ([True, False] if size < 1.0 else [False, True])


def test_a_small_largest_size_leaves_a_range(dtype, to_xp, to_np):
    weight = make_weight(Psf.from_image(to_xp(STARS[0], dtype), floor=FLOOR), 1e-3)
    np.testing.assert_allclose(to_np(weight.widths.width_range), [[0.25, 1.0]], rtol=1e-6)
    assert to_np(weight.widths.square_range[:, 1] > weight.widths.square_range[:, 0]).all()


def test_slope_of_the_matched_width_is_its_derivative():
    weight = make_weight(Psf.from_image(STARS[0], floor=FLOOR), LARGEST)
    inverse, h = np.linspace(4.2, 10.0, 31), 1e-6
    shrink = np.full(31, 1.2)
    (above, _, bound), (below, _, _) = (weight.matched_width(inverse + d, shrink) for d in (h, -h))
    assert not bound.any()
    numeric = (above - below) / (2.0 * h)
    np.testing.assert_allclose(weight.matched_width(inverse, shrink)[1], numeric, rtol=1e-7)


# --- batches -------------------------------------------------------------------------


def test_the_weight_of_a_stack_is_that_of_its_psfs(xp, dtype, each, to_xp):
    # At k = 0 the slope is any finite number: it only ever meets factors of q.
    square, shrink = to_xp([[0.01, 0.1, 0.4, 0.9]], dtype), to_xp([1.2], dtype)
    inverse = to_xp([5.0], dtype)
    for i, star in enumerate(STARS):
        alone = make_weight(Psf.from_image(to_xp(star, dtype), floor=FLOOR), LARGEST)
        row = each.take(to_xp([1 - i, i])).only(to_xp([1]))
        assert alone.shared
        assert row.shared
        assert not each.take(to_xp([i])).shared
        tol = tolerance("sums", dtype)
        for ours, theirs in zip(
            (*row.psf_factor(square, shrink), *row.matched_width(inverse, shrink)[:2]),
            (*alone.psf_factor(square, shrink), *alone.matched_width(inverse, shrink)[:2]),
            strict=True,
        ):
            assert_close(ours, theirs, rtol=1e3 * tol["atol"], atol=tol["atol"], xp=xp)


def test_take_follows_the_galaxies(xp, dtype, each, shared, to_xp):
    rows = to_xp([1, 0, 1])
    taken = each.take(rows)
    assert not taken.shared
    assert_equal(taken.kmax, xp.take(each.kmax, rows, axis=0), xp=xp)
    for name in ("width_range", "square_range"):
        expected = xp.take(getattr(each.widths, name), rows, axis=0)
        assert_equal(getattr(taken.widths, name), expected, xp=xp)
    square = to_xp([[0.1, 0.4, 0.9]], dtype)
    ones = to_xp([1.0, 1.0], dtype)
    here = each.psf_factor(xp.concat([square] * 2), ones)[0]
    there = taken.psf_factor(xp.concat([square] * 3), to_xp([1.0] * 3, dtype))[0]
    assert_equal(there, xp.take(here, rows, axis=0), xp=xp)
    here = each.matched_width(to_xp([5.0, 5.0], dtype), ones)[0]
    there = taken.matched_width(to_xp([5.0] * 3, dtype), to_xp([1.0] * 3, dtype))[0]
    assert_equal(there, xp.take(here, rows, axis=0), xp=xp)
    assert shared.take(rows) is shared  # one for all stays one for all


def test_no_galaxies_have_no_weights(dtype, shared, to_xp):
    nothing = to_xp(np.empty(0), dtype)
    assert [a.shape for a in shared.matched_width(nothing, nothing)] == [(0,)] * 3
    square = to_xp(np.empty((0, 4)), dtype)
    assert [a.shape for a in shared.psf_factor(square, nothing)] == [(0, 4)] * 2
