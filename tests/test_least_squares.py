"""Batched least squares: the solution of others, and patterns of pixels that carry none."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close

from fdnt_xp.shapes.laguerre import LaguerreBasis, pixel_positions
from fdnt_xp.shapes.least_squares import LARGEST_INFLATION, least_squares
from tolerances import tolerance

SIDE = 40
ORDER = 12


def problem(use, seed=0):
    """Return functions, pixels and ivar of two galaxies, the second seen whole."""
    basis = LaguerreBasis(
        order=ORDER,
        eta=np.array([[0.4, -0.3], [-0.2, 0.5]]),
        centroid=np.array([[0.3, -0.8], [1.1, 0.2]]),
        size=np.array([3.0, 2.6]),
    )
    functions = basis.in_x(*pixel_positions(np, np.zeros((1, SIDE, SIDE))))
    pixels = np.random.default_rng(seed).normal(size=(2, SIDE * SIDE))
    return functions, pixels, np.stack([use.ravel(), np.ones(SIDE * SIDE)])


def test_the_solution_is_that_of_lapack(to_xp, to_np):
    use = np.random.default_rng(1).uniform(0.2, 3.0, (SIDE, SIDE))
    functions, pixels, ivar = problem(use)
    fit = least_squares(*map(to_xp, (functions, pixels, ivar)))
    for i in range(2):
        design = (functions[i] * np.sqrt(ivar[i])).T
        expected = np.linalg.lstsq(design, np.sqrt(ivar[i]) * pixels[i])[0]
        np.testing.assert_allclose(to_np(fit.coefficients)[i], expected, atol=1e-11)
        covariance = np.linalg.inv(design.T @ design)
        np.testing.assert_allclose(to_np(fit.covariance)[i], covariance, atol=1e-11)
    np.testing.assert_array_equal(to_np(fit.n_pixels), [SIDE * SIDE] * 2)


def test_units_of_the_noise_scale_the_covariance_alone(xp, dtype, to_xp):
    functions, pixels, ivar = problem(np.ones((SIDE, SIDE)))
    one = least_squares(*(to_xp(a, dtype) for a in (functions, pixels, ivar)))
    other = least_squares(*(to_xp(a, dtype) for a in (functions, pixels, 1e-14 * ivar)))
    tol = {**tolerance("laguerre fit", dtype), "xp": xp}
    assert_close(other.coefficients, one.coefficients, **tol)
    assert_close(1e-14 * other.covariance, one.covariance, **tol)
    assert_close(other.inflation, one.inflation, rtol=1e-5, xp=xp)


def test_a_missing_pixel_is_not_looked_at(dtype, to_xp, to_np):
    functions, pixels, ivar = problem(np.ones((SIDE, SIDE)))
    ivar[0, 77] = 0.0
    expected = least_squares(*(to_xp(a, dtype) for a in (functions, pixels, ivar)))
    pixels[0, 77] = np.nan
    fit = least_squares(*(to_xp(a, dtype) for a in (functions, pixels, ivar)))
    np.testing.assert_array_equal(to_np(fit.coefficients), to_np(expected.coefficients))
    assert to_np(fit.n_pixels).tolist() == [SIDE * SIDE - 1, SIDE * SIDE]


@pytest.mark.parametrize("pattern", ["one pixel", "row", "two rows", "tiny patch", "none"])
def test_no_pattern_of_pixels_makes_the_batch_raise(pattern, dtype, to_xp, to_np):
    use = np.zeros((SIDE, SIDE))
    rows, columns = {
        "one pixel": (slice(20, 21), slice(20, 21)),
        "row": (slice(20, 21), slice(None)),
        "two rows": (slice(5, 7), slice(None)),
        "tiny patch": (slice(14, 24), slice(14, 24)),
        "none": (slice(0), slice(0)),
    }[pattern]
    use[rows, columns] = 1.0
    fit = least_squares(*(to_xp(a, dtype) for a in problem(use)))
    assert to_np(fit.inflation)[0] > LARGEST_INFLATION
    assert to_np(fit.inflation)[1] < 1.5
    assert np.all(np.isfinite(to_np(fit.coefficients)))
    assert np.all(np.isfinite(to_np(fit.covariance)))
