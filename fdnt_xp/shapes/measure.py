"""The shape of every galaxy of a batch: FDNT-FT, from pixels to `ShapeResult`.

stamps -> transform, divided by T        fourier
       -> centroid under a wide weight   shapes.centroid
       -> root of the five null tests    nulltests
       -> once more on a finer k grid for the few that need it
       -> covariance, flux, flags
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Final

from fdnt_xp.arrays import (
    Array,
    array_namespace,
    as_floating,
    compiles_every_shape,
    device_of,
    require_dtype,
)
from fdnt_xp.errors import FdntTypeError, FdntValueError, RangeError, ShapeMismatchError
from fdnt_xp.flags import Flag
from fdnt_xp.fourier.grid import KGrid, half_plane_disc
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.fourier.transform import deconvolve
from fdnt_xp.nulltests.dogleg import DoglegOptions, RootResult, find_root
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.nulltests.weights import Weight, make_weight
from fdnt_xp.shapes.centroid import starting_centroid
from fdnt_xp.shapes.results import ShapeResult
from fdnt_xp.shapes.solution import describe

_FINE_ABOVE: Final = 1.5
"""`|eta|` beyond which the weight, squeezed by `exp(-|eta|/2)`, covers few cells of the k grid."""
_FINE: Final = 2
"""How much finer the second grid is, along each axis."""
_FEWEST_CELLS: Final = 3.0
"""Least radius of the disc, in cells of the k grid: quadrupoles need an annulus or two."""
_WIDE: Final = 0.125
"""Size of the weight of the first centroid, in sides of the stamp: it reaches a third of it."""
_BYTES_AT_ONCE: Final = 128e6
"""Memory of a chunk of galaxies."""
_FIELDS: Final = 24
"""Arrays of the size of the deconvolved stamps that an evaluation of the tests holds."""


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
    for name, value, least in (("padding", padding, 1), ("max_iter", max_iter, 0)):
        if value != int(value) or value < least:
            raise RangeError(name, value, least, None)
    if size is not None and not (math.isfinite(size) and size > 0):
        raise RangeError("size", size, 0.0, None)
    if chunk_size is not None and (chunk_size != int(chunk_size) or chunk_size < 1):
        raise RangeError("chunk_size", chunk_size, 1, None)
    if n_gal == 0:
        return ShapeResult.unmeasured(stamps)

    job = prepare(xp, stamps, psf, padding, size, max_iter)
    n_chunk = chunk_size or galaxies_at_once(job.coarse, stamps)
    parts = []
    for start in range(0, n_gal, n_chunk):
        rows = slice(start, min(start + n_chunk, n_gal))
        parts.append(_measure_chunk(job.rows(rows), stamps[rows, :, :], noise[rows]))
    return ShapeResult.concat(parts)


@dataclass(frozen=True, kw_only=True)
class Job:
    """What all galaxies share, and the PSF, of which there may be one for each."""

    psf: Psf
    weight: Weight
    coarse: KGrid
    fine: KGrid
    length: float
    size: float | None
    max_iter: int

    def rows(self, rows: slice) -> Job:
        """Return the job of a range of galaxies."""
        if self.weight.shared:
            return self
        xp = array_namespace(kmax=self.psf.kmax)
        device = device_of(self.psf.kmax)
        return self.take(xp.arange(rows.start, rows.stop, dtype=xp.int64, device=device))

    def take(self, rows: Array) -> Job:
        """Return the job of the given galaxies (integer array)."""
        if self.weight.shared:
            return self
        return Job(
            psf=self.psf.take(rows),
            weight=self.weight.take(rows),
            coarse=self.coarse,
            fine=self.fine,
            length=self.length,
            size=self.size,
            max_iter=self.max_iter,
        )


def prepare(
    xp: ModuleType, stamps: Array, psf: Psf, padding: int, size: float | None, max_iter: int
) -> Job:
    """Make the k grids and the tables of the weight."""
    ny, nx = (int(n) for n in stamps.shape[1:])
    shape = (padding * ny, padding * nx)
    cell = 2.0 * math.pi / min(ny, nx)
    if psf.largest_kmax < _FEWEST_CELLS * cell:
        raise FdntValueError(
            f"psf is too wide for stamps of {ny} x {nx} pixels: its transfer function ends at "
            f"{psf.largest_kmax:.3g} rad/pixel, and {_FEWEST_CELLS * cell:.3g} is the least that "
            "such stamps resolve"
        )
    like = {"dtype": stamps.dtype, "device": device_of(stamps)}
    return Job(
        psf=psf.restricted(_FEWEST_CELLS * cell),
        # A weight of this size is one cell of the k grid wide.
        weight=make_weight(psf, largest_size=1.0 / cell),
        coarse=half_plane_disc(xp, shape, psf.largest_kmax, **like),
        fine=half_plane_disc(xp, (_FINE * shape[0], _FINE * shape[1]), psf.largest_kmax, **like),
        length=3.0 / psf.largest_kmax,  # about the size of the PSF
        size=size,
        max_iter=max_iter,
    )


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
    per_chunk = max(1, int(stamps.shape[0]) // _FINE**2)
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


def screen(stamps: Array, psf: Psf) -> tuple[Array, Array]:
    """Return stamps that do no harm, zero where not finite, and why some cannot be measured.

    Returns
    -------
    stamps : array, shape (n_gal, ny, nx)
    flags : array, shape (n_gal,), int32
        Zero, or a reason of `fdnt_xp.flags.Flag`.
    """
    xp = array_namespace(stamps=stamps)
    finite = xp.all(xp.all(xp.isfinite(stamps), axis=-1), axis=-1)
    stamps = xp.where(finite[:, None, None], stamps, xp.zeros_like(stamps))
    brightest = xp.max(xp.max(stamps, axis=-1), axis=-1)
    faintest = xp.min(xp.min(stamps, axis=-1), axis=-1)
    flags = xp.zeros_like(brightest, dtype=xp.int32)
    for reason, holds in (
        (Flag.NON_FINITE_PIXEL, ~finite),
        (Flag.NO_SIGNAL, finite & (brightest == faintest)),
        (Flag.BAD_PSF, xp.broadcast_to(~psf.usable, finite.shape)),
    ):
        flags = flags + xp.astype(holds, xp.int32) * int(reason)
    return stamps, flags


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
        # Taking finished rows out makes ever new shapes.
        compact_below=0.0 if compiles_every_shape(xp) else 0.75,
    )
    return find_root(tests, start, options=options)


def wide_weight(
    weight: Weight, grid: KGrid, side: int, applied_shear: Array | None = None
) -> Array:
    """Return the weight of the first centroid, shape (n_psf, n_k).

    Parameters
    ----------
    side : int
        Shorter side of the stamps, pixels.
    applied_shear : array, shape (2,), optional
        Makes the weight round in the frame from which this eta is taken off: the null of
        its dipole then follows that shear. By default it is round on the image.
    """
    xp = array_namespace(kmax=weight.kmax)
    shrink = xp.ones_like(weight.kmax)
    if applied_shear is not None:
        grid = grid.sheared(applied_shear)
        # As in the null tests: the weight may not reach out of the disc.
        shrink = shrink * xp.exp(0.5 * xp.sqrt(xp.sum(applied_shear**2)))
    radius_squared = (grid.kx**2 + grid.ky**2)[None, :]
    square = xp.broadcast_to(radius_squared, (int(weight.kmax.shape[0]), grid.n_k))
    psf_factor, _ = weight.psf_factor(square, shrink)
    return psf_factor * xp.exp(-0.5 * (_WIDE * side) ** 2 * square)


def check_stamps(stamps: Array, psf: Psf) -> tuple[ModuleType, Array]:
    """Refuse what cannot be measured; return the namespace and the stamps as floats."""
    if not isinstance(psf, Psf):
        raise FdntTypeError(
            f"psf must be a Psf, not {type(psf).__name__}; make one with Psf.from_image"
        )
    xp = array_namespace(stamps=stamps, psf=psf.image)
    stamps = as_floating(xp, stamps, "stamps")
    require_dtype(stamps.dtype, psf=psf.image)
    if stamps.ndim != 3 or 0 in stamps.shape[1:]:
        raise ShapeMismatchError(
            f"stamps must have the shape (n_gal, ny, nx), not {tuple(stamps.shape)}"
        )
    n_gal = int(stamps.shape[0])
    if psf.n_psf not in (1, n_gal):
        raise ShapeMismatchError(
            f"psf holds {psf.n_psf} PSFs for {n_gal} stamps; it must hold one, or one for each"
        )
    return xp, stamps


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


def galaxies_at_once(grid: KGrid, stamps: Array) -> int:
    """Return how many galaxies fit the memory of a chunk."""
    ny, nx = stamps.shape[1:]
    numbers = _FIELDS * grid.n_k + 3 * int(ny) * int(nx)
    return max(16, int(_BYTES_AT_ONCE / (numbers * 8)))
