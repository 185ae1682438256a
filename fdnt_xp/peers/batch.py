"""What all methods of fits share: checks, chunks, and the rows of the catalog."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, TypeAlias

from fdnt_xp.arrays import Array, DType, array_namespace, device_of, has_any
from fdnt_xp.flags import FAILED, Flag
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.nulltests.dogleg import Status
from fdnt_xp.shapes.job import check_options, check_stamps
from fdnt_xp.shapes.pixels import Pixels, check_pixels
from fdnt_xp.shapes.results import ShapeResult

MOST_ELLIPTICAL: Final = 4.0
"""`|eta|` beyond which no fit is looked for: an axis ratio of 55."""
SMALLEST: Final = 0.05
"""Least size of a model, pixels."""
LARGEST: Final = 0.5
"""Largest size, in sides of the stamp."""
_BYTES_AT_ONCE: Final = 128e6

MeasureRows: TypeAlias = "Callable[[Weighted, Psf, Array], ShapeResult]"
"""From clean pixels, their PSFs and flags to shapes."""


@dataclass(frozen=True, kw_only=True)
class Weighted:
    """Pixels and what each counts in a fit.

    Parameters
    ----------
    stamps : array, shape (n_gal, ny, nx)
        Finite; 0 where missing.
    weights : array, shape (n_gal, ny, nx), optional
        Inverse variance over the largest of the stamp: 0 where missing, 1 at most. None if
        all count alike.
    noise : array, shape (n_gal,)
        Variance of a pixel of weight 1; NaN if unknown.
    """

    stamps: Array
    weights: Array | None
    noise: Array

    @classmethod
    def of(cls, pixels: Pixels) -> Weighted:
        """Return screened pixels, weighted by their inverse variance if they have one."""
        if pixels.ivar is None:
            return cls(stamps=pixels.stamps, weights=None, noise=pixels.variance)
        xp = array_namespace(stamps=pixels.stamps)
        best = xp.max(xp.max(pixels.ivar, axis=-1), axis=-1)
        best = xp.where(best > 0, best, xp.ones_like(best))
        return cls(
            stamps=pixels.stamps, weights=pixels.ivar / best[:, None, None], noise=1.0 / best
        )

    def astype(self, dtype: DType) -> Weighted:
        """Return the same in another precision."""
        xp = array_namespace(stamps=self.stamps)
        weights = None if self.weights is None else xp.astype(self.weights, dtype)
        return Weighted(
            stamps=xp.astype(self.stamps, dtype),
            weights=weights,
            noise=xp.astype(self.noise, dtype),
        )


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """What a fit says of each galaxy of a chunk, believable or not.

    Parameters
    ----------
    eta, eta_cov : array, shapes (n_gal, 2) and (n_gal, 2, 2)
        Shape, and its covariance for a noise variance of 1 of a pixel of weight 1.
    centroid : array, shape (n_gal, 2)
        Pixels from the centre of the stamp.
    size, flux, flux_variance : array, shape (n_gal,)
        The last at fixed shape, for a noise variance of 1.
    regular : array, shape (n_gal,), bool
        Whether the data tell the parameters apart.
    status, n_eval : array, shape (n_gal,), int32
    """

    eta: Array
    eta_cov: Array
    centroid: Array
    size: Array
    flux: Array
    flux_variance: Array
    regular: Array
    status: Array
    n_eval: Array


def measure_in_chunks(
    measure: MeasureRows,
    stamps: Array,
    psf: Psf,
    *,
    noise_variance: float | Array | None,
    ivar: Array | None,
    size: float | None,
    padding: int,
    chunk_size: int | None,
    numbers_a_galaxy: int,
) -> ShapeResult:
    """Check a call, and measure chunk by chunk; see `measure_shapes` for what is asked."""
    xp, stamps = check_stamps(stamps, psf)
    pixels = check_pixels(xp, stamps, noise_variance, ivar)
    check_options(size=size, padding=padding, chunk_size=chunk_size)
    n_gal = int(stamps.shape[0])
    if n_gal == 0:
        return ShapeResult.unmeasured(stamps)
    n_chunk = chunk_size or max(1, int(_BYTES_AT_ONCE / (8 * numbers_a_galaxy)))
    device = device_of(stamps)
    parts = []
    for start in range(0, n_gal, n_chunk):
        stop = min(start + n_chunk, n_gal)
        rows = xp.arange(start, stop, dtype=xp.int64, device=device)
        mine = psf if psf.n_psf == 1 else psf.take(rows)
        here = pixels.take(slice(start, stop))
        clean, flags = here.screened(mine)
        shapes = measure(Weighted.of(clean), mine, flags)
        parts.append(replace(shapes, masked_fraction=here.masked_fraction()))
    return ShapeResult.concat(parts)


def in_domain(eta: Array, centroid: Array, size: Array, side: int) -> Array:
    """Return where a model is one that may be looked at, shape (n_gal,), bool."""
    xp = array_namespace(eta=eta)
    sane = xp.sum(eta**2, axis=-1) < MOST_ELLIPTICAL**2
    sane = sane & xp.all(xp.abs(centroid) < side, axis=-1)
    return sane & (size > SMALLEST) & (size < LARGEST * side)


def shapes_of(
    fit: Fitted, noise: Array, flags: Array, *, stamp_shape: tuple[int, int], fixed: bool
) -> ShapeResult:
    """Return the rows of the catalog: NaN where there is a reason, and the reason.

    Parameters
    ----------
    fit : Fitted
    noise : array, shape (n_gal,)
        Variance of a pixel of weight 1; NaN if unknown.
    flags : array, shape (n_gal,), int32
        What is known of each galaxy so far.
    stamp_shape : tuple of int
        (ny, nx).
    fixed : bool
        Whether the size was given by the caller.
    """
    xp = array_namespace(eta=fit.eta)
    ny, nx = stamp_shape
    off = (xp.abs(fit.centroid[:, 0]) > 0.5 * nx) | (xp.abs(fit.centroid[:, 1]) > 0.5 * ny)
    for flag, holds in (
        (Flag.NO_SIGNAL, fit.status == int(Status.NON_FINITE)),
        (Flag.RADIUS_TOO_SMALL, fit.status == int(Status.RADIUS_TOO_SMALL)),
        (Flag.DID_NOT_CONVERGE, fit.status != int(Status.CONVERGED)),
        (Flag.NO_SIGNAL, ~(fit.flux > 0)),
        (Flag.CENTROID_OFF_STAMP, off),
        (Flag.SINGULAR, ~fit.regular),
    ):
        flags = xp.where((flags == 0) & holds, xp.full_like(flags, int(flag)), flags)
    measured = ~has_any(flags, int(FAILED))
    if fixed:
        flags = xp.where(measured, flags + int(Flag.SIZE_FIXED), flags)
    known = measured & (fit.flux_variance * noise > 0)
    error = xp.sqrt(xp.where(known, fit.flux_variance * noise, xp.ones_like(noise)))
    snr = xp.where(known, fit.flux / error, xp.full_like(noise, float("nan")))
    middle = (xp.full_like(noise, 0.5 * (nx - 1)), xp.full_like(noise, 0.5 * (ny - 1)))

    def where_measured(values: Array) -> Array:
        mask = xp.reshape(measured, (-1,) + (1,) * (values.ndim - 1))
        return xp.where(mask, values, xp.full_like(values, float("nan")))

    return ShapeResult(
        eta=where_measured(fit.eta),
        eta_cov=where_measured(fit.eta_cov * noise[:, None, None]),
        # The criterion of a fit is the same for a galaxy and its sheared image.
        eg=where_measured(xp.zeros_like(fit.flux)),
        centroid=where_measured(fit.centroid + xp.stack(middle, axis=-1)),
        size=where_measured(fit.size),
        flux=where_measured(fit.flux),
        snr=snr,
        flags=flags,
        n_iter=fit.n_eval,
        status=fit.status,
    )
