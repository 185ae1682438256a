"""The shape of each object from all its exposures, whatever their PSFs, pixels and noise.

stamps, in batches of whole objects  shapes.exposure_stamps
       -> transforms, divided by T   shapes.exposure_sources, stamp by stamp
       -> centroids and weights      shapes.first_look
       -> root of the summed tests   nulltests.exposures, object by object
       -> covariance, fluxes, flags  shapes.solution
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from fdnt_xp.arrays import Array, array_namespace, device_of
from fdnt_xp.errors import FdntValueError
from fdnt_xp.flags import Flag
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.nulltests.exposures import ExposureTests, by_object
from fdnt_xp.shapes.centroid import wide_weight
from fdnt_xp.shapes.exposure_results import ExposureResult, ObjectShapes
from fdnt_xp.shapes.exposure_solution import SeenObjects, solve_objects, stamp_tests
from fdnt_xp.shapes.exposure_stamps import ExposureStamps, ObjectBatch, check_exposures
from fdnt_xp.shapes.first_look import look
from fdnt_xp.shapes.gl_fit import check_fit_order
from fdnt_xp.shapes.job import Job, check_count, check_options, check_stamps, prepare
from fdnt_xp.shapes.laguerre import check_order
from fdnt_xp.shapes.measure import galaxies_in_memory
from fdnt_xp.shapes.results import ShapeResult

Fill: TypeAlias = Literal["ft", "hybrid"]


def measure_exposures(
    stamps: Array,
    psf: Psf,
    *,
    object_index: Array,
    n_objects: int | None = None,
    origin: Array | None = None,
    jacobian: Array | None = None,
    noise_variance: float | Array | None = None,
    ivar: Array | None = None,
    band: Array | None = None,
    transform: Fill = "ft",
    order: int = 12,
    size: float | None = None,
    padding: int = 1,
    max_iter: int = 50,
    chunk_size: int | None = None,
) -> ExposureResult:
    """Measure the shape of each object from all of its exposures together.

    The null tests of an object are the sums of those of its stamps, weighted by (S/N)², with
    one shape, one centroid and one size of the weights on the sky; each stamp has its own PSF,
    pixels and noise, and bands need not show one profile. Nothing raises for the sake of a
    stamp or an object: stamps that cannot be used are left out and flagged, objects without
    a shape are NaN.

    Parameters
    ----------
    stamps : array, shape (n_stamp, ny, nx)
        All exposures of all objects, in any order, backgrounds taken off. Smaller ones are
        padded to one shape, with `ivar` 0.
    psf : Psf
        One for all stamps, one for each, or with a `psf_index` for each.
    object_index : array of integers, shape (n_stamp,)
        The object on each stamp, from 0.
    n_objects : int, optional
        Objects there are; some may have no stamp. By default as many as `object_index` names.
    origin : array, shape (n_stamp, 2), optional
        (x, y) in pixels, 0-based as centroids are, of one and the same point of the sky on
        all stamps of an object: its nominal position. By default the middle of the stamp.
    jacobian : array, shape (2, 2) or (n_stamp, 2, 2), optional
        `d(u, v)/d(x, y)`, as `measure_shapes` has it. The unit matrix by default.
    noise_variance : float or array, shape (n_stamp,), optional
        Variance of the white noise of a pixel. Without it, and without `ivar`, all stamps are
        taken for equally noisy, and there are no errors.
    ivar : array, shape (n_stamp, ny, nx), optional
        In its place the inverse variance of each pixel, 0 where it is missing.
    band : array of integers, shape (n_stamp,), optional
        Band of each stamp, from 0: fluxes and S/N are then given for each as well.
    transform : {"ft", "hybrid"}
        What becomes of stamps with missing pixels. "ft": they are left out, `MASKED`.
        "hybrid": they are filled from a Gauss-Laguerre fit of `order`, and the object flagged
        `FILLED`. The border around a rectangle of pixels that are there, with `origin`
        within a pixel of its middle, is padding and taken as sky, not as missing.
    order : int
        As `measure_shapes` has it.
    size : float, optional
        Fixes the size sigma of the weights, on the sky. By default it is the mean of those
        that match the galaxy on each stamp.
    padding, max_iter
        As `measure_shapes` has them.
    chunk_size : int, optional
        Stamps that are in work together, in whole objects, one at least. It bounds the memory
        and changes no number beyond rounding. By default what fits 128 MB.

    Returns
    -------
    ExposureResult
        Row i is object i, and the record of stamps in their order. Stamps are left out with
        `NON_FINITE_PIXEL`, `BAD_PSF`, `BAD_JACOBIAN`, `BAD_NOISE`, `MASKED`, `GL_FAILURE`, with
        `OFF_IMAGE` where `origin` is not on the stamp, and `NO_SIGNAL` where it is constant or
        nothing positive is seen. Objects with none left are flagged `NO_EXPOSURE`.

    Raises
    ------
    FdntTypeError, NamespaceError, ShapeMismatchError, FdntValueError, RangeError
        As `measure_shapes`, and if `object_index`, `band` or `origin` do not fit the stamps.

    Notes
    -----
    The weight of a stamp is the square of the S/N of t0, the scale of the tests, at a first
    look at all exposures together, and stays: the summed tests are then linear in the
    images, and vanish in the mean at the truth (docs, "Many exposures").

    Examples
    --------
    >>> import numpy as np
    >>> import fdnt_xp as fx
    >>> y, x = np.mgrid[-24:25, -24:25]
    >>> def blob(xx, yy, x0=0.0):
    ...     return np.exp(-((x - x0) ** 2 / xx + y**2 / yy) / 2.0)
    >>> stars = np.stack([blob(4.0, 4.0), blob(5.0, 4.0)])  # two exposures, other PSFs,
    >>> stamps = np.stack([blob(18.0, 12.0), blob(19.0, 12.0, 2.0)])  # and a dither
    >>> shapes = fx.measure_exposures(
    ...     stamps,
    ...     fx.Psf.from_image(stars),
    ...     object_index=np.array([0, 0]),
    ...     origin=np.array([[24.0, 24.0], [26.0, 24.0]]),
    ... )
    >>> shapes.e[:, 0].round(6)  # (14 - 8)/(14 + 8)
    array([0.272727])
    >>> shapes.n_used
    array([2], dtype=int32)
    """
    xp, stamps = check_stamps(stamps, psf)
    given = check_exposures(
        xp,
        stamps,
        object_index=object_index,
        n_objects=n_objects,
        origin=origin,
        jacobian=jacobian,
        noise_variance=noise_variance,
        ivar=ivar,
        band=band,
    )
    _check_fill(transform, order, stamps)
    check_options(size=size, padding=padding, chunk_size=chunk_size)
    check_count("max_iter", max_iter, 0)
    parts = []
    if given.n_stamp:
        seen, fixed = given.seen_by(psf), given.fixed_size(size)
        job = prepare(xp, stamps, seen, padding=padding, size=fixed, max_iter=max_iter)
        n_chunk = chunk_size or galaxies_in_memory(job, given.pixels, transform, order)
        fill, bands = order if transform == "hybrid" else None, given.n_bands
        batches = given.batches(n_chunk)
        parts = [_measure_batch(job, batch, fill, bands, n_chunk) for batch in batches]
    return _in_order(given, parts)


@dataclass(frozen=True, kw_only=True)
class _Measured:
    """A batch of objects, measured, and the flags and S/N of its stamps."""

    batch: ObjectBatch
    shapes: ObjectShapes
    flags: Array
    snr: Array


def _measure_batch(
    job: Job, batch: ObjectBatch, fill: int | None, n_bands: int, n_at_once: int
) -> _Measured:
    """Measure objects with equally many stamps: on the coarse grid, the few that need it finer."""
    job = job.take(batch.rows)
    sources, flags, missing = batch.sources(job.psf, fill)
    xp = array_namespace(flags=flags)
    shape, n_each = batch.pixels.stamp_shape, batch.exposures.n_each
    inverse_transfer = job.psf.inverse_transfer(job.coarse)
    tests = stamp_tests(job, job.coarse, sources, inverse_transfer)
    seen = look(
        tests,
        batch.exposures,
        wide_weight(job.weight, job.coarse, min(shape)),
        batch.look_variance(),
        inverse_transfer,
        flags,
        reach=0.5 * min(shape),
    )
    objects = SeenObjects(
        job=job,
        sources=sources,
        look=seen,
        unit=batch.unit,
        band=batch.band,
        n_bands=n_bands,
        stamp_shape=shape,
        n_at_once=n_at_once,
    )
    used = seen.flags == 0
    n_used = xp.sum(xp.astype(by_object(used, n_each), xp.int32), axis=1, dtype=xp.int32)
    filled = xp.any(by_object(used & sources.was_filled, n_each), axis=1)
    zero = xp.zeros_like(n_used)
    reasons = xp.where(filled, xp.full_like(zero, int(Flag.FILLED)), zero)
    reasons = xp.where(n_used > 0, reasons, xp.full_like(zero, int(Flag.NO_EXPOSURE)))
    summed = ExposureTests(stamps=tests, exposures=seen.exposures)
    shapes = solve_objects(objects, summed, inverse_transfer, reasons)
    shapes = replace(
        shapes,
        n_exposures=xp.full_like(n_used, n_each),
        n_used=n_used,
        masked_fraction=xp.mean(by_object(missing, n_each), axis=1),
    )
    return _Measured(batch=batch, shapes=shapes, flags=seen.flags, snr=seen.snr)


def _check_fill(transform: str, order: int, stamps: Array) -> None:
    """Refuse a transform that there is not, and an order that the stamps cannot carry."""
    if transform not in ("ft", "hybrid"):
        raise FdntValueError(f"no transform {transform!r} of exposures; known are 'ft', 'hybrid'")
    if transform == "ft":
        check_order(order)
    else:
        check_fit_order(order, stamps)


def _in_order(given: ExposureStamps, parts: list[_Measured]) -> ExposureResult:
    """Join batches, and objects without stamps, in the order of the caller."""
    xp = array_namespace(flags=given.flags)
    none = given.without_stamps()
    numbers = xp.concat([*(part.batch.objects for part in parts), none])
    objects = [part.shapes for part in parts]
    objects.append(_unmeasured(given, int(none.shape[0])))
    shapes = ObjectShapes.concat(objects).take(xp.argsort(numbers))
    flags, snr = given.flags, xp.zeros_like(given.origin[:, 0])
    if parts:
        place = xp.argsort(xp.concat([part.batch.rows for part in parts]))
        flags = xp.take(xp.concat([part.flags for part in parts]), place, axis=0)
        snr = xp.take(xp.concat([part.snr for part in parts]), place, axis=0)
    if not given.variance_known:
        snr = xp.full_like(snr, float("nan"))
    return ExposureResult.of(
        shapes, stamp_flags=flags, stamp_snr=snr, object_index=given.object_index
    )


def _unmeasured(given: ExposureStamps, n_obj: int) -> ObjectShapes:
    """Return objects that have no stamps."""
    like = {"dtype": given.origin.dtype, "device": device_of(given.origin)}
    xp = array_namespace(origin=given.origin)
    shapes = ShapeResult.unmeasured(xp.zeros((n_obj, 1, 1), **like))
    zero = xp.zeros_like(shapes.flags)
    shapes = replace(shapes, flags=xp.full_like(zero, int(Flag.NO_EXPOSURE)))
    bands = None
    if given.band is not None:
        bands = xp.full((n_obj, given.n_bands), float("nan"), **like)
    return ObjectShapes(
        **(shapes.columns() | {"sky_offset": shapes.centroid}),
        n_exposures=zero,
        n_used=zero,
        band_flux=bands,
        band_snr=bands,
    )
