"""The Gauss-Laguerre basis of each object: its own centre, shape and size.

The basis is right where the object looks centred, round and of the basis' size in it:
`b10 = b20 = b11 = 0`, null tests again, but of the image as it is observed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.arrays import Array, array_namespace, blocks_in_cache, device_of
from fdnt_xp.nulltests.dogleg import DoglegOptions, RootResult, find_root
from fdnt_xp.nulltests.scaled import inverse_if_positive
from fdnt_xp.shapes.laguerre import LaguerreBasis, generators, pixel_positions, position
from fdnt_xp.shapes.least_squares import LARGEST_INFLATION, LinearFit, least_squares

_RESPONSE_ORDER: Final = 4
"""What moves coefficients of order 2 is of order 4 at most."""
_MATCHING_ORDER: Final = 6
"""The matched basis hardly depends on the order of the fit that finds it, the cost very much."""
_WINDOW: Final = 0.08
"""Size of the window of the first moments, in sides of the stamp."""
_SMALLEST: Final = 0.3
"""Least size of a basis, pixels: narrower functions fall between the pixels."""
_LARGEST: Final = 0.5
"""Largest size, in sides of the stamp."""
_MOST_ELLIPTICAL: Final = 4.0
_TESTS: Final = (
    position(1, 0),
    position(1, 0, sine=True),
    position(2, 0),
    position(2, 0, sine=True),
    position(1, 1),
)


@dataclass(frozen=True, kw_only=True)
class BasisTests:
    """The null tests of the basis: a `RootProblem` in `(x0/L, y0/L, eta1, eta2, ln sigma)`.

    They are `b10`, `b20` and `b11` over `b00`. Moving the basis changes the coefficients by
    the generators of `laguerre`: exact for a complete basis over the whole plane, close
    enough to Newton's method for others.

    Parameters
    ----------
    stamps, ivar : array, shape (n_gal, ny, nx)
    start : LaguerreBasis
        Its sizes are L. The origin of (x0, y0) is that of its centroids.
    """

    stamps: Array
    ivar: Array
    start: LaguerreBasis

    def take(self, rows: Array) -> BasisTests:
        """Return the tests of the given galaxies (integer array)."""
        xp = array_namespace(rows=rows)
        return BasisTests(
            stamps=xp.take(self.stamps, rows, axis=0),
            ivar=xp.take(self.ivar, rows, axis=0),
            start=self.start.take(rows),
        )

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """Return the tests, shape (n_gal, 5), and their Jacobian, (n_gal, 5, 5).

        NaN where the fit is degenerate, b00 not positive, or the basis absurd.
        """
        xp = array_namespace(x=x)
        basis = basis_at(x, self.start)
        basis, sane = screened_basis(basis, min(self.stamps.shape[1:]))
        fit = fit_pixels(basis, self.stamps, self.ivar)
        b00 = fit.coefficients[:, 0]
        sane = sane & (fit.inflation < LARGEST_INFLATION)
        inverse = inverse_if_positive(xp.where(sane, b00, -xp.ones_like(b00)))[:, None]
        f = xp.stack([fit.coefficients[:, j] for j in _TESTS], axis=-1) * inverse
        slopes = xp.matmul(basis.moves(self.start.size), _responses(fit))
        jac = (slopes[:, :, 1:] - slopes[:, :, :1] * f[:, None, :]) * inverse[:, :, None]
        return f, xp.matrix_transpose(jac)


def match_basis(start: LaguerreBasis, stamps: Array, ivar: Array, max_iter: int) -> RootResult:
    """Solve the null tests of the basis, all galaxies at once; x as in `BasisTests`."""
    xp = array_namespace(stamps=stamps)
    nan = xp.full_like(start.size, float("nan"))
    start = replace(start, size=xp.where(start.size > 0, start.size, nan))
    length = start.size[:, None]
    x0 = xp.concat([start.centroid / length, start.eta, xp.log(length)], axis=-1)
    order = max(_RESPONSE_ORDER, min(start.order, _MATCHING_ORDER))
    start = replace(start, order=order)
    options = DoglegOptions(
        ftol=float(xp.finfo(stamps.dtype).eps) ** 0.5, max_iter=max_iter, max_radius=2.0
    )
    return find_root(BasisTests(stamps=stamps, ivar=ivar, start=start), x0, options=options)


def starting_moments(stamps: Array, ivar: Array) -> tuple[Array, Array]:
    """Return a first centroid from the centre of the stamp, (n_gal, 2), and size, (n_gal,).

    Moments under a Gaussian window that follows the centroid, corrected for the window as
    for a Gaussian galaxy; missing pixels count 0. They are for starts, not for results.
    """
    xp = array_namespace(stamps=stamps, ivar=ivar)
    n_gal, ny, nx = (int(n) for n in stamps.shape)
    x, y = pixel_positions(xp, stamps)
    image = xp.reshape(xp.where(ivar > 0, stamps, xp.zeros_like(stamps)), (n_gal, ny * nx))
    square = (_WINDOW * min(ny, nx)) ** 2
    zero = xp.zeros_like(image[:, 0])
    x0, y0, size = zero, zero, xp.full_like(zero, 0.5 * square**0.5)
    for _ in range(4):
        dx, dy = x[None, :] - x0[:, None], y[None, :] - y0[:, None]
        weighted = image * xp.exp((dx * dx + dy * dy) * (-0.5 / square))
        flux, mean_x, mean_y, second = (
            xp.sum(weighted * f, axis=-1)
            for f in (xp.ones_like(dx), dx, dy, 0.5 * (dx * dx + dy * dy))
        )
        seen = flux > 0
        flux = xp.where(seen, flux, xp.ones_like(flux))
        mean_x, mean_y = mean_x / flux, mean_y / flux
        width = second / flux - 0.5 * (mean_x * mean_x + mean_y * mean_y)
        least, most = xp.ones_like(width), xp.full_like(width, 0.8 * square)
        width = xp.minimum(xp.maximum(width, least), xp.maximum(least, most))
        # A Gaussian of variance v under the window has 1/width = 1/v + 1/square.
        gain = 1.0 / xp.maximum(1.0 - width / square, xp.full_like(width, 0.2))
        near = (xp.abs(x0 + gain * mean_x) < 0.5 * nx) & (xp.abs(y0 + gain * mean_y) < 0.5 * ny)
        x0 = xp.where(seen & near, x0 + gain * mean_x, x0)
        y0 = xp.where(seen & near, y0 + gain * mean_y, y0)
        size = xp.where(seen, xp.sqrt(gain * width), size)
    return xp.stack([x0, y0], axis=-1), size


def fit_pixels(basis: LaguerreBasis, stamps: Array, ivar: Array) -> LinearFit:
    """Fit the functions of the bases to the pixels, a few galaxies at a time."""
    xp = array_namespace(stamps=stamps)
    n_gal, ny, nx = stamps.shape
    x, y = pixel_positions(xp, stamps)
    stamps, ivar = (xp.reshape(pixels, (n_gal, ny * nx)) for pixels in (stamps, ivar))
    fits = [
        least_squares(basis.take(rows).in_x(x, y), stamps[rows, :], ivar[rows, :])
        for rows in blocks_in_cache(stamps, basis.n_coef)
    ]
    return LinearFit.concat(fits)


def basis_at(x: Array, like: LaguerreBasis) -> LaguerreBasis:
    """Return the basis of the unknowns of `BasisTests`."""
    xp = array_namespace(x=x)
    return LaguerreBasis(
        order=like.order,
        eta=x[:, 2:4],
        centroid=like.size[:, None] * x[:, :2],
        size=xp.exp(x[:, 4]),
    )


def screened_basis(basis: LaguerreBasis, side: int) -> tuple[LaguerreBasis, Array]:
    """Return bases that do no harm, unit circles where absurd, and where they are not."""
    xp = array_namespace(size=basis.size)
    sane = xp.sum(basis.eta**2, axis=-1) < _MOST_ELLIPTICAL**2
    sane = sane & xp.all(xp.abs(basis.centroid) < side, axis=-1)
    sane = sane & (basis.size > _SMALLEST) & (basis.size < _LARGEST * side)
    zero = xp.zeros_like(basis.eta)
    safe = LaguerreBasis(
        order=basis.order,
        eta=xp.where(sane[:, None], basis.eta, zero),
        centroid=xp.where(sane[:, None], basis.centroid, zero),
        size=xp.where(sane, basis.size, xp.ones_like(basis.size)),
    )
    return safe, sane


def _responses(fit: LinearFit) -> Array:
    """Return what each generator does to b00 and to the tests, shape (n_gal, 6, 6)."""
    xp = array_namespace(b=fit.coefficients)
    matrix = _test_generators()
    b = fit.coefficients[:, : matrix.shape[0]]
    like = {"dtype": b.dtype, "device": device_of(b)}
    return xp.reshape(xp.matmul(b, xp.asarray(matrix, **like)), (-1, 6, 6))


@lru_cache
def _test_generators() -> NDArray[np.float64]:
    """Return (n_coef, 6 6): coefficients by generator and row, for one matrix product."""
    rows = generators(_RESPONSE_ORDER)[:, [0, *_TESTS], :]
    return np.reshape(rows, (36, -1)).T.copy()
