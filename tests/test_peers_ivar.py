"""Every method with an inverse variance for each pixel: gaps, uneven noise, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close, assert_equal
from test_circular import PROFILES, profile_images

import fdnt_xp as fx
import fdnt_xp.peers  # gives its methods their names
from fdnt_xp.errors import FdntValueError, NamespaceError, ShapeMismatchError
from fdnt_xp.flags import flag_names
from fdnt_xp.peers.circular import CIRCULAR_METHODS
from fdnt_xp.shapes.methods import SHAPE_METHODS, shape_method
from images import PSF_COVARIANCE, galaxies, gaussian_image, star
from tolerances import tolerance

SIDE = 48
E = np.array([[0.0, 0.0], [0.3, 0.1], [-0.2, 0.45]])
CENTRES = np.array([[0.0, 0.0], [0.4, -0.3], [-1.2, 0.7]])
SIGMA = 2e-5
PEERS = ["nb07-8", "gauss-1", "gauss-3", "exponential", "devaucouleurs"]
FITS = [*PEERS, "fdnt-gl", "fdnt-hybrid"]


def gaps(part, n=3, side=SIDE, seed=0):
    """Return which pixels are there."""
    return np.random.default_rng(seed).random((n, side, side)) > part


@pytest.fixture
def psf(to_xp, dtype):
    return fx.Psf.from_image(to_xp(star(), dtype))


def names(result, row):
    return flag_names(int(result.flags[row]))


def same(ours, theirs, xp):
    """Whether two results are one and the same, NaN for NaN."""
    for name, column in ours.columns().items():
        assert_equal(column, getattr(theirs, name), xp=xp)


# --- gaps and uneven noise -------------------------------------------------------------


def test_every_method_that_has_a_name_is_looked_at():
    assert set(PEERS) <= set(SHAPE_METHODS)
    assert set(CIRCULAR_METHODS) <= set(SHAPE_METHODS)


@pytest.mark.parametrize("method", SHAPE_METHODS)
def test_even_ivar_is_white_noise(method, to_xp, xp):
    stamps = to_xp(galaxies(E, centres=CENTRES))
    psf = fx.Psf.from_image(to_xp(star()))
    ivar = to_xp(np.full((3, SIDE, SIDE), SIGMA**-2))
    white = shape_method(method)(stamps, psf, noise_variance=SIGMA**2)
    even = shape_method(method)(stamps, psf, ivar=ivar)
    assert bool(xp.all(even.measured))
    assert_close(even.eta, white.eta, rtol=0, atol=1e-8, xp=xp)
    assert_close(even.snr, white.snr, rtol=1e-6, xp=xp)
    scale = float(xp.max(xp.abs(white.eta_cov)))
    assert_close(even.eta_cov, white.eta_cov, rtol=0, atol=1e-4 * scale, xp=xp)
    assert_equal(even.masked_fraction, xp.zeros_like(white.size), xp=xp)


@pytest.mark.parametrize("method", FITS)
def test_missing_pixels_are_not_looked_at(method, psf, dtype, to_xp, xp, to_np):
    there = gaps(0.05)
    clean = galaxies(E, centres=CENTRES)
    ivar = to_xp(there / SIGMA**2, dtype)
    by_value = [
        shape_method(method)(to_xp(np.where(there, clean, value), dtype), psf, ivar=ivar)
        for value in (np.nan, 1e9, 0.0)
    ]
    for other in by_value[1:]:
        same(by_value[0], other, xp)
    assert bool(xp.all(by_value[0].measured))
    missing = 1.0 - there.mean(axis=(1, 2))
    np.testing.assert_allclose(to_np(by_value[0].masked_fraction), missing, rtol=1e-5)


@pytest.mark.parametrize("part", [0.05, 0.3])
@pytest.mark.parametrize("method", ["gauss-1", "exponential", "devaucouleurs"])
def test_the_right_law_is_right_whatever_is_missing(method, part, psf, dtype, xp, to_xp):
    eta = np.array([[0.0, 0.0], [0.4, -0.3], [-0.7, 0.2]])
    law = PROFILES["gaussian" if method == "gauss-1" else method]
    images = profile_images(law, 3.0, eta, CENTRES).reshape(3, SIDE, SIDE)
    there = gaps(part)
    there[1, SIDE // 2 :, SIDE // 2 :] = False
    stamps = to_xp(np.where(there, images, np.nan), dtype)
    shapes = shape_method(method)(stamps, psf, padding=2, ivar=to_xp(1.0 * there, dtype))
    assert_close(shapes.eta, to_xp(eta, dtype), **tolerance("fitted laws", dtype), xp=xp)


def test_nb07_with_gaps_is_as_good_as_without(psf, dtype, xp, to_xp):
    stamps = to_xp(galaxies(E, centres=CENTRES), dtype)
    shapes = shape_method("nb07-12")(stamps, psf, ivar=to_xp(1.0 * gaps(0.05), dtype))
    assert_close(shapes.e, to_xp(E, dtype), **tolerance("nb07 order 12", dtype), xp=xp)


@pytest.mark.parametrize(
    ("method", "rtol"), [("gauss-1", 1e-4), ("exponential", 1e-4), ("nb07-8", 5e-2)]
)
def test_errors_are_derivatives(method, rtol):
    # Cov(eta) = sum_x (d eta/dI)²/ivar, pixel by pixel; the law need not be right. NB07's leaves
    # out that its functions move against the residual.
    side = 20
    stamp = galaxies(np.array([[0.25, -0.2]]), (side, side), sigma=1.6)[0]
    psf = fx.Psf.from_image(gaussian_image(0.5 * PSF_COVARIANCE, (side, side)))
    rng = np.random.default_rng(3)
    ivar = rng.uniform(0.5, 3.0, (side, side)) * gaps(0.05, 1, side)[0] / SIGMA**2
    there = np.argwhere(ivar > 0)
    step = 1e-3 * stamp.max()
    moved = np.repeat(stamp[None], 2 * len(there) + 1, axis=0)
    for i, (row, column) in enumerate(there):
        moved[2 * i, row, column] += step
        moved[2 * i + 1, row, column] -= step
    shapes = shape_method(method)(moved, psf, ivar=np.repeat(ivar[None], len(moved), axis=0))
    assert np.all(shapes.measured)
    slope = (shapes.eta[:-1:2] - shapes.eta[1::2]) / (2.0 * step)
    variance = 1.0 / ivar[there[:, 0], there[:, 1]]
    expected = np.einsum("xi,xj,x->ij", slope, slope, variance)
    error = np.abs(shapes.eta_cov[-1] - expected) / np.max(np.abs(expected))
    assert np.max(error) < rtol


@pytest.mark.parametrize(("method", "n"), [("gauss-1", 400), ("nb07-8", 160)])
def test_errors_are_those_of_the_scatter(method, n):
    # S/N 200; the scatter of n fits is known to 1/sqrt(2 n), twice that is let pass and more.
    rng = np.random.default_rng(3)
    clean = galaxies(np.tile([[0.3, -0.2]], (n, 1)), (32, 32), sigma=2.0)
    sigma = np.sqrt(np.sum(clean[0] ** 2)) / 200.0
    noisy = clean + sigma * rng.standard_normal(clean.shape)
    there = np.repeat(gaps(0.05, 1, 32), n, axis=0)
    noisy = np.where(there, noisy, np.nan)
    psf = fx.Psf.from_image(star())
    shapes = shape_method(method)(noisy, psf, ivar=there / sigma**2)
    assert np.all(shapes.measured)
    scatter = np.sqrt(np.cov(shapes.eta.T).diagonal())
    reported = np.sqrt(np.mean(shapes.eta_cov, axis=0).diagonal())
    np.testing.assert_allclose(reported, scatter, rtol=3.0 / np.sqrt(2.0 * n))


# --- bad galaxies and bad calls --------------------------------------------------------


@pytest.mark.parametrize("method", FITS)
def test_bad_ivar_is_flagged_and_changes_nobody(method, psf, dtype, to_xp, xp):
    stamps = np.repeat(galaxies(E[1:2]), 6, axis=0)
    ivar = np.full(stamps.shape, SIGMA**-2)
    ivar[1] = 0.0
    ivar[2, 20, 20], ivar[3, 20, 20], ivar[4, 20, 20] = -1.0, np.nan, np.inf
    ivar[5] = 0.0
    ivar[5, 22:24, 22:25] = SIGMA**-2
    shapes = shape_method(method)(to_xp(stamps, dtype), psf, ivar=to_xp(ivar, dtype))
    assert names(shapes, 0) == []
    assert names(shapes, 1) == ["MASKED"]
    assert [names(shapes, i) for i in (2, 3, 4)] == [["NON_FINITE_PIXEL"]] * 3
    assert [bool(m) for m in shapes.measured] == [True] + [False] * 5
    assert bool(xp.all(xp.isnan(shapes.eta[1:, :])))
    assert float(shapes.masked_fraction[1]) == 1.0
    one = slice(0, 1)
    alone = shape_method(method)(to_xp(stamps[one], dtype), psf, ivar=to_xp(ivar[one], dtype))
    limits = tolerance("nb07 batch" if method == "nb07-8" else "fitted shapes", dtype)
    assert_close(shapes.eta[one, :], alone.eta, **limits, xp=xp)


@pytest.mark.parametrize("method", ["nb07-8", "nb07-12"])
def test_what_the_functions_cannot_bridge_is_flagged(method):
    stamps = np.repeat(galaxies(E[1:2], (64, 64), sigma=3.0), 4, axis=0)
    there = np.ones(stamps.shape)
    middle = 32
    there[0, middle:, middle:] = 0.0
    there[1, :, middle + 6 :] = 0.0
    y, x = np.indices((64, 64)) - middle
    there[2] = np.hypot(x, y) > 4.0
    there[3, :, middle + 1] = 0.0
    shapes = shape_method(method)(stamps, fx.Psf.from_image(star()), ivar=there)
    assert [bool(m) for m in shapes.measured] == [False, False, False, True]
    assert names(shapes, 0) == ["SINGULAR"]


def test_weights_that_are_low_everywhere_but_once_are_no_gap():
    stamps = galaxies(E[1:2])
    ivar = np.ones(stamps.shape)
    ivar[0, 3, 3] = 1e4
    shapes = shape_method("nb07-8")(stamps, fx.Psf.from_image(star()), ivar=ivar)
    assert names(shapes, 0) == []


@pytest.mark.parametrize("method", SHAPE_METHODS)
def test_calls_that_mean_nothing_are_refused(method):
    stamps, psf = galaxies(E), fx.Psf.from_image(star())
    ivar = np.ones(stamps.shape)
    for options, error, match in (
        ({"noise_variance": 1.0, "ivar": ivar}, FdntValueError, "both"),
        ({"ivar": ivar[0]}, ShapeMismatchError, "ivar must have the shape"),
        ({"ivar": ivar.astype(np.float32)}, NamespaceError, "ivar has dtype"),
    ):
        with pytest.raises(error, match=match):
            shape_method(method)(stamps, psf, **options)
