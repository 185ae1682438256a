"""Where the transforms of exposures come from: stamps as they are, and stamps with gaps filled."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from fdnt_xp.arrays import Array, array_namespace, count_true, device_of, rows_of
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.fourier.transform import DeconvolvedStamps
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.shapes.fdnt_gl import fit_pixels_of
from fdnt_xp.shapes.pixels import Pixels
from fdnt_xp.shapes.solution import SolutionNoise
from fdnt_xp.shapes.sources import UnevenStamps, WhiteStamps, filled_stamps

_CENTRED: Final = 1.0
"""Pixels by which the rectangle of present pixels may be off the object to count as a stamp."""


@dataclass(frozen=True, kw_only=True)
class StampSources:
    """Where the transforms of stamps come from; some may have been filled.

    Parameters
    ----------
    every : WhiteStamps or UnevenStamps
        All stamps.
    filled : UnevenStamps, optional
        Those that were filled, with what filled them, for the sake of their noise.
    rank : array of int64, shape (n_stamp,), optional
        Which of `filled` a stamp is, in their order; -1 if it is none of them.
    """

    every: WhiteStamps | UnevenStamps
    filled: UnevenStamps | None = None
    rank: Array | None = None

    @classmethod
    def of(cls, pixels: Pixels) -> StampSources:
        """Return the stamps as they are."""
        white = pixels.ivar is None
        return cls(every=WhiteStamps(pixels=pixels) if white else UnevenStamps(pixels=pixels))

    @classmethod
    def with_filled(cls, pixels: Pixels, filled: UnevenStamps, which: Array) -> StampSources:
        """Return stamps with those `which`, shape (n_stamp,), bool, replaced by filled ones."""
        rank = _ranks(which)
        stamps = _replaced(pixels.stamps, filled.pixels.stamps, rank)
        every = UnevenStamps(pixels=replace(pixels, stamps=stamps))
        return cls(every=every, filled=filled, rank=rank)

    def take(self, rows: Array) -> StampSources:
        """Return the given stamps (integer array), in that order."""
        xp = array_namespace(rows=rows)
        every = self.every.take(rows)
        if self.filled is None or self.rank is None:
            return StampSources(every=every)
        rank = xp.take(self.rank, rows, axis=0)
        which = rank >= 0
        chosen = _rows_where(which)
        if int(chosen.shape[0]) == 0:
            return StampSources(every=every)
        filled = self.filled.take(xp.take(rank, chosen, axis=0))
        return StampSources.with_filled(every.pixels, filled, which)

    @property
    def was_filled(self) -> Array:
        """True where gaps were filled, shape (n_stamp,), bool."""
        variance = self.every.pixels.variance
        xp = array_namespace(variance=variance)
        if self.rank is None:
            return xp.zeros_like(variance, dtype=xp.bool)
        return self.rank >= 0

    def deconvolved(self, inverse_transfer: Array, grid: KGrid) -> DeconvolvedStamps:
        """Return the transforms of the stamps before the PSF."""
        return self.every.deconvolved(inverse_transfer, grid)

    def noise(
        self,
        tests: NullTests,
        eta: Array,
        centroid: Array,
        inverse_transfer: Array,
        *,
        n_at_once: int,
    ) -> SolutionNoise:
        """Return the noise of the tests at a solution; see `NullTests.noise`.

        That of pixels with an `ivar` is `n_at_once` stamps at a time: it needs more memory
        than all else, and one object can have any number of stamps.
        """
        shared = int(inverse_transfer.shape[0]) == 1
        parts = []
        for first in range(0, self.every.n_gal, n_at_once):
            rows = slice(first, min(first + n_at_once, self.every.n_gal))
            inverse = inverse_transfer if shared else inverse_transfer[rows, :]
            some = self.every.take(rows)
            parts.append(some.noise(tests.take(rows), eta[rows, :], centroid[rows, :], inverse))
        noise = SolutionNoise.concat(parts)
        if self.filled is None or self.rank is None:
            return noise
        rows = _rows_where(self.rank >= 0)
        more = self.filled.noise(
            tests.take(rows),
            rows_of(eta, rows),
            rows_of(centroid, rows),
            inverse_transfer if shared else rows_of(inverse_transfer, rows),
        )
        return replace(
            noise,
            covariance=_replaced(noise.covariance, more.covariance, self.rank),
            flux_variance=_replaced(noise.flux_variance, more.flux_variance, self.rank),
        )


def _replaced(every: Array, filled: Array, rank: Array) -> Array:
    """Return the numbers of all stamps, those of the filled ones replaced."""
    xp = array_namespace(rank=rank)
    n_stamp = int(every.shape[0])
    own = xp.arange(n_stamp, dtype=xp.int64, device=device_of(rank))
    place = xp.where(rank >= 0, rank + n_stamp, own)
    return xp.take(xp.concat([every, filled]), place, axis=0)


def _ranks(which: Array) -> Array:
    """Return the number of each True row among them, -1 elsewhere."""
    xp = array_namespace(which=which)
    rank = xp.cumulative_sum(xp.astype(which, xp.int64)) - 1
    return xp.where(which, rank, xp.full_like(rank, -1))


def with_gaps_filled(
    pixels: Pixels, gappy: Array, flags: Array, order: int
) -> tuple[StampSources, Array]:
    """Fill the gaps from fits; stamps whose pixels carry none get the reason as their flag."""
    rows = _rows_where(gappy)
    if int(rows.shape[0]) == 0:
        return StampSources.of(pixels.kept(flags == 0)), flags
    some = pixels.take(rows)
    fit = fit_pixels_of(some, order)
    sources = StampSources.with_filled(pixels.kept(flags == 0), filled_stamps(some, fit), gappy)
    return sources, _replaced(flags, fit.flags, _ranks(gappy))


def _rows_where(which: Array) -> Array:
    """Return the numbers of the rows that are True: a host read, for their number."""
    xp = array_namespace(which=which)
    n = count_true(which)
    return xp.argsort(xp.astype(~which, xp.int32), stable=True)[:n]


def missing_fraction(ivar: Array, origin: Array) -> Array:
    """Return the part of the pixels that is missing, but for borders of padding.

    A rectangle of present pixels with the object in its middle is a smaller stamp: what is
    around it was never looked at, and is sky. A stamp that the edge of an image has cut
    has its object elsewhere.

    Parameters
    ----------
    ivar : array, shape (n_stamp, ny, nx)
        Screened.
    origin : array, shape (n_stamp, 2)
        Of the object, pixels from the centre of the stamp.
    """
    xp = array_namespace(ivar=ivar)
    present = ivar > 0
    columns, near_x = _extent(xp.any(present, axis=1), origin[:, 0])
    rows, near_y = _extent(xp.any(present, axis=2), origin[:, 1])
    inside = columns[:, None, :] & rows[:, :, None]
    centred = near_x & near_y
    missing = ~present & (inside | ~centred[:, None, None])
    return xp.mean(xp.mean(xp.astype(missing, ivar.dtype), axis=-1), axis=-1)


def _extent(there: Array, origin: Array) -> tuple[Array, Array]:
    """Return what is between the first and the last that is there, and where that is centred.

    Parameters
    ----------
    there : array, shape (n_stamp, n), bool
        Lines of pixels.
    origin : array, shape (n_stamp,)
        From the middle of all n.
    """
    xp = array_namespace(origin=origin)
    n = int(there.shape[1])
    line = xp.arange(n, dtype=origin.dtype, device=device_of(origin)) - 0.5 * (n - 1)
    line = xp.broadcast_to(line[None, :], there.shape)
    far = xp.full_like(line, float(n))
    low = xp.min(xp.where(there, line, far), axis=-1)
    high = xp.max(xp.where(there, line, -far), axis=-1)
    between = (line >= low[:, None]) & (line <= high[:, None])
    return between, xp.abs(0.5 * (low + high) - origin) <= _CENTRED
