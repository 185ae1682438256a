"""From pixels to deconvolved modes, against direct sums and Gaussians' analytic transforms."""

from __future__ import annotations

import numpy as np
import pytest
from array_api_extra.testing import assert_close, assert_equal
from hypothesis import given
from hypothesis import strategies as st

from fdnt_xp.fourier.grid import half_plane_disc
from fdnt_xp.fourier.transform import (
    DeconvolvedStamps,
    complex_like,
    deconvolve,
    half_plane_axes,
    mode_phase,
)
from images import gaussian_covariance, gaussian_image
from tolerances import tolerance

KMAX = 2.6
GALAXY = gaussian_covariance((0.3, -0.2), 1.9)
STAR = gaussian_covariance((-0.1, 0.15), 1.5)
CENTRES = np.array([[0.3, -1.2], [0.0, 0.0], [-2.4, 0.7]])

JAX_COMPILES = pytest.mark.skip_backend(
    "jax", reason="compiles anew for each shape; two shapes are run"
)


@pytest.fixture
def make_grid(xp, device):
    """Return `make(shape, dtype, kmax)`."""

    def make(shape, dtype, kmax=KMAX):
        return half_plane_disc(xp, shape, kmax, dtype=dtype, device=device)

    return make


def modes_of(grid, to_np):
    """Return k of the grid's data, shape (n_k, 2), to full precision, from its `index` alone."""
    ny, nx = grid.shape
    row, column = np.divmod(to_np(grid.index), nx // 2 + 1)
    row = np.where(row > ny // 2, row - ny, row)
    return 2.0 * np.pi * np.stack([column / nx, row / ny], axis=-1)


def direct_transform(image, modes):
    """Return `sum I(x) exp(-i k.x)`, x from the middle of the image, mode by mode."""
    ny, nx = image.shape
    y, x = np.mgrid[:ny, :nx] - np.array([0.5 * (ny - 1), 0.5 * (nx - 1)])[:, None, None]
    return np.array([np.sum(image * np.exp(-1j * (kx * x + ky * y))) for kx, ky in modes])


def quadratic(modes, covariance):
    return np.einsum("ki,ij,kj->k", modes, covariance, modes)


def no_psf(grid, xp):
    """Return the inverse transfer function of a PSF that is a point."""
    return complex_like(xp.ones_like(grid.kx))[None, :]


# --- the transform -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stamp", "shape"),
    [
        ((7, 10), (7, 10)),
        pytest.param((10, 7), (10, 7), marks=JAX_COMPILES),
        pytest.param((8, 8), (8, 8), marks=JAX_COMPILES),
        ((7, 10), (13, 20)),
    ],
    ids=["odd x even", "even x odd", "even", "padded"],
)
def test_transform_is_the_direct_sum_about_the_middle(
    stamp, shape, xp, dtype, make_grid, to_xp, to_np
):
    images = np.random.default_rng(1).uniform(size=(2, *stamp))
    images /= np.sum(images, axis=(1, 2), keepdims=True)
    grid = make_grid(shape, dtype)
    actual = deconvolve(to_xp(images, dtype), no_psf(grid, xp), grid)
    expected = np.array([direct_transform(image, modes_of(grid, to_np)) for image in images])
    tol = tolerance("sums", dtype)
    assert_close(actual.re, to_xp(expected.real, dtype), **tol, xp=xp)
    assert_close(actual.im, to_xp(expected.imag, dtype), **tol, xp=xp)


def test_it_divides_by_the_transfer_function(xp, dtype, make_grid, to_xp, to_np):
    # One PSF for all, or one for each: a product of complex numbers, mode by mode.
    images = np.random.default_rng(2).uniform(size=(2, 7, 10)) / 70.0
    grid = make_grid((7, 10), dtype)
    plain = deconvolve(to_xp(images, dtype), no_psf(grid, xp), grid)
    plain = to_np(plain.re) + 1j * to_np(plain.im)
    inverse = np.random.default_rng(3).normal(size=(2, grid.n_k, 2)) @ [1.0, 1j]
    kind = "complex64" if dtype == xp.float32 else "complex128"
    for given_ in (inverse, inverse[:1]):
        actual = deconvolve(to_xp(images, dtype), to_xp(given_, kind), grid)
        expected = plain * given_
        assert_close(actual.re, to_xp(expected.real, dtype), **tolerance("algebra", dtype), xp=xp)
        assert_close(actual.im, to_xp(expected.imag, dtype), **tolerance("algebra", dtype), xp=xp)


def test_a_shifted_convolved_gaussian(xp, dtype, make_grid, to_xp, to_np):
    # Drawn with the PSF, divided by its T, analytic: F exp(-k.C.k/2) exp(-i k.x0) is left.
    flux = np.array([1.0, 3.0, 0.2])
    pairs = zip(flux, map(tuple, CENTRES), strict=True)
    stamps = np.array([gaussian_image(GALAXY + STAR, (36, 39), centre=c, flux=f) for f, c in pairs])
    grid = make_grid((36, 39), dtype, 1.6)
    modes = modes_of(grid, to_np)
    kind = "complex64" if dtype == xp.float32 else "complex128"
    inverse = to_xp(np.exp(0.5 * quadratic(modes, STAR))[None, :], kind)
    galaxies = deconvolve(to_xp(stamps, dtype), inverse, grid)
    round_ = flux[:, None] * np.exp(-0.5 * quadratic(modes, GALAXY))
    expected = round_ * np.exp(-1j * CENTRES @ modes.T)
    tol = tolerance("deconvolved", dtype)
    assert_close(galaxies.re, to_xp(expected.real, dtype), **tol, xp=xp)
    assert_close(galaxies.im, to_xp(expected.imag, dtype), **tol, xp=xp)
    # Moved to the origin they are real.
    re, im = galaxies.shifted(grid, to_xp(CENTRES, dtype))
    assert_close(re, to_xp(round_, dtype), **tol, xp=xp)
    assert_close(im, xp.zeros_like(re), **tol, xp=xp)


# --- moving --------------------------------------------------------------------------


@pytest.mark.parametrize("sheared", [False, True], ids=["plain", "counter-sheared"])
def test_phase_is_that_of_the_modes_of_the_data(sheared, xp, dtype, make_grid, to_xp, to_np):
    grid = make_grid((7, 10), dtype)
    modes = modes_of(grid, to_np)
    if sheared:
        grid = grid.sheared(to_xp([0.4, -0.3], dtype))
    actual = mode_phase(grid, to_xp(CENTRES, dtype))
    expected = np.exp(1j * CENTRES @ modes.T)
    assert xp.isdtype(actual.dtype, "complex floating")
    tol = tolerance("sums", dtype)
    assert_close(xp.real(actual), to_xp(expected.real, dtype), **tol, xp=xp)
    assert_close(xp.imag(actual), to_xp(expected.imag, dtype), **tol, xp=xp)


def test_moving_is_a_complex_phase(xp, dtype, make_grid, to_xp, to_np):
    grid = make_grid((7, 10), dtype)
    data = np.random.default_rng(4).normal(size=(3, grid.n_k, 2)) @ [1.0, 1j]
    galaxies = DeconvolvedStamps(re=to_xp(data.real, dtype), im=to_xp(data.imag, dtype))
    expected = data * np.exp(1j * CENTRES @ modes_of(grid, to_np).T)
    re, im = galaxies.shifted(grid, to_xp(CENTRES, dtype))
    assert_close(re, to_xp(expected.real, dtype), **tolerance("sums", dtype), xp=xp)
    assert_close(im, to_xp(expected.imag, dtype), **tolerance("sums", dtype), xp=xp)


shifts = st.integers(-9, 9)


@given(shifts, shifts)
def test_rolling_pixels_moves_the_centroid(right, up):
    image = np.random.default_rng(5).uniform(size=(1, 7, 10)) / 70.0
    grid = half_plane_disc(np, (7, 10), KMAX, dtype=np.float64, device="cpu")
    rolled = np.roll(image, (up, right), axis=(1, 2))
    there, here = (deconvolve(i, no_psf(grid, np), grid) for i in (rolled, image))
    re, im = there.shifted(grid, np.array([[float(right), float(up)]]))
    np.testing.assert_allclose([re, im], [here.re, here.im], atol=1e-13)


# --- axes, dtypes, batches -----------------------------------------------------------


@pytest.mark.parametrize("shape", [(7, 10), (10, 7)], ids=str)
def test_axes_are_numpys(shape, xp, dtype, make_grid, to_xp):
    kx, ky = half_plane_axes(make_grid(shape, dtype))
    tol = tolerance("algebra", dtype)
    assert_close(kx, to_xp(2.0 * np.pi * np.fft.rfftfreq(shape[1]), dtype), **tol, xp=xp)
    assert_close(ky, to_xp(2.0 * np.pi * np.fft.fftfreq(shape[0]), dtype), **tol, xp=xp)


def test_complex_of_the_same_precision(xp, to_xp):
    for real, its_complex in (("float32", "complex64"), ("float64", "complex128")):
        actual = complex_like(to_xp([1.5, -2.0], real))
        assert_equal(actual, to_xp(np.array([1.5, -2.0], its_complex)), xp=xp)


def test_a_batch_is_its_rows(xp, dtype, make_grid, to_xp):
    stamps = to_xp(np.random.default_rng(6).uniform(size=(3, 7, 10)) / 70.0, dtype)
    grid = make_grid((7, 10), dtype)
    point, centroid = no_psf(grid, xp), to_xp(CENTRES, dtype)
    together = deconvolve(stamps, point, grid)
    moved = together.shifted(grid, centroid)
    for i in range(3):
        alone = deconvolve(stamps[i : i + 1, :, :], point, grid)
        row = together.take(to_xp([i]))
        pairs = [(row.re, alone.re), (row.im, alone.im)]
        pairs += zip(
            (part[i : i + 1, :] for part in moved),
            alone.shifted(grid, centroid[i : i + 1, :]),
            strict=True,
        )
        for actual, expected in pairs:
            assert_close(actual, expected, **tolerance("sums", dtype), xp=xp)


def test_no_stamps_have_no_modes(xp, dtype, make_grid, to_xp):
    grid = make_grid((7, 10), dtype)
    empty = deconvolve(to_xp(np.empty((0, 7, 10)), dtype), no_psf(grid, xp), grid)
    assert empty.re.shape == empty.im.shape == (0, grid.n_k)


def test_moving_nothing_is_allowed(dtype, make_grid, to_xp):
    grid = make_grid((7, 10), dtype)
    nothing = to_xp(np.empty((0, grid.n_k)), dtype)
    moved = DeconvolvedStamps(re=nothing, im=nothing).shifted(grid, to_xp(np.empty((0, 2)), dtype))
    assert [part.shape for part in moved] == [(0, grid.n_k)] * 2


def test_take_reorders_and_repeats(xp, to_xp):
    data = np.arange(12.0).reshape(3, 4)
    taken = DeconvolvedStamps(re=to_xp(data), im=to_xp(-data)).take(to_xp([2, 0, 2]))
    assert_equal(taken.re, to_xp(data[[2, 0, 2]]), xp=xp)
    assert_equal(taken.im, to_xp(-data[[2, 0, 2]]), xp=xp)


def test_nan_stays_in_its_row(xp, dtype, make_grid, to_xp, to_np):
    stamps = np.random.default_rng(7).uniform(size=(3, 7, 10))
    stamps[1, 2, 3] = np.nan
    grid = make_grid((7, 10), dtype)
    re = to_np(deconvolve(to_xp(stamps, dtype), no_psf(grid, xp), grid).re)
    assert np.all(np.isnan(re[1]))
    assert np.all(np.isfinite(re[[0, 2]]))
