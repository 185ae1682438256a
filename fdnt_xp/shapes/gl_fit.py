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
from types import ModuleType
from typing import Final

from fdnt_xp.arrays import Array, array_namespace, as_floating, device_of, require_dtype
from fdnt_xp.errors import FdntValueError, RangeError, ShapeMismatchError
from fdnt_xp.flags import Flag
from fdnt_xp.nulltests.dogleg import RootResult, Status
from fdnt_xp.shapes.gl_matching import (
    basis_at,
    fit_pixels,
    match_basis,
    screened_basis,
    starting_moments,
)
from fdnt_xp.shapes.job import check_count
from fdnt_xp.shapes.laguerre import (
    LaguerreBasis,
    check_order,
    n_coefficients,
    pixel_positions,
)
from fdnt_xp.shapes.least_squares import LARGEST_INFLATION, LARGEST_WITH_GAPS

_BYTES_AT_ONCE: Final = 128e6


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
        How much the variance of a coefficient grows because the pixels left cannot tell it
        from others, see `LinearFit`.
    n_pixels : array, shape (n_gal,), int32
        Pixels that were fitted.
    flags : array, shape (n_gal,), int32
        Bits of `fdnt_xp.flags.Flag`; GL_FAILURE where there is no fit, with the reason where
        the pixels are not it: no basis matches.
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

    def harmless(self) -> LaguerreFit:
        """Return the fits with zeros in place of those that are not usable."""
        xp = array_namespace(flags=self.flags)

        def usable_or(values: Array, other: float) -> Array:
            mask = xp.reshape(self.usable, (-1,) + (1,) * (values.ndim - 1))
            return xp.where(mask, values, xp.full_like(values, other))

        return replace(
            self,
            basis=replace(
                self.basis,
                eta=usable_or(self.basis.eta, 0.0),
                centroid=usable_or(self.basis.centroid, 0.0),
                size=usable_or(self.basis.size, 1.0),
            ),
            coefficients=usable_or(self.coefficients, 0.0),
            coefficients_cov=usable_or(self.coefficients_cov, 0.0),
        )

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


def fit_laguerre(
    stamps: Array,
    ivar: Array,
    *,
    order: int = 12,
    eta: Array | None = None,
    centroid: Array | None = None,
    size: Array | None = None,
    matched: bool = True,
    scale: float | Array = 1.0,
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
    scale : float or array, shape (n_gal,)
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
    _check_numbers(order, stamps, chunk_size=chunk_size)
    scale = _checked_scale(stamps, scale)
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
        basis = basis if root is None else basis_at(root.x, basis)
        basis = replace(basis, size=scale[rows] * basis.size)
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


def _described(
    basis: LaguerreBasis, stamps: Array, ivar: Array, root: RootResult | None, flags: Array
) -> LaguerreFit:
    """Fit at the basis found, and say of each galaxy whether that means anything."""
    xp = array_namespace(stamps=stamps)
    basis, sane = screened_basis(basis, min(stamps.shape[1:]))
    fit = fit_pixels(basis, stamps, ivar)
    gaps = fit.n_pixels < int(stamps.shape[1]) * int(stamps.shape[2])
    largest = xp.where(
        gaps,
        xp.full_like(fit.inflation, LARGEST_WITH_GAPS),
        xp.full_like(fit.inflation, LARGEST_INFLATION),
    )
    reasons = [(Flag.GL_FAILURE, ~(fit.inflation < largest) | ~sane)]
    if root is not None:
        reasons += [
            (Flag.NO_SIGNAL, root.status == int(Status.NON_FINITE)),
            (Flag.GL_FAILURE | Flag.RADIUS_TOO_SMALL, root.status == int(Status.RADIUS_TOO_SMALL)),
            (Flag.GL_FAILURE | Flag.DID_NOT_CONVERGE, ~root.success),
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


def check_fit_order(order: int, stamps: Array) -> None:
    """Refuse an order that no stamp of this shape can carry."""
    check_order(order)
    n_pixels = int(stamps.shape[1]) * int(stamps.shape[2])
    if n_coefficients(order) > n_pixels:
        raise FdntValueError(
            f"order {order} has {n_coefficients(order)} coefficients, and a stamp {n_pixels} pixels"
        )


def _checked_scale(stamps: Array, scale: float | Array) -> Array:
    """Refuse what is no scale; return one for each galaxy."""
    xp = array_namespace(stamps=stamps)
    if isinstance(scale, int | float):
        if not (math.isfinite(scale) and scale > 0):
            raise RangeError("scale", scale, 0.0, None)
        return xp.full_like(stamps[:, 0, 0], float(scale))
    array_namespace(stamps=stamps, scale=scale)
    require_dtype(stamps.dtype, scale=scale)
    if tuple(scale.shape) != (int(stamps.shape[0]),):
        raise ShapeMismatchError(
            f"scale must be a number or have the shape ({stamps.shape[0]},), not "
            f"{tuple(scale.shape)}"
        )
    return scale


def _check_numbers(order: int, stamps: Array, *, chunk_size: int | None) -> None:
    """Refuse numbers that mean nothing."""
    check_fit_order(order, stamps)
    if chunk_size is not None:
        check_count("chunk_size", chunk_size, 1)


def _galaxies_at_once(order: int, stamps: Array) -> int:
    """Return how many galaxies fit the memory of a chunk."""
    n_coef, n_pixels = n_coefficients(order), int(stamps.shape[1]) * int(stamps.shape[2])
    return max(1, int(_BYTES_AT_ONCE / (8 * (3 * n_coef * n_pixels + 6 * n_coef**2))))
