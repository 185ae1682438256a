"""The shape of every galaxy of a batch: FDNT-FT, from pixels to `ShapeResult`.

stamps -> transform, divided by T        fourier
       -> centroid under a wide weight   shapes.centroid
       -> root of the five null tests    nulltests
       -> once more on a finer k grid for the few that need it
       -> covariance, flux, flags
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import Final

from fdnt_xp.arrays import (
    Array,
    array_namespace,
    as_floating,
    require_dtype,
)
from fdnt_xp.errors import RangeError, ShapeMismatchError
from fdnt_xp.flags import Flag
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.fourier.transform import deconvolve
from fdnt_xp.nulltests.dogleg import DoglegOptions, RootResult, find_root
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.shapes.centroid import starting_centroid, wide_weight
from fdnt_xp.shapes.job import (
    FINER,
    Job,
    check_count,
    check_options,
    check_stamps,
    galaxies_at_once,
    prepare,
    screen,
)
from fdnt_xp.shapes.results import ShapeResult
from fdnt_xp.shapes.solution import describe

_FINE_ABOVE: Final = 1.5
"""`|eta|` beyond which the weight, squeezed by `exp(-|eta|/2)`, covers few cells of the k grid."""


def measure_shapes(
    stamps: Array,
    psf: Psf,
    *,
    noise_variance: float | Array | None = None,
    size: float | None = None,
    padding: int = 1,
    max_iter: int = 50,
    chunk_size: int | None = None,
) -> ShapeResult:
    """Measure the shape of the galaxy on each stamp, before the PSF.

    Nothing raises for the sake of a galaxy: one that cannot be measured is NaN, with the
    reason in its flags, and changes nothing for the others.

    Parameters
    ----------
    stamps : array, shape (n_gal, ny, nx)
        Images of one galaxy each, background taken off; its library, dtype and device are
        those of the result. Integers become float64.
    psf : Psf
        One for all stamps, or one for each.
    noise_variance : float or array, shape (n_gal,), optional
        Variance of the white noise of a pixel, (unit of the image)². Without it shapes
        have no covariance and no S/N.
    size : float, optional
        Fixes the size sigma of the Gaussian part of the weight, pixels, in the frame where
        the galaxy is round. By default it is matched to each galaxy.
    padding : int
        Makes the k grid finer by this factor for all galaxies. Without it only the most
        elongated are measured on a grid twice as fine.
    max_iter : int
        Steps of the root finder.
    chunk_size : int, optional
        Galaxies that are in work together. It bounds the memory and changes no number
        beyond rounding. By default what fits 128 MB.

    Returns
    -------
    ShapeResult
        Row i belongs to stamp i; an empty batch gives an empty result.

    Raises
    ------
    FdntTypeError, NamespaceError
        If `stamps` is no array or `psf` no `Psf`; if they, or `noise_variance`, are of two
        libraries, dtypes or devices.
    ShapeMismatchError
        If `stamps` has not three axes, or another number of rows than `psf` has PSFs.
    FdntValueError, RangeError
        If a number is out of range, or the PSF so wide that the stamps resolve nothing.

    References
    ----------
    .. [1] Bernstein 2010, MNRAS 406, 2793, §4.

    Examples
    --------
    >>> import numpy as np
    >>> import fdnt_xp as fx
    >>> y, x = np.mgrid[-24:25, -24:25]
    >>> star = np.exp(-(x**2 + y**2) / 8.0)
    >>> galaxy = np.exp(-(x**2 / 18.0 + y**2 / 12.0) / 2.0)  # variances 18 and 12
    >>> shapes = fx.measure_shapes(galaxy[None], fx.Psf.from_image(star))
    >>> shapes.e.round(6)  # before the PSF, of variance 4: (14 - 8)/(14 + 8)
    array([[0.272727, 0.      ]])
    """
    xp, stamps = check_stamps(stamps, psf)
    n_gal = int(stamps.shape[0])
    noise = _noise_column(xp, noise_variance, stamps)
    check_options(size=size, padding=padding, chunk_size=chunk_size)
    check_count("max_iter", max_iter, 0)
    if n_gal == 0:
        return ShapeResult.unmeasured(stamps)

    job = prepare(xp, stamps, psf, padding, size, max_iter)
    n_chunk = chunk_size or galaxies_at_once(job.coarse, stamps)
    parts = []
    for start in range(0, n_gal, n_chunk):
        rows = slice(start, min(start + n_chunk, n_gal))
        parts.append(_measure_chunk(job.rows(rows), stamps[rows, :, :], noise[rows]))
    return ShapeResult.concat(parts)


def _measure_chunk(job: Job, stamps: Array, noise: Array) -> ShapeResult:
    """Measure on the coarse grid, then the few that need it on the fine one."""
    xp = array_namespace(stamps=stamps)
    stamps, flags = screen(stamps, job.psf)
    measurable = flags == 0

    result, finer = _measure_on(job, job.coarse, stamps, noise, flags)
    finer = finer & measurable
    # A host read: how many need the fine grid decides the size of that batch.
    n_fine = int(xp.sum(xp.astype(finer, xp.int32)))
    if n_fine == 0:
        return result
    order = xp.argsort(xp.astype(~finer, xp.int32), stable=True)
    parts = []
    per_chunk = max(1, int(stamps.shape[0]) // FINER**2)
    for start in range(0, n_fine, per_chunk):
        rows = order[start : min(start + per_chunk, n_fine)]
        again, _ = _measure_on(
            job.take(rows),
            job.fine,
            xp.take(stamps, rows, axis=0),
            xp.take(noise, rows, axis=0),
            xp.take(flags, rows, axis=0) + int(Flag.FINE_GRID),
        )
        parts.append(again)
    merged = ShapeResult.concat([*parts, result.take(order[n_fine:])])
    return merged.take(xp.argsort(order))


def _measure_on(
    job: Job, grid: KGrid, stamps: Array, noise: Array, flags: Array
) -> tuple[ShapeResult, Array]:
    """Measure on one grid; return the shapes, and which a finer grid should measure again."""
    xp = array_namespace(stamps=stamps)
    inverse_transfer = job.psf.inverse_transfer(grid)
    galaxies = deconvolve(stamps, inverse_transfer, grid)
    fixed = None if job.size is None else xp.full_like(noise, job.size**2)
    tests = NullTests(
        grid=grid, galaxies=galaxies, weight=job.weight, length=job.length, fixed_width=fixed
    )
    root = solve(job, tests, min(stamps.shape[1:]))
    result = describe(
        tests,
        root,
        inverse_power=xp.real(inverse_transfer) ** 2 + xp.imag(inverse_transfer) ** 2,
        noise_per_mode=noise * float(grid.shape[0] * grid.shape[1]),
        stamp_shape=(int(stamps.shape[1]), int(stamps.shape[2])),
        flags=flags,
    )
    eta = root.x[:, :2]
    elongated = eta[:, 0] ** 2 + eta[:, 1] ** 2 > _FINE_ABOVE**2
    return result, elongated | ~root.success


def solve(job: Job, tests: NullTests, side: int) -> RootResult:
    """Find the root of the null tests, from a round galaxy at its first centroid."""
    xp = array_namespace(kmax=job.weight.kmax)
    centre = starting_centroid(
        tests.grid,
        tests.galaxies,
        wide_weight(job.weight, tests.grid, side),
        job.length,
        reach=0.5 * side,
    )
    start = xp.concat([xp.zeros_like(centre), centre / job.length], axis=-1)
    options = DoglegOptions(
        max_iter=job.max_iter,
        initial_radius=1.0,
        max_radius=3.0,
    )
    return find_root(tests, start, options=options)


def _noise_column(xp: ModuleType, noise_variance: float | Array | None, stamps: Array) -> Array:
    """Return the noise variance of each galaxy, NaN where unknown; shape (n_gal,)."""
    like = stamps[:, 0, 0]
    if noise_variance is None:
        return xp.full_like(like, float("nan"))
    if isinstance(noise_variance, int | float):
        if not (math.isfinite(noise_variance) and noise_variance >= 0):
            raise RangeError("noise_variance", float(noise_variance), 0.0, None)
        return xp.full_like(like, float(noise_variance))
    array_namespace(stamps=stamps, noise_variance=noise_variance)
    noise = as_floating(xp, noise_variance, "noise_variance")
    require_dtype(stamps.dtype, noise_variance=noise)
    if noise.shape not in ((), like.shape):
        raise ShapeMismatchError(
            f"noise_variance must be a number or have the shape {tuple(like.shape)}, "
            f"not {tuple(noise.shape)}"
        )
    return xp.broadcast_to(noise, like.shape)
