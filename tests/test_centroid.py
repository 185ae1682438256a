"""The first centroid: found far from the centre of the stamp, and the derivatives it needs."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close, assert_equal
from scipy.linalg import expm

import fdnt_xp as fx
from fdnt_xp.fourier.grid import half_plane_disc
from fdnt_xp.fourier.transform import complex_like, deconvolve
from fdnt_xp.nulltests.weights import make_weight
from fdnt_xp.shapes.centroid import DipoleTests, starting_centroid, wide_weight
from images import galaxies, gaussian_covariance, gaussian_image, star
from tolerances import tolerance

CENTRES = np.array([[0.0, 0.0], [0.4, -0.7], [-5.0, 6.5], [7.5, 7.0]])
LENGTH = 1.5


def dtype_is_double(dtype):
    return "float64" in str(dtype)


@pytest.fixture
def setting(xp, dtype, device, to_xp):
    """The k grid, four galaxies of different shapes, and the wide weight."""
    psf = fx.Psf.from_image(to_xp(star(), dtype))
    grid = half_plane_disc(xp, (48, 48), psf.largest_kmax, dtype=dtype, device=device)
    e = np.array([[0.0, 0.0], [0.3, 0.1], [-0.5, 0.2], [0.1, 0.6]])
    stamps = to_xp(galaxies(e, centres=CENTRES), dtype)
    weight = make_weight(psf, largest_size=8.0)
    return grid, deconvolve(stamps, psf.inverse_transfer(grid), grid), weight


def test_galaxies_are_found_far_from_the_centre(setting, xp, dtype, to_xp):
    grid, deconvolved, weight = setting
    wide = wide_weight(weight, grid, 48)
    found = starting_centroid(grid, deconvolved, wide, LENGTH, reach=24.0)
    # A start: a few hundredths of a pixel are more than enough.
    assert_close(found, to_xp(CENTRES, dtype), rtol=0, atol=0.1, xp=xp)


def test_beyond_the_reach_the_centre_of_the_stamp_is_kept(setting, xp, dtype, to_xp):
    grid, deconvolved, weight = setting
    wide = wide_weight(weight, grid, 48)
    found = starting_centroid(grid, deconvolved, wide, LENGTH, reach=3.0)
    expected = np.where(np.all(np.abs(CENTRES) <= 3.0, axis=1)[:, None], CENTRES, 0.0)
    assert_close(found, to_xp(expected, dtype), rtol=0, atol=0.1, xp=xp)


def test_derivatives_are_those_of_differences(setting, dtype, to_xp, to_np):
    grid, deconvolved, weight = setting
    wide = wide_weight(weight, grid, 48)
    tests = DipoleTests(grid=grid, galaxies=deconvolved, weight=wide, length=LENGTH)
    x = (CENTRES + np.array([0.5, -0.4])) / LENGTH
    h = 1e-4 if dtype_is_double(dtype) else 3e-2
    _, jac = tests.evaluate(to_xp(x, dtype))
    for j in (0, 1):
        step = h * np.eye(2)[j]
        above, below = (to_np(tests.evaluate(to_xp(x + s, dtype))[0]) for s in (step, -step))
        slope = (above - below) / (2.0 * h)
        atol = 1e-6 if dtype_is_double(dtype) else 2e-3
        np.testing.assert_allclose(to_np(jac)[:, :, j], slope, atol=atol)


def test_rows_can_be_taken(setting, xp, dtype, to_xp):
    grid, deconvolved, weight = setting
    wide = wide_weight(weight, grid, 48)
    tests = DipoleTests(grid=grid, galaxies=deconvolved, weight=wide, length=LENGTH)
    rows = to_xp(np.array([2, 0]))
    part, _ = tests.take(rows).evaluate(to_xp(CENTRES[[2, 0]] / LENGTH, dtype))
    whole, _ = tests.evaluate(to_xp(CENTRES / LENGTH, dtype))
    assert_close(part, xp.take(whole, rows, axis=0), **tolerance("batch", dtype), xp=xp)


def test_where_there_is_no_galaxy_there_is_no_number(setting, dtype, to_xp, to_np):
    grid, deconvolved, weight = setting
    wide = wide_weight(weight, grid, 48)
    negative = type(deconvolved)(re=-deconvolved.re, im=-deconvolved.im)
    tests = DipoleTests(grid=grid, galaxies=negative, weight=wide, length=LENGTH)
    f, jac = tests.evaluate(to_xp(CENTRES / LENGTH, dtype))
    assert np.all(np.isnan(to_np(f)))
    assert np.all(np.isnan(to_np(jac)))


def test_the_wide_weight_is_round_where_it_is_asked_to_be(setting, xp, dtype, to_xp, to_np):
    # On the image, or at S k by the matrix exponential; an eighth of the stamp wide.
    grid, _, weight = setting
    k = np.stack([to_np(grid.kx), to_np(grid.ky)]).astype(float)
    for shear in ((0.0, 0.0), (0.3, -0.2)):
        matrix = expm(0.5 * np.array([[shear[0], shear[1]], [shear[1], -shear[0]]]))
        square = np.sum((matrix @ k) ** 2, axis=0)[None, :]
        shrink = to_xp([np.exp(0.5 * np.hypot(*shear))], dtype)
        factor, _ = weight.psf_factor(to_xp(square, dtype), shrink)
        expected = factor * to_xp(np.exp(-0.5 * 6.0**2 * square), dtype)
        actual = wide_weight(weight, grid, 48, to_xp(shear, dtype) if any(shear) else None)
        assert_close(actual, expected, **tolerance("sums", dtype), xp=xp)


# --- the dipole, against plain sums over the whole plane ------------------------------

SHAPE = (30, 33)
KMAX = 2.0
WIDTHS = {"shared": (6.0,), "each": (4.0, 9.0, 1.0, 6.0)}
PLACES = [(0.7, -1.9), (0.0, 0.0), (-2.3, 0.4), (1.1, 1.2)]
COVARIANCE = gaussian_covariance((0.3, -0.4), 2.0)
STAMPS = np.array([gaussian_image(COVARIANCE, SHAPE, centre=c, flux=3.0) for c in PLACES])
X = np.array([[0.3, -0.2], [0.0, 0.0], [-1.0, 0.5], [0.2, 0.4]])

shared_or_not = pytest.mark.parametrize("widths", WIDTHS.values(), ids=list(WIDTHS))


def plain_dipole(image, x, width):
    """Return `sum W Im I~ k / (L sum W Re I~ |k|²)` over the whole plane."""
    ny, nx = image.shape
    ky, kx = np.meshgrid(np.fft.fftfreq(ny), np.fft.fftfreq(nx), indexing="ij")
    k = 2.0 * np.pi * np.stack([kx.ravel(), ky.ravel()])
    square = np.sum(k**2, axis=0)
    window = np.where(square < KMAX**2, np.exp(-0.5 * width * square), 0.0)
    origin = np.array([0.5 * (nx - 1), 0.5 * (ny - 1)])
    moved = np.fft.fft2(image).ravel() * np.exp(1j * ((origin + LENGTH * np.asarray(x)) @ k))
    return k @ (window * moved.imag) / np.sum(window * moved.real * square) / LENGTH


@pytest.fixture
def make_problem(xp, dtype, device, to_xp):
    """Return `make(stamps, widths)`: the dipole tests behind no PSF."""

    def make(images=STAMPS, widths=WIDTHS["shared"]):
        grid = half_plane_disc(xp, SHAPE, KMAX, dtype=dtype, device=device)
        galaxies = deconvolve(to_xp(images, dtype), complex_like(grid.fold * 0.0 + 1.0), grid)
        square = (grid.kx**2 + grid.ky**2)[None, :]
        weight = xp.exp(-0.5 * square * to_xp(widths, dtype)[:, None])
        return DipoleTests(grid=grid, galaxies=galaxies, weight=weight, length=LENGTH)

    return make


@shared_or_not
def test_dipole_and_its_jacobian(widths, xp, dtype, make_problem, to_xp):
    f, jac = make_problem(widths=widths).evaluate(to_xp(X, dtype))
    expected, slopes = [], []
    for row, x in enumerate(X):
        width = widths[row % len(widths)]
        expected.append(plain_dipole(STAMPS[row], x, width))
        sides = [
            [plain_dipole(STAMPS[row], x + sign * 1e-5 * unit, width) for unit in np.eye(2)]
            for sign in (1.0, -1.0)
        ]
        slopes.append((np.array(sides[0]) - sides[1]).T / 2e-5)
    assert_close(f, to_xp(expected, dtype), **tolerance("tests", dtype), xp=xp)
    assert_close(jac, to_xp(slopes, dtype), **tolerance("test slopes", dtype), xp=xp)


def test_nan_stays_in_its_row(dtype, make_problem, to_xp, to_np):
    images = np.array([STAMPS[0], -STAMPS[1], 0.0 * STAMPS[2], STAMPS[3]])
    f, jac = (to_np(part) for part in make_problem(images).evaluate(to_xp(X, dtype)))
    clean, clean_jac = (to_np(part) for part in make_problem().evaluate(to_xp(X, dtype)))
    assert np.all(np.isnan(f[1:3]))
    assert np.all(np.isnan(jac[1:3]))
    np.testing.assert_array_equal(f[[0, 3]], clean[[0, 3]])
    np.testing.assert_array_equal(jac[[0, 3]], clean_jac[[0, 3]])


@shared_or_not
def test_taken_rows_are_the_rows(widths, xp, dtype, make_problem, to_xp):
    problem, x, rows = make_problem(widths=widths), to_xp(X, dtype), to_xp([3, 0, 1, 0])
    taken = problem.take(rows).evaluate(xp.take(x, rows, axis=0))
    for ours, whole in zip(taken, problem.evaluate(x), strict=True):
        assert_close(ours, xp.take(whole, rows, axis=0), **tolerance("sums", dtype), xp=xp)


def test_what_is_not_found_starts_at_the_centre_of_the_stamp(dtype, make_problem, to_xp, to_np):
    # Beyond reach, negative, empty; the fourth as it is alone.
    images = np.array([STAMPS[2], -STAMPS[1], 0.0 * STAMPS[2], STAMPS[0]])
    problem = make_problem(images)
    parts = (problem.grid, problem.galaxies, problem.weight, problem.length)
    found = to_np(starting_centroid(*parts, reach=2.0))
    np.testing.assert_array_equal(found[:3], 0.0)
    # Symmetric galaxies have one centre under any weight; the search stops at 1e-3 in f.
    np.testing.assert_allclose(found[3], PLACES[0], atol=2e-3 * LENGTH)


@pytest.mark.skip_backend("jax", reason="compiles anew for each shape; one batch is run")
def test_a_batch_is_its_rows_and_may_be_empty(xp, dtype, make_problem, to_xp):
    problem = make_problem()

    def start(rows):
        part = problem.take(to_xp(np.array(rows, dtype=np.int64)))
        return starting_centroid(part.grid, part.galaxies, part.weight, LENGTH, reach=8.0)

    together = start(range(4))
    for i in range(4):
        assert_close(start([i]), together[i : i + 1, :], **tolerance("batch", dtype), xp=xp)
    assert_equal(start([]), to_xp(np.empty((0, 2)), dtype), xp=xp)
