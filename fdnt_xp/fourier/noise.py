"""Noise in a counter-sheared frame, and the noise that makes it round there.

On the deconvolved image, stationary noise has the power `V(k) = N P(k)/|T(k)|²`, with N the
pixels of the transform and P their power: the variance of a pixel, if pixels are
independent. V is no function of `|k|`, nor of `|kappa|` in the frame `kappa = S_gamma k` of
a trial shear. Gaussian noise of the power::

    V_iso(|kappa|; gamma) - V(k),   V_iso(r; gamma) = max over θ of V(S_gamma⁻¹ r (cosθ, sinθ))

is added to it, and the sum is round in that frame (docs, "Noise made round"). The maximum
is as tight as can be: twice the noise would cost 40 % in the error of the shear.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.arrays import Array, Rows, array_namespace, device_of, rows_of
from fdnt_xp.fourier.circles import CIRCLE_POINTS, CIRCLES, power_on_circles
from fdnt_xp.fourier.deviates import unit_deviates
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.fourier.interpolation import cubic_table
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.fourier.star_transform import transform_on_modes
from fdnt_xp.fourier.transform import DeconvolvedStamps, complex_like

_DIRECTIONS: Final = 64
"""Over half a turn, among which the largest V is sought."""
_MARGIN: Final = 0.004
"""By which V_iso lies above the largest V found, for what lies between the directions."""
_PSFS_AT_ONCE: Final = 64
"""Bounds the memory of the trigonometric sums."""
_LEAST_POWER: Final = 1e-3
"""Of the variance: least power of correlated noise that is told from none."""
_LAGS_KNOWN: Final = 0.25
"""Of a stamp: the lags up to which a correlation is taken as it is."""


@dataclass(frozen=True, kw_only=True)
class PixelNoise:
    """Stationary noise of the pixels of each stamp.

    Parameters
    ----------
    variance : array, shape (n_gal,)
        Of one pixel.
    correlation : array, shape (n_power, ny, nx), optional
        Correlation function over lags, 1 at no lag, which is at `[ny//2, nx//2]`; one for all
        galaxies or one for each. Pixels are independent without it.
    """

    variance: Array
    correlation: Array | None = None

    @classmethod
    def of_power(cls, power: Array, n_gal: int) -> PixelNoise:
        """Return the noise of a power spectrum.

        Parameters
        ----------
        power : array, shape (n_power, ny, nx)
            `E|FFT(noise)|²/(ny nx)` in the order of the FFT; its mean is the variance of a
            pixel. The same at k and -k.
        n_gal : int
        """
        xp = array_namespace(power=power)
        n_power, ny, nx = power.shape
        variance = xp.mean(xp.reshape(power, (n_power, -1)), axis=-1)
        half = power[:, :, : nx // 2 + 1] / variance[:, None, None]
        lags = xp.fft.irfftn(complex_like(half), s=(ny, nx), axes=(-2, -1))
        return cls(
            variance=xp.broadcast_to(variance, (n_gal,)),
            correlation=xp.roll(lags, (ny // 2, nx // 2), axis=(-2, -1)),
        )

    def take(self, rows: Rows) -> PixelNoise:
        """Return the noise of the given galaxies."""
        correlation = self.correlation
        if correlation is not None and int(correlation.shape[0]) > 1:
            correlation = rows_of(correlation, rows)
        return PixelNoise(variance=rows_of(self.variance, rows), correlation=correlation)

    def without_window(self) -> PixelNoise:
        """Return the noise as it is on a plane without end.

        A stamp of n pixels has `n - |lag|` pairs of pixels at a lag, along each axis: so
        much less of a correlation is in its periodogram, and in the correlation function that
        is made of it. That is made good, for lags up to a quarter of a stamp. Beyond, where
        there is little but the error of a measured spectrum, the correlation is led to none at
        half a stamp: with all lags made good the error of each mode would be twice that of the
        periodogram, and so is a tenth larger.
        """
        if self.correlation is None:
            return self
        along_y, along_x = (
            _without_triangle(int(n), self.correlation) for n in self.correlation.shape[1:]
        )
        return replace(self, correlation=self.correlation * (along_y[:, None] * along_x[None, :]))

    @property
    def shared(self) -> bool:
        """Whether all galaxies have noise of one shape, whatever its variance."""
        return self.correlation is None or int(self.correlation.shape[0]) == 1

    def scaled(self, factor: float) -> PixelNoise:
        """Return the noise with its power multiplied."""
        return replace(self, variance=self.variance * factor)

    def relative_power(self, grid: KGrid) -> Array:
        """Return `P(k)` over the variance on the modes of a grid, shape (n_power or 1, n_k)."""
        xp = array_namespace(variance=self.variance)
        if self.correlation is None:
            return xp.ones_like(grid.kx)[None, :]
        return xp.abs(transform_on_modes(self.correlation, grid, 1.0))


@dataclass(frozen=True, kw_only=True)
class DeconvolvedNoise:
    """Noise of deconvolved images, its power for pixels of variance 1 kept apart.

    Parameters
    ----------
    power : array, shape (n_psf, n_k)
        V of each PSF on the modes of the data; zero beyond its disc.
    ln_polar : array, shape (n_psf, n_circle, n_point)
        ln V on the circles of `Psf.ln_power`: in the angle a trigonometric polynomial, in
        the radius a cubic.
    circle_kmax, kmax : array, shape (n_psf,)
        Radius of the outermost circle, and where the weight ends; rad/pixel.
    """

    power: Array
    ln_polar: Array
    circle_kmax: Array
    kmax: Array

    @classmethod
    def behind(
        cls, psf: Psf, pixels: PixelNoise, grid: KGrid, inverse_transfer: Array
    ) -> DeconvolvedNoise:
        """Return the noise of pixels after division by the transfer function of the PSF.

        Parameters
        ----------
        psf : Psf
        pixels : PixelNoise
            Its power, like the PSF, of all galaxies or of each.
        grid : KGrid
            Of the data.
        inverse_transfer : array, shape (n_psf, n_k)
            `psf.inverse_transfer(grid)`.
        """
        xp = array_namespace(kmax=psf.kmax)
        n_power = 1 if pixels.correlation is None else int(pixels.correlation.shape[0])
        inverse_power = xp.real(inverse_transfer) ** 2 + xp.imag(inverse_transfer) ** 2
        n_modes = float(grid.shape[0] * grid.shape[1])
        if n_power > psf.n_psf:
            psf = psf.take(xp.zeros_like(pixels.variance, dtype=xp.int64))
        return cls(
            power=n_modes * pixels.relative_power(grid) * inverse_power,
            ln_polar=_ln_polar(psf, pixels) + math.log(n_modes),
            circle_kmax=psf.circle_kmax,
            kmax=psf.kmax,
        )

    def made_round(self, grid: KGrid, gamma: tuple[float, float], reach: float) -> Array:
        """Return V_iso on the modes of a counter-sheared grid, shape (n_psf, n_k).

        Parameters
        ----------
        grid : KGrid
            `KGrid.sheared(gamma)` of the grid of the data, or the `SkyGrid` of the frame.
        gamma : tuple of float
            The trial shear, eta-type.
        reach : float
            Where the weight ends, as a divisor of `kmax`: at least `exp(|gamma|/2)`. V_iso is
            given up to there.
        """
        xp = array_namespace(kmax=self.kmax)
        like = {"dtype": self.kmax.dtype, "device": device_of(self.kmax)}
        stretch, angle = _sheared_back(gamma)
        n_psf = int(self.kmax.shape[0])
        angles = np.pi * (np.arange(CIRCLE_POINTS) + 0.5) / CIRCLE_POINTS
        turned = xp.matmul(self.ln_polar, xp.asarray(_interpolation(angle, angles), **like))
        lines = xp.reshape(xp.matrix_transpose(turned), (n_psf * _DIRECTIONS, CIRCLES))
        # Along each direction, from the middle to where the weight ends.
        along = xp.asarray(stretch[:, None] * np.linspace(0.0, 1.0 / reach, CIRCLES), **like)
        t = (self.kmax / self.circle_kmax)[:, None, None] * along[None, :, :]
        t = xp.reshape(t, (n_psf * _DIRECTIONS, CIRCLES))
        row = xp.arange(n_psf * _DIRECTIONS, dtype=xp.int64, device=device_of(self.kmax))
        values = xp.reshape(cubic_table(lines).evaluate(t, row)[0], (n_psf, _DIRECTIONS, CIRCLES))
        largest = cubic_table(xp.max(values, axis=1) + math.log1p(_MARGIN))
        kappa = grid.radius * (reach / self.kmax)[:, None]
        return xp.exp(largest.evaluate(kappa, None if n_psf == 1 else row[:n_psf])[0])


@dataclass(frozen=True, kw_only=True)
class RoundNoise:
    """The synthetic noise of a batch of galaxies: drawn once, rescaled in each frame.

    Parameters
    ----------
    re, im : array, shape (n_gal, n_k)
        Deviates of unit power times the standard deviation of each galaxy's pixels.
    """

    re: Array
    im: Array

    @classmethod
    def draw(
        cls,
        identifiers: Array,
        seed: int,
        variance: Array,
        grid: KGrid,
        symmetry: Array | None = None,
    ) -> RoundNoise:
        """Draw the noise of galaxies by their names: see `unit_deviates`.

        Parameters
        ----------
        symmetry : array of integers, shape (n_gal,), optional
            0 to 3: quarter turns, counter-clockwise, by which the noise of a galaxy is turned
            about the middle of the stamp; 4 to 7: the same with its sign changed. For
            square grids.
        """
        xp = array_namespace(variance=variance)
        re, im = unit_deviates(identifiers, grid.index, seed=seed, dtype=variance.dtype)
        scale = xp.sqrt(variance)[:, None]
        if symmetry is not None:
            re, im = _turned(re, im, grid, symmetry)
            scale = xp.where(symmetry[:, None] >= 4, -scale, scale)
        return cls(re=scale * re, im=scale * im)

    def added_to(self, galaxies: DeconvolvedStamps, missing: Array) -> DeconvolvedStamps:
        """Return the galaxies with noise of a missing power, shape (n_psf, n_k), added."""
        xp = array_namespace(missing=missing)
        scale = xp.sqrt(xp.maximum(missing, xp.zeros_like(missing)))
        return DeconvolvedStamps(re=galaxies.re + scale * self.re, im=galaxies.im + scale * self.im)


def _without_triangle(n: int, like: Array) -> Array:
    """Return by what to multiply the lags `-(n//2) ...` along an axis of n pixels, shape (n,)."""
    xp = array_namespace(like=like)
    lags = xp.arange(n, dtype=like.dtype, device=device_of(like)) - float(n // 2)
    part = xp.abs(lags) / n
    t = xp.minimum(
        xp.maximum((0.5 - part) / (0.5 - _LAGS_KNOWN), xp.zeros_like(part)), xp.ones_like(part)
    )
    return 0.5 * (1.0 - xp.cos(math.pi * t)) / (1.0 - part)


def _ln_polar(psf: Psf, pixels: PixelNoise) -> Array:
    """Return ln P/|T|² on the circles of the PSFs, shape (n_psf, n_circle, n_point)."""
    xp = array_namespace(kmax=psf.kmax)
    if pixels.correlation is None:
        return -psf.ln_power
    t = xp.linspace(0.0, 1.0, CIRCLES, dtype=psf.kmax.dtype, device=device_of(psf.kmax))
    radii = psf.circle_kmax[:, None] * t[None, :]
    parts = []
    for first in range(0, max(psf.n_psf, 1), _PSFS_AT_ONCE):
        rows = slice(first, min(first + _PSFS_AT_ONCE, psf.n_psf))
        correlation = pixels.take(rows).correlation
        unit = None if psf.unit_jacobian is None else psf.unit_jacobian[rows, :, :]
        parts.append(power_on_circles(correlation, radii[rows, :], CIRCLE_POINTS, 1.0, unit))
    power = xp.sqrt(xp.concat(parts))
    # A mode without noise, as k = 0 of an image less its mean, has no logarithm.
    return xp.log(xp.maximum(power, xp.full_like(power, _LEAST_POWER))) - psf.ln_power


def _turned(re: Array, im: Array, grid: KGrid, symmetry: Array) -> tuple[Array, Array]:
    """Return deviates with each row turned by its number of quarter turns."""
    xp = array_namespace(re=re)
    source, conjugate = grid.quarter_turn
    turns = (symmetry % 4)[:, None]
    for done in range(3):
        once_re = xp.take(re, source, axis=1)
        once_im = xp.take(im, source, axis=1) * conjugate
        re, im = (xp.where(turns > done, a, b) for a, b in ((once_re, re), (once_im, im)))
    return re, im


def _sheared_back(gamma: tuple[float, float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return length and angle of `S_gamma⁻¹ (cosθ, sinθ)` over the directions θ."""
    theta = np.pi * (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS
    half = 0.5 * math.hypot(*gamma)
    series = 0.5 if half == 0.0 else 0.5 * math.sinh(half) / half
    cosh, s1, s2 = math.cosh(half), series * gamma[0], series * gamma[1]
    x = (cosh - s1) * np.cos(theta) - s2 * np.sin(theta)
    y = -s2 * np.cos(theta) + (cosh + s1) * np.sin(theta)
    return np.hypot(x, y), np.arctan2(y, x)


def _interpolation(target: NDArray[np.float64], nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix, (n_node, n_target), of trigonometric interpolation of period π."""
    n = len(nodes)
    offset = target[None, :] - nodes[:, None]
    at_node = np.abs(np.sin(offset)) < 1e-12
    tangent = np.where(at_node, 1.0, np.tan(offset))
    return np.where(at_node, 1.0, np.sin(n * offset) / (n * tangent))
