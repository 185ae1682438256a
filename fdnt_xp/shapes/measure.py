"""The shape of every galaxy of a batch, from pixels to `ShapeResult`.

pixels -> transform, divided by T        shapes.sources: of the stamps, or of fits to them
       -> centroid under a wide weight   shapes.centroid
       -> root of the five null tests    nulltests
       -> once more on a finer k grid for the few that need it
       -> covariance, flux, flags        shapes.solution
       -> lengths on the sky             shapes.sky, where there are Jacobians
"""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType
from typing import Final, Literal, TypeAlias

from fdnt_xp.arrays import Array, array_namespace, count_true, device_of
from fdnt_xp.errors import FdntValueError
from fdnt_xp.flags import Flag
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.nulltests.dogleg import RootResult
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.shapes.fdnt_gl import fit_pixels_of
from fdnt_xp.shapes.functionals import N_FUNCTIONALS
from fdnt_xp.shapes.gl_fit import check_fit_order
from fdnt_xp.shapes.job import (
    FINER,
    Job,
    check_count,
    check_options,
    check_stamps,
    galaxies_at_once,
    in_order,
    prepare,
)
from fdnt_xp.shapes.laguerre import check_order, n_coefficients
from fdnt_xp.shapes.pixels import Pixels, check_pixels
from fdnt_xp.shapes.results import ShapeResult
from fdnt_xp.shapes.search import (
    COARSE_STEPS,
    FINE_ABOVE,
    TWO_STEPS_OFF,
    looked_at,
    one_step_off,
    rough_root,
    search,
    squeezed,
    stepped,
)
from fdnt_xp.shapes.sky import SkyFrame, sky_frame
from fdnt_xp.shapes.solution import describe_with, solution_of
from fdnt_xp.shapes.sources import (
    FittedStamps,
    Source,
    UnevenStamps,
    WhiteStamps,
    filled_stamps,
)

Transform: TypeAlias = Literal["ft", "gl", "hybrid"]
TRANSFORMS: Final = ("ft", "gl", "hybrid")
"""Where the transform of a galaxy may come from; see `measure_shapes`."""


def measure_shapes(
    stamps: Array,
    psf: Psf,
    *,
    noise_variance: float | Array | None = None,
    ivar: Array | None = None,
    noise_power: Array | None = None,
    jacobian: Array | None = None,
    transform: Transform = "ft",
    order: int = 12,
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
        Variance of the white noise of a pixel, (unit of the image)². Without it, `ivar` and
        `noise_power`, shapes have no covariance and no S/N.
    ivar : array, shape (n_gal, ny, nx), optional
        In place of `noise_variance` the inverse variance of each pixel, 0 where it is
        missing: what such a pixel holds, be it NaN, is not looked at.
    noise_power : array, shape (ny, nx) or (n_gal, ny, nx), optional
        In place of both the power spectrum of noise that is correlated between pixels but
        stationary, `E|FFT(noise)|²/(ny nx)` of stamps cut from it, in the order of the FFT:
        `measure_noise_power(blank).power`. Its mean is the variance.
    jacobian : array, shape (2, 2) or (n_gal, 2, 2), optional
        `d(u, v)/d(x, y)`: what a step along the pixels is on the sky, in any unit, for all
        stamps or for each. Shapes, their errors and sizes are then those in (u, v), angles
        counted from u towards v, and the weight is round there: see docs, "Sky coordinates".
        The centroid is given in both frames.
    transform : {"ft", "gl", "hybrid"}
        Whose transform the tests are made of. "ft": that of the stamp; galaxies with
        missing pixels are flagged `MASKED`. "gl": that of a Gauss-Laguerre fit to the
        observed image, weighted by `ivar`. "hybrid": that of the stamp, with missing pixels
        filled from such a fit, which is flagged `FILLED`.
    order : int
        Of the fits, 0 to 20: they have (order + 1)(order + 2)/2 coefficients.
    size : float, optional
        Fixes the size sigma of the Gaussian part of the weight, in pixels or units of the
        sky, in the frame where the galaxy is round. By default it is matched to each galaxy.
    padding : int
        Makes the k grid finer by this factor for all galaxies. Without it only the most
        elongated are measured on a grid twice as fine, and with "gl" all.
    max_iter : int
        Steps of the root finder.
    chunk_size : int, optional
        Galaxies that are in work together. It bounds the memory and changes no number
        beyond rounding. By default what fits 128 MB.

    Returns
    -------
    ShapeResult
        Row i belongs to stamp i; an empty batch gives an empty result. A galaxy with a
        negative or infinite `ivar` or a NaN in it is flagged `NON_FINITE_PIXEL`, one whose
        pixels do not carry a fit of the order `GL_FAILURE`, one without pixels `MASKED`, one
        whose own Jacobian is not finite or singular `BAD_JACOBIAN`.

    Raises
    ------
    FdntTypeError, NamespaceError
        If `stamps` is no array or `psf` no `Psf`; if they, `noise_variance`, `ivar` or
        `jacobian` are of two libraries, dtypes or devices.
    ShapeMismatchError
        If `stamps` has not three axes, or another number of rows than `psf` has PSFs, or
        `ivar` or `jacobian` another shape.
    FdntValueError, RangeError
        If a number is out of range, no stamp has as many pixels as the fit coefficients,
        more than one of `noise_variance`, `ivar` and `noise_power` is given, `noise_power` is
        no spectrum, there is no such transform, the one Jacobian of all is singular, or the
        PSF is so wide that the stamps resolve nothing.

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
    >>> shapes.e[:, 0].round(6)  # before the PSF, of variance 4: (14 - 8)/(14 + 8)
    array([0.272727])
    """
    xp, stamps = check_stamps(stamps, psf)
    n_gal = int(stamps.shape[0])
    pixels = check_pixels(xp, stamps, noise_variance, ivar, noise_power)
    _check_transform(transform, order, stamps)
    check_options(size=size, padding=padding, chunk_size=chunk_size)
    check_count("max_iter", max_iter, 0)
    sky = None if jacobian is None else sky_frame(xp, stamps, n_gal, jacobian)
    if n_gal == 0:
        empty = ShapeResult.unmeasured(stamps)
        return empty if sky is None else sky.on_sky(empty, pixels.stamp_shape)

    seen = psf if sky is None else sky.seen_by(psf)
    fixed = _fixed_size(xp, stamps, size, sky)
    job = prepare(xp, stamps, seen, padding=padding, size=fixed, max_iter=max_iter, rough=True)
    n_chunk = chunk_size or galaxies_in_memory(job, pixels, transform, order)
    chunks = job.chunks(n_gal, n_chunk, searched=True)
    result = ShapeResult.concat(
        [_measure_chunk(job.of(part), pixels.take(part.rows), transform, order) for part in chunks]
    )
    place = in_order(chunks)
    result = result if place is None else result.take(place)
    return result if sky is None else sky.on_sky(result, pixels.stamp_shape)


def _fixed_size(
    xp: ModuleType, stamps: Array, size: float | None, sky: SkyFrame | None
) -> Array | None:
    """Return the size of the weight that was given, in pixels; one, or one for each galaxy."""
    if size is None:
        return None
    if sky is None:
        return xp.full((1,), float(size), dtype=stamps.dtype, device=device_of(stamps))
    return float(size) / sky.scale


def _measure_chunk(job: Job, pixels: Pixels, transform: Transform, order: int) -> ShapeResult:
    """Choose what the tests are made of, and measure."""
    masked_fraction = pixels.masked_fraction()
    pixels, flags = pixels.screened(job.psf)
    if transform == "gl":
        result = _measure_fits(job, pixels, flags, order)
    elif pixels.ivar is None:
        result = _measure_source(job, WhiteStamps(pixels=pixels), pixels, flags)
    elif transform == "hybrid":
        result = _measure_filled(job, pixels, flags, order)
    else:
        xp = array_namespace(flags=flags)
        masked = (flags == 0) & (masked_fraction > 0)
        flags = xp.where(masked, xp.full_like(flags, int(Flag.MASKED)), flags)
        # What is left of a stamp may be next to nothing, and its numbers beyond all range.
        pixels = pixels.kept(flags == 0)
        result = _measure_source(job, UnevenStamps(pixels=pixels), pixels, flags)
    return replace(result, masked_fraction=masked_fraction)


def _measure_fits(job: Job, pixels: Pixels, flags: Array, order: int) -> ShapeResult:
    """Measure the transforms of Gauss-Laguerre fits."""
    xp = array_namespace(flags=flags)
    fit = fit_pixels_of(pixels, order)
    flags = xp.where(flags == 0, fit.flags, flags)
    source = FittedStamps(fit=fit.harmless(), pixels=pixels)
    # The functions reach out of the stamp, and a coarser grid would fold them back in.
    return _measure_on(job, job.fine, source, pixels.stamp_shape, flags)[0]


def _measure_filled(job: Job, pixels: Pixels, flags: Array, order: int) -> ShapeResult:
    """Measure stamps, and fit and fill those with missing pixels before."""
    xp = array_namespace(flags=flags)
    masked = (flags == 0) & (pixels.masked_fraction() > 0)
    # A host read: how many are to be fitted decides the size of that batch.
    n_masked = count_true(masked)
    place = xp.argsort(xp.astype(~masked, xp.int32), stable=True)
    parts = []
    if n_masked > 0:
        rows = place[:n_masked]
        gappy = pixels.take(rows)
        fit = fit_pixels_of(gappy, order)
        source = filled_stamps(gappy, fit)
        reasons = xp.where(fit.usable, xp.full_like(fit.flags, int(Flag.FILLED)), fit.flags)
        parts.append(_measure_source(job.take(rows), source, gappy, reasons))
    if n_masked < int(flags.shape[0]):
        rows = place[n_masked:]
        whole = pixels.take(rows)
        reasons = xp.take(flags, rows, axis=0)
        parts.append(_measure_source(job.take(rows), UnevenStamps(pixels=whole), whole, reasons))
    return ShapeResult.concat(parts).take(xp.argsort(place))


def _measure_source(job: Job, source: Source, pixels: Pixels, flags: Array) -> ShapeResult:
    """Measure on the coarse grid, then the few that need it on the fine one."""
    xp = array_namespace(flags=flags)
    shape = pixels.stamp_shape
    measurable = xp.bitwise_and(flags, xp.full_like(flags, ~int(Flag.FILLED))) == 0
    # Whoever is not there by then is measured again, and need not hold up a small batch.
    few = replace(job, max_iter=min(job.max_iter, COARSE_STEPS))
    result, root, finer = _measure_on(few, job.coarse, source, shape, flags, near=TWO_STEPS_OFF)
    finer = finer & measurable
    # A host read: how many need the fine grid decides the size of that batch.
    n_fine = count_true(finer)
    if n_fine == 0:
        return result
    order = xp.argsort(xp.astype(~finer, xp.int32), stable=True)
    parts = []
    per_chunk = max(1, source.n_gal // FINER**2)
    for start in range(0, n_fine, per_chunk):
        rows = order[start : min(start + per_chunk, n_fine)]
        reasons = xp.take(flags, rows, axis=0) + int(Flag.FINE_GRID)
        again, _, _ = _measure_on(
            *(job.take(rows), job.fine, source.take(rows), shape, reasons),
            start=xp.take(root.x, rows, axis=0),
        )
        parts.append(again)
    merged = ShapeResult.concat([*parts, result.take(order[n_fine:])])
    return merged.take(xp.argsort(order))


def _measure_on(
    job: Job,
    grid: KGrid,
    source: Source,
    stamp_shape: tuple[int, int],
    flags: Array,
    *,
    near: float | None = None,
    start: Array | None = None,
) -> tuple[ShapeResult, RootResult, Array]:
    """Measure on one grid; return shapes, roots, and which a finer grid should measure again.

    The search begins at `start`, by default near the root under a rougher weight. It ends
    where the tests are below `near`, by default where one Newton step is enough. Two are
    taken: the first without an evaluation of its own, as the noise evaluates the tests there
    anyhow, and the second from there. Where that is a long one, there is no success.
    """
    xp = array_namespace(flags=flags)
    inverse_transfer = job.psf.inverse_transfer(grid)
    galaxies = source.deconvolved(inverse_transfer, grid)
    fixed = None if job.size is None else xp.broadcast_to(job.size**2, flags.shape)
    tests = NullTests(
        grid=grid, galaxies=galaxies, weight=job.weight, length=job.length, fixed_width=fixed
    )
    start = rough_root(job, tests, min(stamp_shape)) if start is None else start
    near = one_step_off(start) if near is None else near
    root = stepped(search(tests, start, max_iter=job.max_iter, near=near))
    eta, centroid = solution_of(tests, root)
    noise = source.noise(tests, eta, centroid, inverse_transfer)
    root = looked_at(root, *tests.scaled(eta, noise.tests, noise.matched))
    result = describe_with(tests, root, noise, stamp_shape=stamp_shape, flags=flags)
    return result, root, (squeezed(eta, job.weight.frame) > FINE_ABOVE) | ~root.success


def _check_transform(transform: str, order: int, stamps: Array) -> None:
    """Refuse a transform that there is not, and an order that the stamps cannot carry."""
    if transform not in TRANSFORMS:
        known = ", ".join(repr(name) for name in TRANSFORMS)
        raise FdntValueError(f"no transform {transform!r}; known are {known}")
    if transform == "ft":
        check_order(order)
    else:
        check_fit_order(order, stamps)


def galaxies_in_memory(job: Job, pixels: Pixels, transform: Transform, order: int) -> int:
    """Return how many galaxies fit the memory of a chunk."""
    ny, nx = pixels.stamp_shape
    grid = job.fine if transform == "gl" else job.coarse
    n_coef = n_coefficients(order)
    more = 0
    if transform == "gl":
        more = 3 * n_coef**2 + (n_coef + 6 * N_FUNCTIONALS) * grid.n_k
    elif pixels.ivar is not None:
        more = 8 * N_FUNCTIONALS * ny * nx + 6 * N_FUNCTIONALS * grid.n_k
        more += 3 * n_coef**2 + n_coef * ny * nx if transform == "hybrid" else 0
    return galaxies_at_once(grid, pixels.stamps, more, only_tests=more == 0)
