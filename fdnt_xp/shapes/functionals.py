"""The null tests at a solution, as linear functionals of the image: what noise does to them.

At fixed weight a test is a sum over the modes of the deconvolved galaxy, moved to the
origin, `t = sum_k Re[h(k) I~(k)]`. The same h acts on whatever I~ was made from, on the
pixels by the transform of h and on the coefficients of a fit by the transforms of their
functions; the covariance follows from theirs, be it as uneven as it likes (docs,
"Gauss-Laguerre fits").
"""

from __future__ import annotations

from fdnt_xp.arrays import Array, array_namespace, blocks_in_cache, device_of
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.fourier.noise import PixelNoise
from fdnt_xp.fourier.transform import complex_like, mode_phase
from fdnt_xp.nulltests.forms import sheared_forms
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.nulltests.values import TestNoise
from fdnt_xp.shapes.laguerre import LaguerreBasis, degrees

N_FUNCTIONALS = 5
"""t1, t2, tx, ty and the flux."""


def null_test_functionals(tests: NullTests, eta: Array, noise: TestNoise) -> Array:
    """Return h of `(t1, t2, tx, ty, flux)`, shape (n_gal, 5, n_k), complex.

    The tests follow the size of the weight, which the image moves by
    `by_ln_square d ln<|k'|²>`; the flux is that at fixed weight.

    Parameters
    ----------
    tests : NullTests
    eta : array, shape (n_gal, 2)
        The solution.
    noise : TestNoise
        Of the tests at the solution.
    """
    xp = array_namespace(eta=eta)
    grid, matched = tests.grid, noise.matched
    squares = grid.fold * grid.squares
    forms = sheared_forms(eta, tests.weight.frame).forms
    square, plus, cross = (xp.matmul(form, squares) for form in forms)
    plain = square / grid.fold
    plain = xp.maximum(plain, xp.zeros_like(plain))
    shrink = xp.exp(0.5 * xp.sqrt(eta[:, 0] ** 2 + eta[:, 1] ** 2))
    psf_factor, _ = tests.weight.psf_factor(plain, shrink)
    gauss = xp.exp(plain * (-0.5 * matched.width)[:, None])
    weight = psf_factor * gauss

    # d ln<k'²> = sum 𝒯 dRe I~ (q/Q - 1/F).
    ln_square = psf_factor * (
        square * _inverse(matched.square)[:, None] - grid.fold * _inverse(matched.flux)[:, None]
    )
    response = noise.tests.by_width[:, :4] * matched.by_ln_square[:, None]
    follow = response[:, :, None] * ln_square[:, None, :]
    even = xp.stack([weight * plus, weight * cross], axis=1)
    odd = xp.stack([weight * (grid.fold * k) for k in (grid.kx, grid.ky)], axis=1)
    flux = weight * grid.fold
    flux = flux / xp.sum(flux * gauss, axis=-1)[:, None]
    re = xp.concat([even + follow[:, :2, :], follow[:, 2:, :], flux[:, None, :]], axis=1)
    im = xp.concat([xp.zeros_like(even), odd, xp.zeros_like(flux[:, None, :])], axis=1)
    # Re[(u - iv)(Re + i Im)] = u Re + v Im.
    return complex_like(re) - 1j * complex_like(im)


def on_image(h: Array, centroid: Array, inverse_transfer: Array, grid: KGrid) -> Array:
    """Return the functionals of the transform of the observed image, about its own centre."""
    return h * (inverse_transfer * mode_phase(grid, centroid))[:, None, :]


def on_pixels(h: Array, grid: KGrid, stamp_shape: tuple[int, int]) -> Array:
    """Return the functionals of the pixels, `t = sum_x B(x) I(x)`.

    Parameters
    ----------
    h : array, shape (n_gal, n, n_k), complex
        Of the transform of the observed image.
    grid : KGrid
    stamp_shape : tuple of int
        (ny, nx); the grid's is that, or larger.

    Returns
    -------
    array, shape (n_gal, n, ny nx)
    """
    xp = array_namespace(h=h)
    n_gal, n = int(h.shape[0]), int(h.shape[1])
    ny, nx = stamp_shape
    middle = xp.asarray(
        [[-0.5 * (nx - 1), -0.5 * (ny - 1)]], dtype=grid.kx.dtype, device=device_of(grid.kx)
    )
    h = xp.conj(h / mode_phase(grid, middle)[:, None, :])
    # Into the whole plane, 0 where the grid has no mode: `Re sum_k h* exp(i k.x)`.
    row, column = grid.row_and_column
    n_column = grid.shape[1] // 2 + 1
    every = xp.arange(grid.n_half_plane, dtype=xp.int64, device=device_of(grid.kx))
    place = grid.number_of(every)
    place = xp.minimum(place, xp.full_like(place, grid.n_k - 1))
    there = xp.take(row * n_column + column, place) == every
    half = xp.where(there, xp.take(h, place, axis=2), xp.zeros_like(h[:, :, :1]))
    half = xp.reshape(half, (n_gal, n, grid.shape[0], n_column))
    rest = xp.zeros_like(half[:, :, :, : grid.shape[1] - n_column])
    plane = xp.concat([half, rest], axis=-1)
    image = xp.real(xp.fft.ifftn(plane, axes=(-2, -1))) * float(grid.shape[0] * grid.shape[1])
    return xp.reshape(image[:, :, :ny, :nx], (n_gal, n, ny * nx))


def correlated_covariance(b: Array, noise: PixelNoise, stamp_shape: tuple[int, int]) -> Array:
    """Return `sum B_j(x) C(x - x') B_k(x')`, shape (n_gal, n, n), for noise of unit variance.

    Parameters
    ----------
    b : array, shape (n_gal, n, ny nx)
        Functionals of the pixels.
    noise : PixelNoise
        With a correlation function C.
    stamp_shape : tuple of int
        (ny, nx).
    """
    xp = array_namespace(b=b)
    n_gal, n, _ = b.shape
    ny, nx = stamp_shape
    padded = (2 * ny, 2 * nx)  # nothing comes in again on the other side
    correlation = xp.fft.rfftn(noise.correlation, s=padded, axes=(-2, -1))[:, None, :, :]
    spectrum = xp.fft.rfftn(xp.reshape(b, (n_gal, n, ny, nx)), s=padded, axes=(-2, -1))
    smooth = xp.fft.irfftn(spectrum * correlation, s=padded, axes=(-2, -1))
    # No lag is at the middle of C.
    first_y, first_x = ny // 2, nx // 2
    smooth = smooth[:, :, first_y : first_y + ny, first_x : first_x + nx]
    return xp.matmul(b, xp.matrix_transpose(xp.reshape(smooth, b.shape)))


def on_coefficients(h: Array, basis: LaguerreBasis, grid: KGrid) -> Array:
    """Return beta of `t_j = sum_l beta_jl b_l`, shape (n_gal, n, n_coef).

    Parameters
    ----------
    h : array, shape (n_gal, n, n_k), complex
        Of the transform of the observed image.
    basis : LaguerreBasis
        Of the fits to it.
    """
    xp = array_namespace(h=h)
    parts = []
    # A few galaxies at a time: their functions then stay in the cache.
    for rows in blocks_in_cache(h[:, 0, :], basis.n_coef):
        some = basis.take(rows)
        shifted = xp.conj(xp.conj(h[rows, :, :]) * mode_phase(grid, some.centroid)[:, None, :])
        functions = xp.matrix_transpose(some.in_k(grid.kx, grid.ky))
        pair = (xp.real(shifted), xp.imag(shifted))
        parts.append([xp.matmul(part, functions) for part in pair])
    re, im = (xp.concat(list(part), axis=0) for part in zip(*parts, strict=True))
    # Re[h (-i)^n phi] is Re h, Im h, -Re h, -Im h times phi.
    signs = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)]
    like = {"dtype": re.dtype, "device": device_of(re)}
    of_re, of_im = (
        xp.asarray([signs[degree % 4][part] for degree in degrees(basis.order)], **like)
        for part in (0, 1)
    )
    return of_re * re + of_im * im


def _inverse(denominator: Array) -> Array:
    """Return 1/x, and 1 where x is 0."""
    xp = array_namespace(denominator=denominator)
    return 1.0 / xp.where(denominator != 0, denominator, xp.ones_like(denominator))
