"""A first look at the exposures of objects: where they are, and what each exposure counts.

The dipoles of all exposures of an object are nulled together, under wide round weights. There
each exposure is seen once as a round galaxy: the S/N of t0, the scale of the null tests, is
the root of its weight. The tests are then multiplied by `a = t0/Var(t0)`, which is linear in
t0; the S/N of the flux would ask for a division by a t0 that may be noise. Fixed from there
on, any weights make a null test.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from fdnt_xp.arrays import Array, array_namespace, device_of
from fdnt_xp.flags import Flag
from fdnt_xp.nulltests.exposures import Exposures, ExposureTests, by_object, spread_over_stamps
from fdnt_xp.nulltests.scaled import over_scale
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.shapes.centroid import DipoleTests, find_centroid


@dataclass(frozen=True, kw_only=True)
class FirstLook:
    """What a first look has shown.

    Parameters
    ----------
    exposures : Exposures
        With their weights.
    offset : array, shape (n_obj, 2)
        Centroids on the sky, in the objects' units.
    flags : array, shape (n_stamp,), int32
        Why stamps do not count.
    snr : array, shape (n_stamp,)
        The root of the weight; NaN for stamps that were not looked at.
    flux_share : array, shape (n_stamp,)
        Inverse variance of the flux over the largest of the object; 0 where it is not used.
    """

    exposures: Exposures
    offset: Array
    flags: Array
    snr: Array
    flux_share: Array

    def take(self, rows: Array) -> FirstLook:
        """Return what was seen of the given objects (integer array)."""
        xp = array_namespace(rows=rows)
        stamps = self.exposures.stamps_of(rows)
        moved = {g: xp.take(getattr(self, g), stamps, axis=0) for g in _OF_STAMPS}
        offset = xp.take(self.offset, rows, axis=0)
        return FirstLook(exposures=self.exposures.take(rows), offset=offset, **moved)


_OF_STAMPS: Final = ("flags", "snr", "flux_share")


@dataclass(frozen=True, kw_only=True)
class ExposureDipoles:
    """The dipole of each object under fixed weights: a `RootProblem` in `(u/L, v/L)`."""

    stamps: DipoleTests
    exposures: Exposures

    def take(self, rows: Array) -> ExposureDipoles:
        """Return the problem of the given objects (integer array)."""
        stamps = self.stamps.take(self.exposures.stamps_of(rows))
        return ExposureDipoles(stamps=stamps, exposures=self.exposures.take(rows))

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """Return the sums of dipoles over those of `L t0`, and their Jacobian."""
        xp = array_namespace(x=x)
        length = self.stamps.length
        values, slopes = self.stamps.raw(self.exposures.centroids(length * x))
        units = xp.asarray([1.0, 1.0, length], dtype=x.dtype, device=device_of(x))
        values = self.exposures.add(values[:, :, None], 0)[:, :, 0]
        slopes = self.exposures.add_slopes(slopes, 0)
        f, jac = over_scale(values * units, slopes * units[:, None])
        return f, length * jac


def look(
    tests: NullTests,
    exposures: Exposures,
    wide: Array,
    variance: Array,
    inverse_transfer: Array,
    flags: Array,
    *,
    reach: float,
) -> FirstLook:
    """Look at the exposures of objects.

    Parameters
    ----------
    tests : NullTests
        Of the stamps, 0 where they do not count.
    exposures : Exposures
        Whose weights are not looked at.
    wide : array, shape (n_stamp or 1, n_k)
        The weight of the first centroid.
    variance : array, shape (n_stamp,)
        Of the noise of a pixel, all in one unit.
    inverse_transfer : array, shape (n_stamp or 1, n_k), complex
        1/T.
    flags : array, shape (n_stamp,), int32
        What is known so far.
    reach : float
        Farthest that the centroid may be from the origin, in the objects' units.
    """
    xp = array_namespace(flags=flags)
    n_each = exposures.n_each
    dipoles = DipoleTests(
        grid=tests.grid, galaxies=tests.galaxies, weight=wide, length=tests.length
    )
    # Roughly: the noise of t0 goes with the third power of the side of a pixel.
    error = xp.sqrt(variance * exposures.area**3)
    scale, _ = dipoles.raw(exposures.origin)
    first = _weighted(exposures, scale[:, 2] / error, error, flags == 0)
    problem = ExposureDipoles(stamps=dipoles, exposures=first)
    offset = find_centroid(
        problem, by_object(exposures.origin, n_each)[:, 0, :], tests.length, reach=reach
    )

    centroid = first.centroids(offset)
    inverse_power = xp.real(inverse_transfer) ** 2 + xp.imag(inverse_transfer) ** 2
    eta = xp.zeros_like(centroid)
    if n_each > 1 and tests.fixed_width is None:
        summed = ExposureTests(stamps=tests, exposures=first)
        tests = summed.of_one_size(tests.widths(eta, centroid))
    seen = tests.noise(eta, centroid, inverse_power)
    ny, nx = tests.grid.shape
    per_mode = variance * float(ny * nx)
    error = xp.sqrt(seen.scale_variance * per_mode)
    snr = seen.tests.values[:, 4] / xp.where(error > 0, error, xp.ones_like(error))
    counts = (snr > 0) & xp.isfinite(snr) & (error > 0)
    no_signal = (flags == 0) & ~counts
    looked = flags == 0
    flags = xp.where(no_signal, xp.full_like(flags, int(Flag.NO_SIGNAL)), flags)
    flux_variance = seen.flux_variance * per_mode
    used = (flags == 0) & (flux_variance > 0)
    safe = xp.where(used, flux_variance, xp.ones_like(flux_variance))
    share = xp.where(used, 1.0 / safe, xp.zeros_like(safe))
    return FirstLook(
        exposures=_weighted(exposures, snr, error, flags == 0),
        offset=offset,
        flags=flags,
        snr=xp.where(looked, snr, xp.full_like(snr, float("nan"))),
        flux_share=share / _largest(share, n_each),
    )


def _weighted(exposures: Exposures, snr: Array, error: Array, counts: Array) -> Exposures:
    """Return the exposures with weights `snr²`, and with them `a = snr/error` of their tests.

    Both in units of the object's best exposure: fluxes of any unit stay in range.
    """
    xp = array_namespace(snr=snr)
    snr = xp.where(counts & (snr > 0), snr, xp.zeros_like(snr))
    relative = snr / _largest(snr, exposures.n_each)
    square = relative**2
    total = spread_over_stamps(
        xp.sum(by_object(square, exposures.n_each), axis=1)[:, None], exposures.n_each
    )[:, 0]
    share = square / xp.where(total > 0, total, xp.ones_like(total))
    safe = xp.where(relative > 0, error, xp.ones_like(error))
    smallest = 1.0 / _largest(relative / safe, exposures.n_each)
    factor = relative / safe * smallest
    return replace(exposures, factor=factor, share=share)


def _largest(values: Array, n_each: int) -> Array:
    """Return for each stamp the largest number of those of its object, 1 where none is positive."""
    xp = array_namespace(values=values)
    most = xp.max(by_object(values, n_each), axis=1)[:, None]
    most = spread_over_stamps(most, n_each)[:, 0]
    return xp.where(most > 0, most, xp.ones_like(most))
