"""Gauss-Laguerre fits to the pixels of each galaxy, missing pixels and all.

stamps, ivar -> start from moments
             -> basis matched to the object: its own null tests, b10 = b20 = b11 = 0
             -> weighted least squares at the full order, with the covariance
             -> flags: the fit itself says whether the pixels carry it

A pixel with ivar = 0 is missing: its value is not looked at, be it NaN.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from types import ModuleType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.arrays import Array, array_namespace, as_floating, device_of, require_dtype
from fdnt_xp.errors import FdntValueError, RangeError, ShapeMismatchError
from fdnt_xp.flags import Flag
from fdnt_xp.nulltests.dogleg import DoglegOptions, RootResult, Status, find_root
from fdnt_xp.nulltests.tests import inverse_if_positive
from fdnt_xp.shapes.job import check_count
from fdnt_xp.shapes.laguerre import (
    LaguerreBasis,
    check_order,
    generators,
    n_coefficients,
    pixel_positions,
    position,
)

LARGEST_INFLATION: Final = 20.0
"""Inflation of a variance beyond which a fit is degenerate. Masks of a tenth of the pixels or a
column through the centre give 1.2, three columns 5, a quadrant cut off at the centre 1e6."""
_RESPONSE_ORDER: Final = 4
"""What moves coefficients of order 2 is of order 4 at most."""
_MATCHING_ORDER: Final = 6
"""The matched basis hardly depends on the order of the fit that finds it, the cost very much."""
_RIDGE: Final = 10.0
"""In eps times the number of coefficients: more than rounding can take off an eigenvalue."""
_REFINEMENTS: Final = 2
_WINDOW: Final = 0.08
"""Size of the window of the first moments, in sides of the stamp."""
_SMALLEST: Final = 0.3
"""Least size of a basis, pixels: narrower functions fall between the pixels."""
_LARGEST: Final = 0.5
"""Largest size, in sides of the stamp."""
_MOST_ELLIPTICAL: Final = 4.0
_BYTES_AT_ONCE: Final = 128e6
_TESTS: Final = (
    position(1, 0),
    position(1, 0, sine=True),
    position(2, 0),
    position(2, 0, sine=True),
    position(1, 1),
)


@dataclass(frozen=True, kw_only=True)
class LaguerreFit:
    """Gauss-Laguerre fits of a batch of galaxies.

    All arrays share one library, dtype and device, that of the stamps; row i is galaxy i.
    Where `flags` is not 0 the floats, those of the basis too, are NaN; `inflation` stays.

    Parameters
    ----------
    basis : LaguerreBasis
        Of each galaxy; its centroids count from the centre of the stamp.
    coefficients : array, shape (n_gal, n_coef)
        Packed as `fdnt_xp.shapes.laguerre` tells, in units of the image times pixel.
    coefficients_cov : array, shape (n_gal, n_coef, n_coef)
        Their covariance at fixed basis, if `ivar` is the inverse variance of the pixels.
    inflation : array, shape (n_gal,)
        Largest `M_jj (M^-1)_jj` of the normal matrix M: how much the variance of a
        coefficient grows because the pixels left cannot tell it from others. 1 where they
        can; infinite where there are fewer pixels than coefficients.
    n_pixels : array, shape (n_gal,), int32
        Pixels that were fitted.
    flags : array, shape (n_gal,), int32
        Bits of `fdnt_xp.flags.Flag`; SINGULAR where the fit is degenerate.
    n_iter, status : array, shape (n_gal,), int32
        Evaluations of the basis' null tests, and how their solution ended, a `Status`; 0
        where the basis was given.
    """

    basis: LaguerreBasis
    coefficients: Array
    coefficients_cov: Array
    inflation: Array
    n_pixels: Array
    flags: Array
    n_iter: Array
    status: Array

    @property
    def usable(self) -> Array:
        """True where the fit holds, shape (n_gal,), bool."""
        return self.flags == 0

    def take(self, rows: Array) -> LaguerreFit:
        """Return the fits of the given galaxies (integer array), in that order."""
        xp = array_namespace(flags=self.flags, rows=rows)
        columns = {name: xp.take(getattr(self, name), rows, axis=0) for name in _COLUMNS}
        return LaguerreFit(basis=self.basis.take(rows), **columns)

    @classmethod
    def concat(cls, parts: Sequence[LaguerreFit]) -> LaguerreFit:
        """Join fits of one order, at least one, in the order given."""
        xp = array_namespace(flags=parts[0].flags)

        def joined(items: Sequence[object], name: str) -> Array:
            return xp.concat([getattr(item, name) for item in items], axis=0)

        bases = [part.basis for part in parts]
        basis = replace(bases[0], **{n: joined(bases, n) for n in ("eta", "centroid", "size")})
        return cls(basis=basis, **{name: joined(parts, name) for name in _COLUMNS})


_COLUMNS: Final = tuple(field.name for field in fields(LaguerreFit) if field.name != "basis")


@dataclass(frozen=True, kw_only=True)
class LinearFit:
    """Weighted least squares of each galaxy; see `LaguerreFit` for `inflation`.

    Parameters
    ----------
    coefficients, covariance, inflation, n_pixels : array
        Shapes (n_gal, n_coef), (n_gal, n_coef, n_coef), (n_gal,), (n_gal,). Finite, and
        without meaning where `inflation` is infinite.
    """

    coefficients: Array
    covariance: Array
    inflation: Array
    n_pixels: Array


def fit_laguerre(
    stamps: Array,
    ivar: Array,
    *,
    order: int = 12,
    eta: Array | None = None,
    centroid: Array | None = None,
    size: Array | None = None,
    matched: bool = True,
    scale: float = 1.0,
    max_iter: int = 40,
    chunk_size: int | None = None,
) -> LaguerreFit:
    """Fit Gauss-Laguerre functions to the image of each galaxy as it is observed.

    Nothing raises for the sake of a galaxy: one that cannot be fitted is NaN, with the
    reason in its flags, and changes nothing for the others.

    Parameters
    ----------
    stamps : array, shape (n_gal, ny, nx)
        Images of one galaxy each, background taken off.
    ivar : array, shape (n_gal, ny, nx)
        Inverse variance of each pixel; 0 where it is missing. A galaxy with a negative or
        infinite one or a NaN is flagged.
    order : int
        Largest p + q: (order + 1)(order + 2)/2 coefficients.
    eta, centroid, size : array, shapes (n_gal, 2), (n_gal, 2) and (n_gal,), optional
        Where to start, or the basis itself if not `matched`: shape, position on the stamp
        (pixels, 0-based), sigma in pixels. By default round, with centroid and size by
        moments under a Gaussian window.
    matched : bool
        Vary the basis until `b10 = b20 = b11 = 0`: the object's own centre, shape and size.
    scale : float
        Fit with a basis this much larger than the matched, or given, one.
    max_iter : int
        Steps of the matching.
    chunk_size : int, optional
        Galaxies that are in work together: it bounds the memory and changes no number
        beyond rounding. By default what fits 128 MB, the result not counted.

    Returns
    -------
    LaguerreFit
        Row i belongs to stamp i; an empty batch gives an empty result.

    Raises
    ------
    RangeError, FdntValueError
        If a number is out of range, or there are more coefficients than pixels in a stamp.
    ShapeMismatchError, NamespaceError, FdntTypeError
        If the arrays do not fit each other.

    References
    ----------
    .. [1] Bernstein 2010, MNRAS 406, 2793, §4.4; Bernstein and Jarvis 2002, AJ 123, 583.

    Examples
    --------
    >>> import numpy as np
    >>> from fdnt_xp.shapes.gl_fit import fit_laguerre
    >>> y, x = np.mgrid[-20:21, -20:21]
    >>> star = np.exp(-(x**2 + y**2) / 18.0)[None]
    >>> fit = fit_laguerre(star, np.ones_like(star), order=4)
    >>> fit.basis.size.round(6), (fit.coefficients[0, 0] / np.sqrt(np.pi)).round(6)
    (array([3.]), np.float64(3.0))
    """
    xp, stamps, ivar = _checked(stamps, ivar)
    _check_numbers(order, stamps, scale=scale, chunk_size=chunk_size)
    start = _checked_start(stamps, eta=eta, centroid=centroid, size=size)
    n_gal = int(stamps.shape[0])
    n_chunk = chunk_size or _galaxies_at_once(order, stamps)
    parts = []
    for first in range(0, max(n_gal, 1), n_chunk):
        rows = slice(first, min(first + n_chunk, n_gal))
        here = {n: None if value is None else value[rows, ...] for n, value in start.items()}
        pixels, weights, flags = _screened(xp, stamps[rows, :, :], ivar[rows, :, :])
        basis = _starting_basis(pixels, weights, order, here)
        root = match_basis(basis, pixels, weights, max_iter) if matched else None
        basis = basis if root is None else _basis_at(root.x, basis)
        basis = replace(basis, size=scale * basis.size)
        parts.append(_described(basis, pixels, weights, root, flags))
    return LaguerreFit.concat(parts)


def filled(stamps: Array, ivar: Array, fit: LaguerreFit) -> Array:
    """Return stamps whose missing pixels are those of the fit.

    Parameters
    ----------
    stamps, ivar : array, shape (n_gal, ny, nx)
        Those that were fitted. Pixels with `ivar > 0` come back untouched.
    fit : LaguerreFit
        Missing pixels of galaxies without a usable fit become NaN.
    """
    xp, stamps, ivar = _checked(stamps, ivar)
    if stamps.shape[0] != fit.flags.shape[0]:
        raise ShapeMismatchError(
            f"fit holds {fit.flags.shape[0]} galaxies for {stamps.shape[0]} stamps"
        )
    model = fit.basis.image(fit.coefficients, *pixel_positions(xp, stamps))
    return xp.where(ivar > 0, stamps, xp.reshape(model, stamps.shape))


def least_squares(functions: Array, pixels: Array, ivar: Array) -> LinearFit:
    """Fit a sum of functions to the pixels of each galaxy, by Cholesky's normal equations.

    Parameters
    ----------
    functions : array, shape (n_gal, n_coef, n_pix)
        Finite.
    pixels, ivar : array, shape (n_gal, n_pix)
        Finite where ivar > 0; ivar >= 0.

    Notes
    -----
    The matrix is scaled to a unit diagonal and gets a ridge above its rounding, so that the
    factorisation cannot fail, for one would fail the batch; the ridge is taken back by
    iterated refinement of the coefficients. The covariance keeps it: a relative error of
    the ridge, 2e-13 (in float32 1e-4) at 91 coefficients, times the inflation.
    """
    xp = array_namespace(functions=functions, pixels=pixels, ivar=ivar)
    n_coef = int(functions.shape[1])
    brightest = xp.max(ivar, axis=-1)
    unit = xp.where(brightest > 0, brightest, xp.ones_like(brightest))
    weighted = functions * (ivar / unit[:, None])[:, None, :]
    normal = xp.matmul(weighted, xp.matrix_transpose(functions))
    right = _times(weighted, xp.where(ivar > 0, pixels, xp.zeros_like(pixels)))

    n_pixels = xp.sum(xp.astype(ivar > 0, xp.int32), axis=-1, dtype=xp.int32)
    diagonal = xp.linalg.diagonal(normal)
    seen = xp.all(diagonal > float(xp.finfo(normal.dtype).smallest_normal) ** 0.5, axis=-1)
    fair = seen & (n_pixels >= n_coef) & xp.all(xp.isfinite(right), axis=-1)
    norm = 1.0 / xp.sqrt(xp.where(fair[:, None], diagonal, xp.ones_like(diagonal)))
    eye = xp.eye(n_coef, dtype=normal.dtype, device=device_of(normal))[None, :, :]
    both = norm[:, :, None] * norm[:, None, :]
    normal = xp.where(fair[:, None, None], normal * both, eye)
    right = xp.where(fair[:, None], norm * right, xp.zeros_like(right))

    ridge = _RIDGE * n_coef * float(xp.finfo(normal.dtype).eps)
    root = xp.linalg.inv(xp.linalg.cholesky(normal + ridge * eye))
    inverse = xp.matmul(xp.matrix_transpose(root), root)
    solution = _times(inverse, right)
    for _ in range(_REFINEMENTS):
        solution = solution + _times(inverse, right - _times(normal, solution))
    inflation = xp.max(xp.linalg.diagonal(inverse), axis=-1)
    return LinearFit(
        coefficients=norm * solution,
        covariance=inverse * both / unit[:, None, None],
        inflation=xp.where(fair, inflation, xp.full_like(inflation, float("inf"))),
        n_pixels=n_pixels,
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
        basis = _basis_at(x, self.start)
        basis, sane = _screened_basis(basis, min(self.stamps.shape[1:]))
        fit = _fit(basis, self.stamps, self.ivar)
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


def _described(
    basis: LaguerreBasis, stamps: Array, ivar: Array, root: RootResult | None, flags: Array
) -> LaguerreFit:
    """Fit at the basis found, and say of each galaxy whether that means anything."""
    xp = array_namespace(stamps=stamps)
    basis, sane = _screened_basis(basis, min(stamps.shape[1:]))
    fit = _fit(basis, stamps, ivar)
    reasons = [(Flag.SINGULAR, ~(fit.inflation < LARGEST_INFLATION) | ~sane)]
    if root is not None:
        reasons += [
            (Flag.NO_SIGNAL, root.status == int(Status.NON_FINITE)),
            (Flag.RADIUS_TOO_SMALL, root.status == int(Status.RADIUS_TOO_SMALL)),
            (Flag.DID_NOT_CONVERGE, ~root.success),
        ]
    for flag, holds in reasons:
        flags = xp.where((flags == 0) & holds, xp.full_like(flags, int(flag)), flags)

    def where_usable(values: Array) -> Array:
        mask = xp.reshape(flags == 0, (-1,) + (1,) * (values.ndim - 1))
        return xp.where(mask, values, xp.full_like(values, float("nan")))

    return LaguerreFit(
        basis=replace(
            basis,
            eta=where_usable(basis.eta),
            centroid=where_usable(basis.centroid),
            size=where_usable(basis.size),
        ),
        coefficients=where_usable(fit.coefficients),
        coefficients_cov=where_usable(fit.covariance),
        inflation=fit.inflation,
        n_pixels=fit.n_pixels,
        flags=flags,
        n_iter=xp.zeros_like(flags) if root is None else root.n_eval,
        status=xp.zeros_like(flags) if root is None else root.status,
    )


def _fit(basis: LaguerreBasis, stamps: Array, ivar: Array) -> LinearFit:
    xp = array_namespace(stamps=stamps)
    n_gal, ny, nx = stamps.shape
    functions = basis.in_x(*pixel_positions(xp, stamps))
    flat = (n_gal, ny * nx)
    return least_squares(functions, xp.reshape(stamps, flat), xp.reshape(ivar, flat))


def _basis_at(x: Array, like: LaguerreBasis) -> LaguerreBasis:
    """Return the basis of the unknowns of `BasisTests`."""
    xp = array_namespace(x=x)
    return LaguerreBasis(
        order=like.order,
        eta=x[:, 2:4],
        centroid=like.size[:, None] * x[:, :2],
        size=xp.exp(x[:, 4]),
    )


def _screened_basis(basis: LaguerreBasis, side: int) -> tuple[LaguerreBasis, Array]:
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


def _starting_basis(
    stamps: Array, ivar: Array, order: int, given: dict[str, Array | None]
) -> LaguerreBasis:
    """Return the basis that was given; what was not is round, or comes from moments."""
    xp = array_namespace(stamps=stamps)
    _, ny, nx = stamps.shape
    eta, centroid, size = given["eta"], given["centroid"], given["size"]
    if centroid is not None:
        like = {"dtype": stamps.dtype, "device": device_of(stamps)}
        centroid = centroid - xp.asarray([[0.5 * (nx - 1), 0.5 * (ny - 1)]], **like)
    if centroid is None or size is None:
        by_moments = starting_moments(stamps, ivar)
        centroid = by_moments[0] if centroid is None else centroid
        size = by_moments[1] if size is None else size
    return LaguerreBasis(
        order=order,
        eta=xp.zeros_like(centroid) if eta is None else eta,
        centroid=centroid,
        size=size,
    )


def _screened(xp: ModuleType, stamps: Array, ivar: Array) -> tuple[Array, Array, Array]:
    """Return pixels, 0 where missing, ivar, 0 for galaxies beyond use, and flags."""

    def every(holds: Array) -> Array:
        return xp.all(xp.all(holds, axis=-1), axis=-1)

    present = ivar > 0
    good = every(xp.isfinite(ivar) & (ivar >= 0) & (xp.isfinite(stamps) | ~present))
    use = present & good[:, None, None]
    zero = xp.zeros_like(stamps)
    stamps, ivar = xp.where(use, stamps, zero), xp.where(use, ivar, zero)
    flags = xp.astype(~good, xp.int32) * int(Flag.NON_FINITE_PIXEL)
    return stamps, ivar, flags + xp.astype(good & every(~use), xp.int32) * int(Flag.NO_SIGNAL)


def _checked(stamps: Array, ivar: Array) -> tuple[ModuleType, Array, Array]:
    """Refuse arrays that do not fit each other; return them as floats."""
    xp = array_namespace(stamps=stamps, ivar=ivar)
    stamps, ivar = as_floating(xp, stamps, "stamps"), as_floating(xp, ivar, "ivar")
    require_dtype(stamps.dtype, ivar=ivar)
    if stamps.ndim != 3 or 0 in stamps.shape[1:] or ivar.shape != stamps.shape:
        raise ShapeMismatchError(
            "stamps and ivar must both have the shape (n_gal, ny, nx), not "
            f"{tuple(stamps.shape)} and {tuple(ivar.shape)}"
        )
    return xp, stamps, ivar


def _checked_start(stamps: Array, **start: Array | None) -> dict[str, Array | None]:
    """Refuse a start that does not fit the stamps."""
    n_gal = int(stamps.shape[0])
    array_namespace(stamps=stamps, **start)
    require_dtype(stamps.dtype, **start)
    for name, value in start.items():
        shape = (n_gal,) if name == "size" else (n_gal, 2)
        if value is not None and tuple(value.shape) != shape:
            raise ShapeMismatchError(f"{name} must have the shape {shape}, not {value.shape}")
    return start


def _check_numbers(order: int, stamps: Array, *, scale: float, chunk_size: int | None) -> None:
    """Refuse numbers that mean nothing."""
    check_order(order)
    n_pixels = int(stamps.shape[1]) * int(stamps.shape[2])
    if n_coefficients(order) > n_pixels:
        raise FdntValueError(
            f"order {order} has {n_coefficients(order)} coefficients, and a stamp {n_pixels} pixels"
        )
    if not (math.isfinite(scale) and scale > 0):
        raise RangeError("scale", scale, 0.0, None)
    if chunk_size is not None:
        check_count("chunk_size", chunk_size, 1)


def _galaxies_at_once(order: int, stamps: Array) -> int:
    """Return how many galaxies fit the memory of a chunk."""
    n_coef, n_pixels = n_coefficients(order), int(stamps.shape[1]) * int(stamps.shape[2])
    return max(1, int(_BYTES_AT_ONCE / (8 * (3 * n_coef * n_pixels + 6 * n_coef**2))))


def _times(matrix: Array, vector: Array) -> Array:
    """Return `M v` of each galaxy."""
    xp = array_namespace(matrix=matrix)
    return xp.matmul(matrix, vector[:, :, None])[:, :, 0]
