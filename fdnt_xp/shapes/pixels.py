"""The stamps of a call, what is known of their noise, and which pixels are missing."""

from __future__ import annotations

import math
import numbers
from dataclasses import dataclass, replace
from types import ModuleType

from fdnt_xp.arrays import Array, Rows, array_namespace, as_floating, require_dtype, rows_of
from fdnt_xp.errors import FdntValueError, RangeError, ShapeMismatchError
from fdnt_xp.flags import Flag
from fdnt_xp.fourier.noise import PixelNoise
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.job import screen


@dataclass(frozen=True, kw_only=True)
class Pixels:
    """Stamps with white or correlated noise, or with an inverse variance for each pixel.

    Parameters
    ----------
    stamps : array, shape (n_gal, ny, nx)
    variance : array, shape (n_gal,)
        Of the noise of a pixel; NaN where unknown. 1 where there is an `ivar`.
    ivar : array, shape (n_gal, ny, nx), optional
        0 where a pixel is missing.
    correlated : PixelNoise, optional
        Stationary noise whose pixels are not independent, as it is on a plane without end;
        `variance` is its variance.
    """

    stamps: Array
    variance: Array
    ivar: Array | None = None
    correlated: PixelNoise | None = None

    @property
    def stamp_shape(self) -> tuple[int, int]:
        """(ny, nx)."""
        return int(self.stamps.shape[1]), int(self.stamps.shape[2])

    def take(self, rows: Rows) -> Pixels:
        """Return the given galaxies."""
        return Pixels(
            stamps=rows_of(self.stamps, rows),
            variance=rows_of(self.variance, rows),
            ivar=None if self.ivar is None else rows_of(self.ivar, rows),
            correlated=None if self.correlated is None else self.correlated.take(rows),
        )

    def kept(self, keep: Array) -> Pixels:
        """Return the same with stamps of zeros where `keep`, shape (n_gal,), is False."""
        xp = array_namespace(keep=keep)
        # A host read: a copy of all stamps costs more, and hardly ever is one needed.
        if bool(xp.all(keep)):
            return self
        zero = xp.zeros_like(self.stamps)
        return replace(self, stamps=xp.where(keep[:, None, None], self.stamps, zero))

    def masked_fraction(self) -> Array:
        """Return the part of the pixels that is missing, shape (n_gal,)."""
        xp = array_namespace(stamps=self.stamps)
        if self.ivar is None:
            return xp.zeros_like(self.stamps[:, 0, 0])
        missing = xp.astype(~(self.ivar > 0), self.stamps.dtype)
        return xp.mean(xp.mean(missing, axis=-1), axis=-1)

    def screened(self, psf: Psf) -> tuple[Pixels, Array]:
        """Return pixels that do no harm, 0 where missing, and why some cannot be measured.

        Returns
        -------
        pixels : Pixels
            With `ivar >= 0` and finite.
        flags : array, shape (n_gal,), int32
        """
        if self.ivar is None:
            stamps, flags = screen(self.stamps, psf)
            return replace(self, stamps=stamps), flags
        xp = array_namespace(stamps=self.stamps)
        fair = xp.all(xp.all(xp.isfinite(self.ivar) & (self.ivar >= 0), axis=-1), axis=-1)
        present = (self.ivar > 0) & fair[:, None, None]
        ivar = xp.where(present, self.ivar, xp.zeros_like(self.ivar))
        stamps, flags = screen(self.stamps, psf, present)
        none = fair & ~xp.any(xp.any(present, axis=-1), axis=-1)
        for reason, holds in ((Flag.MASKED, none), (Flag.NON_FINITE_PIXEL, ~fair)):
            flags = xp.where(holds, xp.full_like(flags, int(reason)), flags)
        return Pixels(stamps=stamps, variance=self.variance, ivar=ivar), flags


def check_pixels(
    xp: ModuleType,
    stamps: Array,
    noise_variance: float | Array | None,
    ivar: Array | None,
    noise_power: Array | None = None,
) -> Pixels:
    """Refuse noise that does not fit the stamps."""
    if noise_power is not None:
        if noise_variance is not None or ivar is not None:
            raise FdntValueError(
                "noise_power cannot be given with noise_variance or ivar: its mean is the variance"
            )
        correlated = power_noise(xp, stamps, noise_power).without_window()
        return Pixels(stamps=stamps, variance=correlated.variance, correlated=correlated)
    if ivar is None:
        return Pixels(stamps=stamps, variance=noise_column(xp, noise_variance, stamps))
    if noise_variance is not None:
        raise FdntValueError(
            "noise_variance and ivar cannot both be given: ivar is 1/variance, pixel by pixel"
        )
    array_namespace(stamps=stamps, ivar=ivar)
    ivar = as_floating(xp, ivar, "ivar")
    require_dtype(stamps.dtype, ivar=ivar)
    if ivar.shape != stamps.shape:
        raise ShapeMismatchError(
            f"ivar must have the shape of the stamps, {tuple(stamps.shape)}, not "
            f"{tuple(ivar.shape)}"
        )
    return Pixels(stamps=stamps, variance=xp.ones_like(stamps[:, 0, 0]), ivar=ivar)


def power_noise(xp: ModuleType, stamps: Array, power: Array) -> PixelNoise:
    """Return the noise of a power spectrum, (ny, nx) or (n_gal, ny, nx); refuse what is none."""
    array_namespace(stamps=stamps, noise_power=power)
    power = as_floating(xp, power, "noise_power")
    require_dtype(stamps.dtype, noise_power=power)
    n_gal, ny, nx = (int(n) for n in stamps.shape)
    if power.shape not in ((ny, nx), (n_gal, ny, nx)):
        raise ShapeMismatchError(
            f"noise_power must have the shape ({ny}, {nx}) or ({n_gal}, {ny}, {nx}), "
            f"not {tuple(power.shape)}"
        )
    power = xp.reshape(power, (-1, ny, nx))
    fair = xp.all(xp.all(xp.isfinite(power) & (power >= 0), axis=-1), axis=-1)
    some = xp.any(xp.any(power > 0, axis=-1), axis=-1)
    if not bool(xp.all(fair & some)):
        raise FdntValueError("noise_power must be finite, not negative, and not all 0")
    # -k is at the index (-j) mod n, along both axes.
    mirrored = xp.roll(xp.flip(power, axis=(-2, -1)), (1, 1), axis=(-2, -1))
    if int(power.shape[0]) and not bool(xp.all(xp.abs(power - mirrored) <= 1e-3 * xp.max(power))):
        raise FdntValueError(
            "noise_power must be the same at k and -k, in the order of the FFT (k = 0 first)"
        )
    return PixelNoise.of_power(power, n_gal)


def noise_column(xp: ModuleType, noise_variance: float | Array | None, stamps: Array) -> Array:
    """Return the noise variance of each galaxy, NaN where unknown; shape (n_gal,)."""
    like = stamps[:, 0, 0]
    if noise_variance is None:
        return xp.full_like(like, float("nan"))
    if isinstance(noise_variance, numbers.Real):
        number = float(noise_variance)
        if not (math.isfinite(number) and number >= 0):
            raise RangeError("noise_variance", number, 0.0, None)
        return xp.full_like(like, number)
    array_namespace(stamps=stamps, noise_variance=noise_variance)
    noise = as_floating(xp, noise_variance, "noise_variance")
    require_dtype(stamps.dtype, noise_variance=noise)
    if noise.shape not in ((), like.shape):
        raise ShapeMismatchError(
            f"noise_variance must be a number or have the shape {tuple(like.shape)}, "
            f"not {tuple(noise.shape)}"
        )
    return xp.broadcast_to(noise, like.shape)
