"""R1 and R3 against the exact sum of shears, averaged over the angle in 60 digits."""

from __future__ import annotations

import warnings

import mpmath
import numpy as np
import pytest
from array_api_extra.testing import assert_close

from fdnt_xp.errors import (
    FdntTypeError,
    FdntValueError,
    FdntWarning,
    RangeError,
    ShapeMismatchError,
)
from fdnt_xp.shears.responsivity import R1, R3
from fdnt_xp.shears.weights import ShapeWeight, as_shape_weight
from tolerances import tolerance

# On both sides of every switch between a series and a closed formula, and the largest measured.
ABS_ETA = [0.0, 1e-30, 1e-5, 4.9e-4, 5.1e-4, 0.05, 0.4, 0.999, 1.001, 2.0, 4.0]
EXACT_WEIGHTS = {
    "uniform": lambda _: mpmath.mpf(1),
    "gaussian": lambda eta: mpmath.exp(-(eta**2)),
    "lorentzian": lambda eta: 1 / (1 + eta**2),
}


def mean_shape(abs_eta, g, weight):
    """Return the exact `<w eta1>` of galaxies of one |eta| lensed by g along x."""
    # Order n in g has harmonics up to n: 16 angles are exact far beyond the third.
    g0 = mpmath.tanh(mpmath.mpf(abs_eta) / 2)
    total = mpmath.mpf(0)
    for i in range(16):
        z = g0 * mpmath.expjpi(mpmath.mpf(i) / 8 + mpmath.mpf(1) / 7)
        z = (z + g) / (1 + g * z)
        eta = 2 * mpmath.atanh(abs(z))
        total += weight(eta) * eta * z.real / abs(z)
    return total / 16


def exact_coefficients(name):
    """Return R1 and R3 at `ABS_ETA`: half the first and third coefficients in g."""
    weight, h = EXACT_WEIGHTS[name], mpmath.mpf(10) ** -10
    r1, r3 = [], []
    with mpmath.workdps(60):
        for abs_eta in ABS_ETA:
            one, two = (mean_shape(abs_eta, n * h, weight) for n in (1, 2))
            third = (two - 2 * one) / (6 * h**3)
            r3.append(float(third / 2))
            r1.append(float((one / h - third * h**2) / 2))
    return np.array(r1), np.array(r3)


@pytest.fixture(scope="module", params=EXACT_WEIGHTS)
def exact(request):
    return request.param, *exact_coefficients(request.param)


def test_the_exact_average_of_round_galaxies(exact):
    # They all get 2 atanh g = 2 g + 2 g³/3: R1 = w(0), R3 = w(0)/3 + 2 w''(0).
    name, r1, r3 = exact
    assert (r1[0], r3[0]) == pytest.approx((1.0, 1 / 3 + {"uniform": 0}.get(name, -4)), rel=1e-12)


@pytest.mark.parametrize(
    ("g_of_gamma", "off"),
    [
        (lambda x: x, 0.0),
        (lambda x: x / mpmath.sqrt(1 + x**2), -1.0),
        (mpmath.tanh, -2.0 / 3.0),
    ],
    ids=["tanh(delta/2)", "sinh(delta/2)", "delta/2"],
)
def test_which_shear(g_of_gamma, off):
    # docs/theory.md, "Which shear": 2 R3 is the third coefficient in g alone.
    h, weight = mpmath.mpf(10) ** -10, EXACT_WEIGHTS["lorentzian"]
    with mpmath.workdps(60):
        one, two = (mean_shape(0.4, g_of_gamma(n * h), weight) for n in (1, 2))
        third = float((two - 2 * one) / (6 * h**3))
    eta = np.array([0.4])
    r1, r3 = R1(eta, "lorentzian")[0], R3(eta, "lorentzian")[0]
    assert third == pytest.approx(2.0 * r3 + off * r1, rel=1e-12)


def test_responsivities(exact, xp, dtype, to_xp):
    name, r1, r3 = exact
    abs_eta = to_xp(ABS_ETA, dtype)
    tol = {"rtol": 0, "atol": 1e-10 if dtype == xp.float64 else 5e-6}
    assert_close(R1(abs_eta, name), to_xp(r1, dtype), **tol, xp=xp)
    assert_close(R3(abs_eta, name), to_xp(r3, dtype), **tol, xp=xp)


def test_responsivities_without_derivatives(exact, xp, dtype, to_xp):
    name, r1, r3 = exact
    weight = as_shape_weight(as_shape_weight(name).function)
    assert weight.derivatives is None
    abs_eta = to_xp(ABS_ETA, dtype)
    tol = {"rtol": 0, "atol": 1e-10 if dtype == xp.float64 else 5e-6}
    assert_close(R1(abs_eta, weight), to_xp(r1, dtype), **tol, xp=xp)
    assert_close(R3(abs_eta, weight), to_xp(r3, dtype), **tol, xp=xp)


@pytest.mark.parametrize("scale", [0.2, 3.0])
@pytest.mark.parametrize("make", [ShapeWeight.gaussian, ShapeWeight.lorentzian])
def test_named_derivatives_are_the_derivatives(make, scale):
    weight = make(scale)
    bare = ShapeWeight(function=weight.function, scale=scale)
    x = scale * np.linspace(0.0, 4.0, 81)
    given, numerical = weight.expand(x), bare.expand(x)
    for name, power in (("first", 1), ("second", 2), ("third", 3), ("ratio", 2)):
        error = getattr(given, name) - getattr(numerical, name)
        assert np.max(np.abs(error)) * scale**power < 1e-10


def test_a_bisquare_weight_ends():
    weight = ShapeWeight.bisquare(1.5)
    x = np.linspace(0.0, 1.2, 25)  # the stencil must not reach the end, where w'' jumps
    bare = ShapeWeight(function=weight.function, scale=0.5)
    given, numerical = weight.expand(x), bare.expand(x)
    for name in ("first", "second", "third", "ratio"):
        np.testing.assert_allclose(getattr(given, name), getattr(numerical, name), atol=1e-8)
    beyond = weight.expand(np.array([1.5, 2.0]))
    for name in ("value", "first", "second", "third", "ratio"):
        np.testing.assert_array_equal(getattr(beyond, name), 0.0)


def test_ellipticity_gradient(xp, dtype, to_xp):
    # R1 = ½ [(eta w' + w)/(1 - EG) + Y w], with w = exp(-eta²).
    eta, eg = np.array([0.0, 0.3, 0.8, 1.5]), np.array([0.02, -0.08, 0.3, -4.0])
    w, y = np.exp(-(eta**2)), np.append(1.0, eta[1:] / np.tanh(eta[1:]))
    expected = 0.5 * (w * (1.0 - 2.0 * eta**2) / (1.0 - eg) + y * w)
    actual = R1(to_xp(eta, dtype), "gaussian", to_xp(eg, dtype))
    assert_close(actual, to_xp(expected, dtype), **tolerance("algebra", dtype), xp=xp)


def test_no_response_is_nan_and_stays_in_its_row(xp, dtype, to_xp, to_np):
    eg = np.array([0.1, 1.0, 1.5, np.nan, np.inf, -np.inf, -0.2])
    actual = to_np(R1(to_xp(np.full(7, 0.4), dtype), eg=to_xp(eg, dtype)))
    np.testing.assert_array_equal(np.isnan(actual), [0, 1, 1, 1, 1, 1, 0])
    alone = to_np(R1(to_xp([0.4, 0.4], dtype), eg=to_xp(eg[[0, 6]], dtype)))
    np.testing.assert_array_equal(actual[[0, 6]], alone)


def test_empty(xp, to_xp):
    empty = to_xp(np.empty(0))
    for weight in ("gaussian", lambda x: 1.0 / (1.0 + x * x)):
        assert R1(empty, weight).shape == (0,)
        assert R3(empty, weight).shape == (0,)


def test_a_cusp_is_reported():
    eta = np.array([0.0, 0.01, 2.0])
    cusp = ShapeWeight(function=lambda x: np.exp(-x), name="cusp")
    with pytest.warns(FdntWarning, match=r"'cusp' is not smooth on a scale of 1"):
        R3(eta, cusp)
    # So is a scale that is too coarse for the weight.
    narrow = ShapeWeight.gaussian(0.05).function
    with pytest.warns(FdntWarning, match="not smooth"):
        R3(eta, narrow)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        R3(eta, ShapeWeight(function=narrow, scale=0.05))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -0.1])
def test_bad_weights_are_refused(bad):
    with pytest.raises(FdntValueError, match=r"'custom' must be finite and not negative"):
        R1(np.array([0.1, 0.2]), lambda x: np.where(x > 0.15, bad, 1.0))


def test_what_is_no_weight_is_refused():
    eta = np.array([0.1, 0.2])
    with pytest.raises(FdntValueError, match=r"'flat' is unknown; known: uniform, gaussian"):
        R1(eta, "flat")
    with pytest.raises(FdntTypeError, match="not float"):
        R1(eta, 1.0)
    with pytest.raises(FdntTypeError, match="three callables"):
        ShapeWeight(function=np.exp, derivatives=(np.exp,))
    with pytest.raises(FdntValueError, match=r"returned the shape \(\) for \(2,\)"):
        R1(eta, lambda x: np.sum(x))
    for scale in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(RangeError, match="scale"):
            ShapeWeight.gaussian(scale)


def test_shapes_are_checked():
    with pytest.raises(ShapeMismatchError, match="abs_eta"):
        R1(np.zeros((3, 2)))
    with pytest.raises(ShapeMismatchError, match="eg must have"):
        R1(np.zeros(3), eg=np.zeros(2))
