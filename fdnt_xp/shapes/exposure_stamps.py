"""The stamps of many exposures: whose they are, where their objects lie, what they hold.

Objects with equally many stamps are taken together, as many as fit the memory, so that a
batch of them is rectangular.
"""

from __future__ import annotations

import numbers
from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Final

import numpy as np

from fdnt_xp.arrays import (
    Array,
    array_namespace,
    as_floating,
    device_of,
    require_dtype,
    to_numpy,
)
from fdnt_xp.errors import FdntTypeError, FdntValueError, RangeError, ShapeMismatchError
from fdnt_xp.flags import Flag
from fdnt_xp.fourier.jacobian import pixel_scale, wave_frame
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.nulltests.exposures import Exposures, by_object, spread_over_stamps
from fdnt_xp.shapes.exposure_sources import StampSources, missing_fraction, with_gaps_filled
from fdnt_xp.shapes.job import check_count
from fdnt_xp.shapes.pixels import Pixels, check_pixels
from fdnt_xp.shapes.sky import SkyFrame, sky_frame

_NAMED_AT_MOST: Final = 1_000_000
_NAMED_PER_STAMP: Final = 100
"""Objects beyond which, unless it is said how many there are, their numbers are no rows."""
_BANDS_AT_MOST: Final = 1000
"""Each has a column in the row of every object."""


@dataclass(frozen=True, kw_only=True)
class ExposureStamps:
    """All stamps of a call.

    Parameters
    ----------
    pixels : Pixels
    object_index : array of int64, shape (n_stamp,)
    n_objects : int
    origin : array, shape (n_stamp, 2)
        Pixels from the centre of the stamp; 0 where it is not on the stamp.
    sky : SkyFrame, optional
        Absent where the pixels are the sky.
    flags : array, shape (n_stamp,), int32
        What is known before a pixel is looked at.
    variance_known : bool
        Whether stamps have a noise variance.
    band : array of int64, shape (n_stamp,), optional
    n_bands : int
    """

    pixels: Pixels
    object_index: Array
    n_objects: int
    origin: Array
    sky: SkyFrame | None
    flags: Array
    variance_known: bool
    band: Array | None
    n_bands: int

    @property
    def n_stamp(self) -> int:
        """Number of stamps."""
        return int(self.origin.shape[0])

    def seen_by(self, psf: Psf) -> Psf:
        """Return the PSF with weights that are round on the sky."""
        return psf if self.sky is None else self.sky.seen_by(psf)

    def fixed_size(self, size: float | None) -> Array | None:
        """Return the size of the weight that was given, in pixels; one, or one for each stamp."""
        if size is None:
            return None
        xp = array_namespace(origin=self.origin)
        one = xp.full((1,), float(size), dtype=self.origin.dtype, device=device_of(self.origin))
        return one if self.sky is None else one / self.sky.scale

    def without_stamps(self) -> Array:
        """Return the numbers of the objects that have no stamp."""
        xp = array_namespace(origin=self.origin)
        counts = np.bincount(to_numpy(self.object_index), minlength=self.n_objects)
        none = np.flatnonzero(counts == 0)
        return xp.asarray(none, dtype=xp.int64, device=device_of(self.origin))

    def batches(self, n_at_once: int) -> Iterator[ObjectBatch]:
        """Yield all objects with stamps, in batches of equally many stamps each.

        `n_at_once` stamps are in work together, more only where one object has more.
        """
        xp = array_namespace(origin=self.origin)
        like = {"dtype": xp.int64, "device": device_of(self.origin)}
        index = to_numpy(self.object_index)
        order = np.argsort(index, kind="stable")
        counts = np.bincount(index, minlength=self.n_objects)
        firsts = np.cumsum(counts) - counts
        for n_each in (int(n) for n in np.unique(counts) if n > 0):
            objects = np.flatnonzero(counts == n_each)
            n_obj = max(1, n_at_once // n_each)
            for start in range(0, len(objects), n_obj):
                some = objects[start : start + n_obj]
                rows = order[firsts[some][:, None] + np.arange(n_each)]
                yield self._batch(
                    xp.asarray(some, **like), xp.asarray(rows.reshape(-1), **like), n_each
                )

    def _batch(self, objects: Array, rows: Array, n_each: int) -> ObjectBatch:
        xp = array_namespace(rows=rows)
        jacobian, regular = None, xp.ones_like(rows, dtype=xp.bool)
        if self.sky is not None:
            every = (self.n_stamp, *(int(n) for n in self.sky.jacobian.shape[1:]))
            jacobian = xp.take(xp.broadcast_to(self.sky.jacobian, every), rows, axis=0)
            regular = xp.take(xp.broadcast_to(self.sky.regular, every[:1]), rows, axis=0)
        flags = xp.take(self.flags, rows, axis=0)
        flags = xp.where(regular, flags, xp.full_like(flags, int(Flag.BAD_JACOBIAN)))
        origin = xp.take(self.origin, rows, axis=0)
        unit, exposures = _on_sky(origin, jacobian, regular, n_each)
        return ObjectBatch(
            objects=objects,
            rows=rows,
            unit=unit,
            exposures=exposures,
            pixels=self.pixels.take(rows),
            flags=flags,
            band=None if self.band is None else xp.take(self.band, rows, axis=0),
        )


@dataclass(frozen=True, kw_only=True)
class ObjectBatch:
    """Objects with equally many stamps, which are in their order.

    Parameters
    ----------
    objects, rows : array of int64, shape (n_obj,) and (n_stamp,)
        Their numbers, and those of their stamps.
    unit : array, shape (n_obj,)
        Of lengths on the sky, about a pixel.
    exposures : Exposures
        Without weights.
    pixels, flags, band
        As in `ExposureStamps`, of these stamps.
    """

    objects: Array
    rows: Array
    unit: Array
    exposures: Exposures
    pixels: Pixels
    flags: Array
    band: Array | None

    def sources(self, psf: Psf, order: int | None) -> tuple[StampSources, Array, Array]:
        """Screen the stamps, and fill gaps from fits of an order if there is one.

        Returns
        -------
        sources : StampSources
        flags : array, shape (n_stamp,), int32
            Why stamps do not count.
        missing : array, shape (n_stamp,)
            Part of the pixels that is missing.
        """
        pixels, found = self.pixels.screened(psf)
        xp = array_namespace(found=found)
        flags = xp.where(self.flags == 0, found, self.flags)
        missing = xp.zeros_like(pixels.variance)
        if pixels.ivar is not None:
            missing = missing_fraction(pixels.ivar, self.exposures.origin)
        gappy = (flags == 0) & (missing > 0)
        if order is None or pixels.ivar is None:
            flags = xp.where(gappy, xp.full_like(flags, int(Flag.MASKED)), flags)
            return StampSources.of(pixels.kept(flags == 0)), flags, missing
        sources, flags = with_gaps_filled(pixels, gappy, flags, order)
        return sources, flags, missing

    def look_variance(self) -> Array:
        """Return a variance of each stamp's pixels, shape (n_stamp,); 1 where unknown.

        Where pixels differ, the inverse of their mean `ivar`.
        """
        variance, ivar = self.pixels.variance, self.pixels.ivar
        xp = array_namespace(variance=variance)
        one = xp.ones_like(variance)
        if ivar is not None:
            fair = xp.isfinite(ivar) & (ivar > 0)
            total = xp.sum(xp.sum(xp.where(fair, ivar, xp.zeros_like(ivar)), axis=-1), axis=-1)
            count = xp.sum(xp.sum(xp.astype(fair, ivar.dtype), axis=-1), axis=-1)
            variance = count / xp.where(total > 0, total, one)
        return xp.where(xp.isfinite(variance) & (variance > 0), variance, one)


def _on_sky(
    origin: Array, jacobian: Array | None, regular: Array, n_each: int
) -> tuple[Array, Exposures]:
    """Return the unit of lengths of each object, and its exposures, without weights yet."""
    xp = array_namespace(origin=origin)
    n_stamp = int(origin.shape[0])
    zero = xp.zeros_like(origin[:, 0])
    unit = xp.ones_like(by_object(zero, n_each)[:, 0])
    one = xp.eye(2, dtype=origin.dtype, device=device_of(origin))
    to_stamp = xp.broadcast_to(one[None, :, :], (n_stamp, 2, 2))
    if jacobian is not None:
        # The mean side of a pixel, over those that have one.
        there = by_object(xp.astype(regular, origin.dtype), n_each)
        total = xp.sum(there * by_object(pixel_scale(jacobian), n_each), axis=1)
        n = xp.sum(there, axis=1)
        unit = xp.where(n > 0, total / xp.where(n > 0, n, unit), unit)
        scale = spread_over_stamps(unit[:, None], n_each)[:, :, None]
        keep = regular[:, None, None]
        to_stamp = xp.where(keep, xp.matrix_transpose(wave_frame(jacobian / scale)), to_stamp)
    return unit, Exposures(n_each=n_each, origin=origin, to_stamp=to_stamp, factor=zero, share=zero)


def check_exposures(
    xp: ModuleType,
    stamps: Array,
    *,
    object_index: Array,
    n_objects: int | None,
    origin: Array | None,
    jacobian: Array | None,
    noise_variance: float | Array | None,
    ivar: Array | None,
    band: Array | None,
) -> ExposureStamps:
    """Refuse what does not fit the stamps, and make those harmless that cannot be used."""
    n_stamp = int(stamps.shape[0])
    index = _checked_numbers(xp, stamps, object_index, "object_index")
    highest = int(xp.max(index)) if n_stamp else -1
    if n_objects is None and highest >= max(_NAMED_AT_MOST, _NAMED_PER_STAMP * n_stamp):
        raise FdntValueError(
            f"object_index goes up to {highest}, with {n_stamp} stamps: it counts objects from 0, "
            "a row of the result for each; for names of another kind give "
            "unique(names, return_inverse=True)[1], or say n_objects"
        )
    n_objects = highest + 1 if n_objects is None else n_objects
    check_count("n_objects", n_objects, 0)
    n_objects = int(n_objects)
    if highest >= n_objects:
        raise FdntValueError(
            f"object_index goes up to {highest}, but n_objects is {n_objects}: it must be below"
        )
    pixels = check_pixels(xp, stamps, noise_variance, ivar)
    sky = None if jacobian is None else sky_frame(xp, stamps, n_stamp, jacobian)
    place, on_stamp = _checked_origin(xp, stamps, origin)
    flags = xp.zeros_like(index, dtype=xp.int32)
    known = ivar is not None or not (noise_variance is None or _is_zero(noise_variance))
    if known:
        good = xp.isfinite(pixels.variance) & (pixels.variance > 0)
        flags = xp.where(good, flags, xp.full_like(flags, int(Flag.BAD_NOISE)))
    flags = xp.where(on_stamp, flags, xp.full_like(flags, int(Flag.OFF_IMAGE)))
    bands = None if band is None else _checked_numbers(xp, stamps, band, "band")
    n_bands = 0 if bands is None or n_stamp == 0 else int(xp.max(bands)) + 1
    if n_bands > _BANDS_AT_MOST:
        raise RangeError("band", n_bands - 1, 0, _BANDS_AT_MOST - 1)
    return ExposureStamps(
        pixels=pixels,
        object_index=index,
        n_objects=n_objects,
        origin=place,
        sky=sky,
        flags=flags,
        variance_known=known,
        band=bands,
        n_bands=n_bands,
    )


def _is_zero(noise_variance: float | Array) -> bool:
    return isinstance(noise_variance, numbers.Real) and noise_variance == 0


def _checked_numbers(xp: ModuleType, stamps: Array, numbers: Array, name: str) -> Array:
    """Return numbers of something from 0 up, one for each stamp, as int64."""
    array_namespace(stamps=stamps, **{name: numbers})
    if not xp.isdtype(numbers.dtype, "integral"):
        raise FdntTypeError(f"{name} must hold whole numbers, but has dtype {numbers.dtype}")
    n_stamp = int(stamps.shape[0])
    if tuple(numbers.shape) != (n_stamp,):
        raise ShapeMismatchError(
            f"{name} must have the shape ({n_stamp},), one for each stamp, not "
            f"{tuple(numbers.shape)}"
        )
    numbers = xp.astype(numbers, xp.int64)
    if n_stamp and int(xp.min(numbers)) < 0:
        raise FdntValueError(f"{name} must not be negative, but holds {int(xp.min(numbers))}")
    return numbers


def _checked_origin(xp: ModuleType, stamps: Array, origin: Array | None) -> tuple[Array, Array]:
    """Return where objects are, pixels from the centre of the stamp, and whether on it."""
    n_stamp, ny, nx = (int(n) for n in stamps.shape)
    like = {"dtype": stamps.dtype, "device": device_of(stamps)}
    if origin is None:
        zero = xp.zeros((n_stamp, 2), **like)
        return zero, xp.ones_like(zero[:, 0], dtype=xp.bool)
    array_namespace(stamps=stamps, origin=origin)
    origin = as_floating(xp, origin, "origin")
    require_dtype(stamps.dtype, origin=origin)
    if tuple(origin.shape) != (n_stamp, 2):
        raise ShapeMismatchError(
            f"origin must have the shape ({n_stamp}, 2), (x, y) on each stamp, not "
            f"{tuple(origin.shape)}"
        )
    place = origin - xp.asarray([0.5 * (nx - 1), 0.5 * (ny - 1)], **like)
    half = xp.asarray([0.5 * nx, 0.5 * ny], **like)
    # Not `>`: a position may be NaN.
    on_stamp = xp.all(xp.abs(place) <= half, axis=-1)
    return xp.where(on_stamp[:, None], place, xp.zeros_like(place)), on_stamp
