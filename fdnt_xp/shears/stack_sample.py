"""What is stacked: galaxies moved to their centroids, what each counts, and its group."""

from __future__ import annotations

from dataclasses import dataclass

from fdnt_xp.arrays import Array, Rows, array_namespace, count_true, device_of, rows_of
from fdnt_xp.errors import FdntValueError
from fdnt_xp.fourier.transform import DeconvolvedStamps, deconvolve
from fdnt_xp.nulltests.dogleg import DoglegOptions, find_root
from fdnt_xp.nulltests.weights import Weight
from fdnt_xp.shapes.centroid import DipoleTests, starting_centroid
from fdnt_xp.shapes.job import Chunk, Job, screen


@dataclass(frozen=True, kw_only=True)
class StackShapes:
    """The shape of a stack, and of the stack without each of its groups.

    Parameters
    ----------
    eta : array, shape (n_groups + 1, 2)
        Of the whole stack, row 0, and without each group in turn.
    measured : array, shape (n_groups + 1,), bool
    weight : array, shape (n_groups,)
        What the galaxies of each group count together.
    n_used, n_excluded : int
    """

    eta: Array
    measured: Array
    weight: Array
    n_used: int
    n_excluded: int


@dataclass(frozen=True, kw_only=True)
class CentredGalaxies:
    """Some galaxies before the PSF, their centroids, and what they count.

    Parameters
    ----------
    galaxies : DeconvolvedStamps
    centres : array, shape (n_gal, 2)
        Pixels from the middle of the stamp.
    weights : array, shape (n_gal,)
        0 where a stamp is of no use.
    usable : array, shape (n_gal,), bool
    """

    galaxies: DeconvolvedStamps
    centres: Array
    weights: Array
    usable: Array


@dataclass(frozen=True, kw_only=True)
class StackSample:
    """What is to be stacked, and how; `centres` (n_gal, 2) count from the middle.

    `regular`, shape (1,) or (n_gal,), bool, says whose pixels have a Jacobian, if any has.
    """

    stamps: Array
    weights: Array
    centres: Array | None
    normalise: bool
    n_groups: int
    chunks: list[Chunk]
    regular: Array | None = None

    def members(self, rows: Rows) -> Array:
        """Return which group each of the rows is in, as 0 and 1; shape (n_groups, n_rows)."""
        xp = array_namespace(stamps=self.stamps)
        like = {"dtype": xp.int64, "device": device_of(self.stamps)}
        row = xp.arange(rows.start, rows.stop, **like) if isinstance(rows, slice) else rows
        group = row * self.n_groups // int(self.stamps.shape[0])
        number = xp.arange(self.n_groups, **like)
        return xp.astype(group[None, :] == number[:, None], self.stamps.dtype)

    def centred(self, job: Job, rows: Rows, wide: Array | None) -> CentredGalaxies:
        """Return galaxies with their centroids: those given, or found under a wide weight.

        Parameters
        ----------
        job : Job
            Of these galaxies.
        rows : slice or array of int64
        wide : array, shape (n_gal or 1, n_k), optional
            Needed where no centroids were given.
        """
        stamps, flags = screen(rows_of(self.stamps, rows), job.psf)
        xp = array_namespace(stamps=stamps)
        usable = flags == 0
        if self.regular is not None and int(self.regular.shape[0]) > 1:
            usable = usable & rows_of(self.regular, rows)
        galaxies = deconvolve(stamps, job.psf.inverse_transfer(job.coarse), job.coarse)
        if self.centres is None:
            assert wide is not None
            centres = _find_centres(job, wide, galaxies, 0.5 * min(stamps.shape[1:]))
        else:
            given = rows_of(self.centres, rows)
            finite = xp.isfinite(given[:, 0]) & xp.isfinite(given[:, 1])
            usable = usable & finite
            centres = xp.where(finite[:, None], given, xp.zeros_like(given))
        weights = rows_of(self.weights, rows)
        if self.normalise:
            flux = xp.sum(xp.sum(stamps, axis=-1), axis=-1)
            usable = usable & (flux > 0)
            weights = weights / xp.where(flux > 0, flux, xp.ones_like(flux))
        weights = xp.where(usable, weights, xp.zeros_like(weights))
        return CentredGalaxies(galaxies=galaxies, centres=centres, weights=weights, usable=usable)


def common_weight(job: Job) -> Weight:
    """Return one weight for all: that of the usable PSF whose weight ends first."""
    if job.weight.shared:
        return job.weight
    xp = array_namespace(kmax=job.weight.kmax)
    kmax = job.weight.kmax
    kmax = xp.where(job.psf.usable, kmax, xp.full_like(kmax, float("inf")))
    return job.weight.only(xp.reshape(xp.argmin(kmax), (1,)))


def refuse_too_few(weight: Array, n_used: int, n_excluded: int) -> None:
    """Raise `FdntValueError` where there is no mean with an error; `weight` is that of groups."""
    n_filled = count_true(weight > 0)
    if n_used < 2 or n_filled < 2:
        raise FdntValueError(
            f"{n_used} usable stamps in {n_filled} groups ({n_excluded} left out); a mean with "
            "an error needs two of each"
        )


def _find_centres(job: Job, wide: Array, galaxies: DeconvolvedStamps, reach: float) -> Array:
    """Return the null of the dipole under a wide weight, pixels from the middle, (n_gal, 2).

    Where there is none near the first centroid, that.
    """
    xp = array_namespace(re=galaxies.re)
    start = starting_centroid(job.coarse, galaxies, wide, job.length, reach=reach)
    tests = DipoleTests(grid=job.coarse, galaxies=galaxies, weight=wide, length=job.length)
    root = find_root(tests, start / job.length, options=DoglegOptions(max_radius=8.0))
    found = job.length * root.x
    near = xp.all(xp.abs(found - start) <= job.length, axis=-1)
    return xp.where((root.success & near)[:, None], found, start)
