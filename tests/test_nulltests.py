"""The null tests, their derivatives and their noise, against plain sums over the whole plane.

The truth is `plain_tests`: NumPy's full FFT, k' = S k by the matrix exponential, and the
formulae of docs/theory.md written down once more, one mode at a time. Derivatives are
finite differences of it, covariances come from the response to each single pixel.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from array_api_extra.testing import assert_close
from scipy.linalg import expm

from fdnt_xp.fourier.grid import half_plane_disc
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.fourier.transform import deconvolve
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.nulltests.weights import make_weight
from images import gaussian_covariance, gaussian_image
from tolerances import tolerance

SHAPE = (30, 33)
LENGTH = 1.3
LARGEST = 4.0
FLOOR = 1e-3
STAR_COVARIANCES = [gaussian_covariance((0.12, -0.1), 1.5), gaussian_covariance((-0.05, 0.1), 1.7)]
GALAXY_COVARIANCE = gaussian_covariance((0.35, 0.2), 1.7)
STARS = [gaussian_image(c, (22, 25)) for c in STAR_COVARIANCES]
CENTRE = (0.6, -0.35)


def stamps():
    """Return a lopsided pair, a galaxy, a point, and a noisy galaxy."""
    rng = np.random.default_rng(1)
    galaxy = gaussian_image(GALAXY_COVARIANCE + STAR_COVARIANCES[0], SHAPE, centre=CENTRE)
    pair = galaxy + 0.3 * gaussian_image(STAR_COVARIANCES[0] + np.eye(2), SHAPE, centre=(2.0, 1.0))
    point = gaussian_image(0.9 * STAR_COVARIANCES[0], SHAPE, centre=(0.1, 0.2))
    noisy = galaxy + 2e-4 * rng.normal(size=SHAPE)
    return np.array([pair, galaxy, point, noisy])


STAMPS = stamps()
X = np.array(
    [[0.3, -0.2, 0.4, -0.1], [0.0, 0.0, 0.2, 0.1], [-0.1, 0.15, 0.0, 0.2], [-0.7, 0.5, 0.5, -0.3]]
)
"""Unknowns `(eta1, eta2, x0/L, y0/L)`: general, round, at the bound of the size, elongated."""
ROWS = ["general", "round", "point", "elongated"]
FIXED = np.array([2.0, 3.0, 1.5, 4.0]) ** 2


# --- the plain sums ------------------------------------------------------------------


class Plain:
    """One galaxy on the whole k plane, in float64.

    `circular(u)` is 𝒯 at |k| = u, and `match(1/<k'²>, s)` solves the size equation; both
    have tests of their own.
    """

    def __init__(self, star, weight):
        ny, nx = SHAPE
        ky, kx = np.meshgrid(np.fft.fftfreq(ny), np.fft.fftfreq(nx), indexing="ij")
        self.k = 2.0 * np.pi * np.stack([kx.ravel(), ky.ravel()])
        star = star / np.sum(star)
        y, x = np.indices(star.shape)
        x, y = x - np.sum(star * x), y - np.sum(star * y)
        waves = np.exp(-1j * (self.k[0][:, None] * x.ravel() + self.k[1][:, None] * y.ravel()))
        transfer = waves @ star.ravel()
        self.inside = np.hypot(*self.k) < weight.kmax[0]
        origin = np.exp(1j * (0.5 * (nx - 1) * self.k[0] + 0.5 * (ny - 1) * self.k[1]))
        self.inverse = np.where(self.inside, origin / transfer, 0.0)
        self.weight = weight

    def transform(self, images):
        """Return I~ of one image or of many, (..., n_k)."""
        return np.fft.fft2(images).reshape(*images.shape[:-2], -1) * self.inverse

    def circular(self, u):
        return self.weight.psf_part.evaluate(u / self.weight.kmax[0])[0]

    def match(self, inverse, shrink):
        shrink = np.broadcast_to(shrink, np.shape(inverse)).ravel()
        width, _, at_bound = self.weight.matched_width(np.ravel(inverse), shrink)
        return width.reshape(np.shape(inverse)), at_bound

    def frame(self, eta):
        """Return k' and q."""
        half = 0.5 * np.array([[eta[0], eta[1]], [eta[1], -eta[0]]])
        k = expm(half) @ self.k
        return k, np.sum(k**2, axis=0)

    def sums(self, data, eta, x0, ln_shrink):
        """Return `sum 𝒯 Re I~` and `sum 𝒯 Re I~ q`."""
        _, q = self.frame(eta)
        factor = self.circular(np.exp(ln_shrink) * np.sqrt(q))
        re = np.real(data * np.exp(1j * (x0 @ self.k)))
        return np.sum(factor * re, axis=-1), np.sum(factor * re * q, axis=-1)

    def width(self, data, eta, x0, ln_shrink, ln_square=0.0):
        """Return the matched width, with <k'²> multiplied by `exp(ln_square)`."""
        flux, square = self.sums(data, eta, x0, ln_shrink)
        return self.match(flux / square * np.exp(-ln_square), np.exp(ln_shrink))[0]

    def tests(self, data, eta, x0, ln_shrink, width):
        """Return (t1, t2, tx, ty, t0), shape (..., 5)."""
        k, q = self.frame(eta)
        moved = data * np.exp(1j * (x0 @ self.k))
        window = self.circular(np.exp(ln_shrink) * np.sqrt(q))
        window = window * np.exp(-0.5 * np.multiply.outer(width, q))
        even = [k[0] ** 2 - k[1] ** 2, 2.0 * k[0] * k[1], q]
        t1, t2, t0 = (np.sum(window * np.real(moved) * f, axis=-1) for f in even)
        tx, ty = (np.sum(window * np.imag(moved) * f, axis=-1) for f in self.k)
        return np.stack([t1, t2, tx, ty, t0], axis=-1)

    def scaled(self, data, x, fixed=None):
        """Return `(t1, t2, tx/L, ty/L)/t0` as a function of the unknowns alone."""
        eta, x0 = x[:2], LENGTH * x[2:]
        ln_shrink = 0.5 * np.hypot(*eta)
        width = self.width(data, eta, x0, ln_shrink) if fixed is None else np.asarray(fixed)
        t = self.tests(data, eta, x0, ln_shrink, width)
        return t[..., :4] / t[..., 4:] / np.array([1.0, 1.0, LENGTH, LENGTH])


def differences(function, point, step=1e-6):
    """Return df/dpoint, the last axis that of the point, by central differences.

    At the cusp of exp(|eta|/2) their error is of the order of the step, not of its square.
    """
    columns = []
    for i in range(len(point)):
        up, down = np.array(point, float), np.array(point, float)
        up[i] += step
        down[i] -= step
        columns.append((function(up) - function(down)) / (2.0 * step))
    return np.stack(columns, axis=-1)


def plain_weight(star):
    return make_weight(Psf.from_image(star, floor=FLOOR), LARGEST)


PLAIN = [Plain(star, plain_weight(star)) for star in STARS]
DATA = [[plain.transform(stamp) for stamp in STAMPS] for plain in PLAIN]


# --- the tests under test ------------------------------------------------------------


@pytest.fixture
def make_tests(xp, dtype, device, to_xp):
    """Return `make(stamps, stars, fixed)`: the null tests, and 1/|T|²."""

    def make(images=STAMPS, stars=STARS[0], fixed=None, floor=FLOOR):
        psf = Psf.from_image(to_xp(stars, dtype), floor=floor)
        grid = half_plane_disc(xp, SHAPE, psf.largest_kmax, dtype=dtype, device=device)
        inverse = psf.inverse_transfer(grid)
        galaxies = deconvolve(to_xp(images, dtype), inverse, grid)
        tests = NullTests(
            grid=grid,
            galaxies=galaxies,
            weight=make_weight(psf, LARGEST),
            length=LENGTH,
            fixed_width=None if fixed is None else to_xp(fixed, dtype),
        )
        return tests, xp.real(inverse) ** 2 + xp.imag(inverse) ** 2

    return make


@pytest.fixture
def close(xp, dtype, to_xp):
    """Return the check of an array against NumPy's, in units of `scale`."""

    def check(actual, expected, quantity, scale=1.0):
        scale = np.broadcast_to(scale, np.shape(expected))
        tol = tolerance(quantity, dtype)
        assert_close(actual / to_xp(scale, dtype), to_xp(expected / scale, dtype), **tol, xp=xp)

    return check


def which_star(stars, row):
    """Return the PSF of a row: all have the first, or they alternate."""
    return 0 if stars == "shared" else row % 2


JAX_COMPILES = pytest.mark.skip_backend(
    "jax", reason="compiles anew for each shape; weights of each galaxy run in test_weights"
)
SHARED_OR_NOT = pytest.mark.parametrize(
    "stars", ["shared", pytest.param("each", marks=JAX_COMPILES)]
)
FREE_OR_FIXED = pytest.mark.parametrize("width", ["free", "fixed"])


@SHARED_OR_NOT
@FREE_OR_FIXED
def test_evaluate(stars, width, dtype, make_tests, to_xp, close):
    fixed = FIXED if width == "fixed" else None
    tests, _ = make_tests(stars=STARS[0] if stars == "shared" else STARS * 2, fixed=fixed)
    f, jac = tests.evaluate(to_xp(X, dtype))
    expected, slopes = [], []
    for row, x in enumerate(X):
        i = which_star(stars, row)
        plain, data = PLAIN[i], DATA[i][row]
        held = None if fixed is None else fixed[row]

        def scaled(x, plain=plain, data=data, held=held):
            return plain.scaled(data, x, held)

        expected.append(scaled(x))
        slopes.append(differences(scaled, x))
    close(f, np.array(expected), "tests")
    # At eta = 0 as well: the cusp of s = exp(|eta|/2) has no direction, and averages out.
    close(jac, np.array(slopes), "test slopes")


@pytest.fixture
def parts(dtype, make_tests, to_xp):
    """The raw tests and the width at X, for one PSF."""
    tests, _ = make_tests()
    return tests.at(to_xp(X[:, :2], dtype), to_xp(LENGTH * X[:, 2:], dtype))


def arguments(row):
    """Return data, (eta, x0) as one vector, ln s and the width of a row."""
    eta, x0 = X[row, :2], LENGTH * X[row, 2:]
    ln_shrink = 0.5 * np.hypot(*eta)
    data = DATA[0][row]
    return data, np.concatenate([eta, x0]), ln_shrink, PLAIN[0].width(data, eta, x0, ln_shrink)


def test_raw_tests_and_their_partial_derivatives(parts, close):
    values, _ = parts
    plain = PLAIN[0]
    for row in range(len(X)):
        data, p, ln_shrink, width = arguments(row)

        def by(p=p, ln_shrink=ln_shrink, width=width, data=data):
            return plain.tests(data, p[:2], p[2:], ln_shrink, width)

        expected = by()
        scale = expected[4]
        here = slice(row, row + 1)
        close(values.values[here, ...], expected[None], "tests", scale)
        slopes = differences(lambda p, by=by: by(p=p), p)
        close(values.by_parameter[here, ...], slopes[None], "test slopes", scale)
        slopes = differences(lambda v, by=by: by(ln_shrink=v[0]), [ln_shrink])[:, 0]
        close(values.by_ln_shrink[here, ...], slopes[None], "test slopes", scale)
        slopes = differences(lambda v, by=by: by(width=v[0]), [width])[:, 0]
        close(values.by_width[here, ...], slopes[None], "test slopes", scale)


def test_the_matched_width_and_its_derivatives(parts, close, to_np):
    _, matched = parts
    plain = PLAIN[0]
    for row in range(len(X)):
        data, p, ln_shrink, width = arguments(row)

        def by(p=p, ln_shrink=ln_shrink, ln_square=0.0, data=data):
            return plain.width(data, p[:2], p[2:], ln_shrink, ln_square)

        here = slice(row, row + 1)
        flux, square = plain.sums(data, p[:2], p[2:], ln_shrink)
        close(matched.width[here], width[None], "tests", width)
        close(matched.flux[here], flux[None], "tests", flux)
        close(matched.square[here], square[None], "tests", square)
        slopes = differences(lambda p, by=by: by(p=p), p)
        close(matched.by_parameter[here, :], slopes[None], "test slopes", width)
        slopes = differences(lambda v, by=by: by(ln_shrink=v[0]), [ln_shrink])
        close(matched.by_ln_shrink[here], slopes, "test slopes", width)
        slopes = differences(lambda v, by=by: by(ln_square=v[0]), [0.0])
        close(matched.by_ln_square[here], slopes, "test slopes", width)
    assert to_np(matched.at_bound).tolist() == [False, False, True, False]


def test_a_given_width_is_not_moved(dtype, make_tests, to_xp, close, to_np):
    tests, _ = make_tests(fixed=FIXED)
    _, matched = tests.at(to_xp(X[:, :2], dtype), to_xp(LENGTH * X[:, 2:], dtype))
    close(matched.width, FIXED, "algebra")
    assert matched.by_parameter.shape == (4, 4)
    for slope in (matched.by_parameter, matched.by_ln_shrink, matched.by_ln_square):
        assert not to_np(slope).any()
    assert not to_np(matched.at_bound).any()


# --- where they vanish ---------------------------------------------------------------


def matrix_sqrt_shear(covariance):
    """Return the shear of a galaxy of this covariance: `C ∝ S_eta²`, |eta| = atanh |e|."""
    trace = covariance[0, 0] + covariance[1, 1]
    e = np.array([covariance[0, 0] - covariance[1, 1], 2.0 * covariance[0, 1]]) / trace
    return np.arctanh(np.hypot(*e)) * e / np.hypot(*e)


def test_they_vanish_at_the_shape_of_a_gaussian(dtype, make_tests, to_xp, to_np):
    eta = matrix_sqrt_shear(GALAXY_COVARIANCE)
    root = np.array([[*eta, *(np.array(CENTRE) / LENGTH)]] * 4)
    tests, _ = make_tests(images=STAMPS[[1, 1, 1, 1]])
    f, _ = tests.evaluate(to_xp(root, dtype))
    np.testing.assert_allclose(to_np(f), 0.0, **tolerance("null", dtype))
    _, matched = tests.at(to_xp(root[:, :2], dtype), to_xp(LENGTH * root[:, 2:], dtype))
    # Its weight has its own size: that of the round galaxy, whose area is the same.
    area = np.sqrt(np.linalg.det(GALAXY_COVARIANCE))
    assert float(to_np(matched.width)[0]) == pytest.approx(area, rel=1e-4)


def test_on_a_sheared_grid_they_vanish_at_the_unlensed_shape(
    xp, dtype, device, make_tests, to_xp, to_np
):
    gamma = np.array([0.06, -0.08])
    lens = expm(0.5 * np.array([[0.06, -0.08], [-0.08, -0.06]]))
    lensed = lens @ GALAXY_COVARIANCE @ lens
    image = gaussian_image(lensed + STAR_COVARIANCES[0], SHAPE, centre=CENTRE)
    # The data must reach beyond the weight.
    tests, _ = make_tests(images=np.array([image] * 4), floor=0.1 * FLOOR)
    shorter = make_weight(Psf.from_image(to_xp(STARS[0], dtype), floor=FLOOR), LARGEST)
    tests = replace(tests, grid=tests.grid.sheared(to_xp(gamma, dtype)), weight=shorter)
    # The centroid is where the galaxy is in the frame without the shear.
    unlensed_centre = np.linalg.solve(lens, CENTRE)
    root = [[*matrix_sqrt_shear(GALAXY_COVARIANCE), *(unlensed_centre / LENGTH)]] * 4
    f, _ = tests.evaluate(to_xp(root, dtype))
    np.testing.assert_allclose(to_np(f), 0.0, **tolerance("null", dtype))


def test_no_galaxy_is_not_a_number(dtype, make_tests, to_xp, to_np):
    # Negative, and empty; the neighbours are not harmed.
    images = np.array([STAMPS[0], -STAMPS[1], 0.0 * STAMPS[2], STAMPS[3]])
    tests, _ = make_tests(images=images)
    clean, _ = make_tests()
    f, jac = (to_np(part) for part in tests.evaluate(to_xp(X, dtype)))
    assert np.all(np.isnan(f[1:3]))
    assert np.all(np.isnan(jac[1:3]))
    ours, theirs = (to_np(part) for part in clean.evaluate(to_xp(X, dtype)))
    np.testing.assert_array_equal(f[[0, 3]], ours[[0, 3]])
    np.testing.assert_array_equal(jac[[0, 3]], theirs[[0, 3]])


def test_a_negative_mean_square_takes_the_widest_weight(dtype, make_tests, to_xp, to_np):
    # A wide galaxy with a hole in its middle: positive at small k, negative at large.
    wide = gaussian_image(9.0 * np.eye(2), SHAPE)
    hole = gaussian_image(STAR_COVARIANCES[0], SHAPE)
    tests, _ = make_tests(images=np.array([wide - 0.25 * hole] * 4))
    zero = to_xp(np.zeros((4, 2)), dtype)
    _, matched = tests.at(zero, zero)
    assert np.all(to_np(matched.square) < 0.0)
    np.testing.assert_allclose(to_np(matched.width), LARGEST**2, rtol=1e-6)
    assert to_np(matched.at_bound).all()
    assert not to_np(matched.by_parameter).any()


# --- batches -------------------------------------------------------------------------


@SHARED_OR_NOT
def test_taken_rows_are_the_rows(stars, xp, dtype, make_tests, to_xp):
    tests, _ = make_tests(stars=STARS[0] if stars == "shared" else STARS * 2, fixed=FIXED)
    rows = to_xp([3, 0, 1, 0])
    together = tests.evaluate(xp.take(to_xp(X, dtype), rows, axis=0))
    taken = tests.take(rows).evaluate(xp.take(to_xp(X, dtype), rows, axis=0))
    whole = tests.evaluate(to_xp(X, dtype))
    for ours, theirs, other in zip(taken, whole, together, strict=True):
        expected = xp.take(theirs, rows, axis=0)
        assert_close(ours, expected, **tolerance("sums", dtype), xp=xp)
        assert bool(xp.any(xp.abs(other - expected) > 1e-3))  # rows do differ


@pytest.mark.skip_backend("jax", reason="compiles anew for each shape; rows are compared above")
def test_a_batch_is_its_rows_and_may_be_empty(xp, dtype, make_tests, to_xp):
    tests, _ = make_tests()
    x = to_xp(X, dtype)
    together = tests.evaluate(x)
    for i in range(4):
        alone = tests.take(to_xp([i])).evaluate(x[i : i + 1, :])
        for ours, theirs in zip(alone, together, strict=True):
            expected = theirs[i : i + 1, ...]
            assert_close(ours, expected, **tolerance("sums", dtype), xp=xp)
    f, jac = tests.take(to_xp(np.empty(0, int))).evaluate(x[:0, :])
    assert (f.shape, jac.shape) == ((0, 4), (0, 4, 4))


# --- noise ---------------------------------------------------------------------------


def pixel_responses(row, fixed):
    """Return d(t1, t2)/dpixel, d(tx, ty)/dpixel, dflux/dpixel and the flux, by differences.

    The width moves with the pixels for (t1, t2), unless it is fixed; it does not for the
    dipole, nor for the flux `sum W Re I~ / sum W exp(-q sigma²/2)`.
    """
    plain = PLAIN[0]
    data, p, ln_shrink, width = arguments(row)
    width = width if fixed is None else fixed
    eta, x0 = p[:2], p[2:]
    n_pixel = STAMPS[row].size
    step = 1e-4 * np.max(STAMPS[row])
    impulses = plain.transform(step * np.eye(n_pixel).reshape(n_pixel, *SHAPE))
    sides = []
    for sign in (1.0, -1.0):
        moved = data + sign * impulses
        still = np.full(n_pixel, width)
        free = plain.width(moved, eta, x0, ln_shrink) if fixed is None else still
        even = plain.tests(moved, eta, x0, ln_shrink, free)[:, :2]
        odd = plain.tests(moved, eta, x0, ln_shrink, still)[:, 2:4]
        sides.append(np.concatenate([even, odd], axis=1))
    _, q = plain.frame(eta)
    gauss = np.exp(-0.5 * q * width)
    window = plain.circular(np.exp(ln_shrink) * np.sqrt(q)) * gauss
    total = np.sum(window * gauss)
    re = np.real(np.concatenate([impulses / step, data[None]]) * np.exp(1j * (x0 @ plain.k)))
    flux = re @ window / total
    return (sides[0] - sides[1]) / (2.0 * step), flux[:-1], flux[-1]


@FREE_OR_FIXED
def test_noise_is_the_response_to_each_pixel(width, dtype, make_tests, to_xp, close):
    # White noise of unit variance is independent pixels; the k grid has as many modes.
    fixed = FIXED if width == "fixed" else None
    tests, inverse_power = make_tests(fixed=fixed)
    eta, x0 = to_xp(X[:, :2], dtype), to_xp(LENGTH * X[:, 2:], dtype)
    noise = tests.noise(eta, x0, inverse_power)
    n_pixel = STAMPS[0].size
    for row in (0, 3):
        responses, by_flux, flux = pixel_responses(row, None if fixed is None else fixed[row])
        covariance = responses.T @ responses / n_pixel
        scale = np.max(np.abs(covariance[:2, :2]))
        here = slice(row, row + 1)
        # Even and odd tests have no noise in common, but by the width.
        cross = covariance[:2, 2:] / np.sqrt(scale * np.max(covariance[2:, 2:]))
        np.testing.assert_allclose(cross, 0.0, atol=1e-6)
        close(noise.even[here, ...], covariance[None, :2, :2], "noise", scale)
        scale = np.max(np.abs(covariance[2:, 2:]))
        close(noise.odd[here, ...], covariance[None, 2:, 2:], "noise", scale)
        close(noise.flux[here], np.array([flux]), "noise", flux)
        variance = np.sum(by_flux**2) / n_pixel
        close(noise.flux_variance[here], np.array([variance]), "noise", variance)


def test_a_free_width_has_noise_of_its_own(dtype, make_tests, to_xp, to_np):
    # Else the test above would not tell one from the other.
    eta, x0 = to_xp(X[:, :2], dtype), to_xp(LENGTH * X[:, 2:], dtype)
    free, inverse_power = make_tests()
    width = to_np(free.at(eta, x0)[1].width)
    held, _ = make_tests(fixed=width)
    ours, theirs = (to_np(t.noise(eta, x0, inverse_power).even) for t in (free, held))
    ratio = (
        np.diagonal(ours - theirs, axis1=1, axis2=2) / np.trace(theirs, axis1=1, axis2=2)[:, None]
    )
    assert np.max(np.abs(ratio[[0, 3]])) > 0.05
    np.testing.assert_allclose(ratio[2], 0.0, atol=1e-6)  # at its bound the width is still


@FREE_OR_FIXED
def test_noise_is_the_scatter_of_noisy_stamps(width):
    n, sigma = 4000, 4e-5
    noise = np.random.default_rng(2).normal(scale=sigma, size=(n, *SHAPE))
    psf = Psf.from_image(STARS[0], floor=FLOOR)
    grid = half_plane_disc(np, SHAPE, psf.largest_kmax, dtype=np.float64, device="cpu")
    inverse = psf.inverse_transfer(grid)
    at = np.broadcast_to(X[3, :2], (n, 2)), np.broadcast_to(LENGTH * X[3, 2:], (n, 2))
    galaxies = deconvolve(STAMPS[1] + noise, inverse, grid)
    tests = NullTests(
        grid=grid,
        galaxies=galaxies,
        weight=make_weight(psf, LARGEST),
        length=LENGTH,
        fixed_width=np.full(n, 9.0) if width == "fixed" else None,
    )
    values, _ = tests.at(*at)
    told = tests.take(np.array([0])).noise(at[0][:1], at[1][:1], np.abs(inverse) ** 2)
    covariance = np.cov(values.values[:, :4].T) / (sigma**2 * STAMPS[0].size)
    for block, expected in ((slice(0, 2), told.even[0]), (slice(2, 4), told.odd[0])):
        # Of n draws a variance is known to sqrt(2/n) = 2.2 %; three of those.
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(covariance[block, block] / scale, expected / scale, atol=0.07)
