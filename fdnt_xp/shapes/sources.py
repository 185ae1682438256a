"""Where the transform of a galaxy comes from, and what noise it brings along.

Three sources of the same tests: whole stamps with stationary noise; stamps with an inverse
variance for each pixel, some of them filled from a fit; and fits alone (FDNT-GL).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

from fdnt_xp.arrays import Array, array_namespace
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.fourier.transform import DeconvolvedStamps, deconvolve
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.shapes.fdnt_gl import deconvolve_fit
from fdnt_xp.shapes.functionals import (
    correlated_covariance,
    null_test_functionals,
    on_coefficients,
    on_image,
    on_pixels,
)
from fdnt_xp.shapes.gl_fit import LaguerreFit, filled
from fdnt_xp.shapes.laguerre import pixel_positions
from fdnt_xp.shapes.pixels import Pixels
from fdnt_xp.shapes.solution import SolutionNoise, white_noise


class Source(Protocol):
    """What the null tests are made from."""

    @property
    def n_gal(self) -> int:
        """Number of galaxies."""

    def take(self, rows: Array) -> Source:
        """Return the given galaxies (integer array)."""

    def deconvolved(self, inverse_transfer: Array, grid: KGrid) -> DeconvolvedStamps:
        """Return the transforms of the galaxies before the PSF."""

    def noise(
        self, tests: NullTests, eta: Array, centroid: Array, inverse_transfer: Array
    ) -> SolutionNoise:
        """Return the noise of the tests at a solution; see `NullTests.noise`."""


@dataclass(frozen=True, kw_only=True)
class WhiteStamps:
    """Stamps with stationary noise, white or correlated: independent from mode to mode."""

    pixels: Pixels

    @property
    def n_gal(self) -> int:
        """Number of galaxies."""
        return int(self.pixels.stamps.shape[0])

    def take(self, rows: Array) -> WhiteStamps:
        """Return the given galaxies (integer array)."""
        return WhiteStamps(pixels=self.pixels.take(rows))

    def deconvolved(self, inverse_transfer: Array, grid: KGrid) -> DeconvolvedStamps:
        """Return the transforms of the galaxies before the PSF."""
        return deconvolve(self.pixels.stamps, inverse_transfer, grid)

    def noise(
        self, tests: NullTests, eta: Array, centroid: Array, inverse_transfer: Array
    ) -> SolutionNoise:
        """Return one sum over k for each covariance."""
        xp = array_namespace(eta=eta)
        inverse_power = xp.real(inverse_transfer) ** 2 + xp.imag(inverse_transfer) ** 2
        if self.pixels.correlated is not None:
            inverse_power = inverse_power * self.pixels.correlated.relative_power(tests.grid)
        ny, nx = tests.grid.shape
        return white_noise(
            tests.noise(eta, centroid, inverse_power), self.pixels.variance * float(ny * nx)
        )


@dataclass(frozen=True, kw_only=True)
class UnevenStamps:
    """Stamps with an inverse variance for each pixel, without gaps or with gaps filled.

    Parameters
    ----------
    pixels : Pixels
        With an `ivar`, and filled where that is 0.
    fit : LaguerreFit, optional
        Finite; what filled them.
    """

    pixels: Pixels
    fit: LaguerreFit | None = None

    @property
    def n_gal(self) -> int:
        """Number of galaxies."""
        return int(self.pixels.stamps.shape[0])

    def take(self, rows: Array) -> UnevenStamps:
        """Return the given galaxies (integer array)."""
        fit = None if self.fit is None else self.fit.take(rows)
        return UnevenStamps(pixels=self.pixels.take(rows), fit=fit)

    def deconvolved(self, inverse_transfer: Array, grid: KGrid) -> DeconvolvedStamps:
        """Return the transforms of the galaxies before the PSF."""
        return deconvolve(self.pixels.stamps, inverse_transfer, grid)

    def noise(
        self, tests: NullTests, eta: Array, centroid: Array, inverse_transfer: Array
    ) -> SolutionNoise:
        """Return `sum_x B_j(x) B_k(x)/ivar(x)` over the pixels that are there.

        A filled pixel is `sum_l phi_l b_l`, and b follows the pixels that are there by
        `Cov(b) phi ivar`: B has what the tests do with those, and that.
        """
        xp = array_namespace(eta=eta)
        base = tests.noise(eta, centroid, xp.ones_like(tests.grid.kx)[None, :])
        h = null_test_functionals(tests, eta, base)
        h = on_image(h, centroid, inverse_transfer, tests.grid)
        b = on_pixels(h, tests.grid, self.pixels.stamp_shape)
        ivar = xp.reshape(self.pixels.ivar, (self.n_gal, 1, -1))
        missing = ~(ivar > 0)
        if self.fit is not None:
            functions = self.fit.basis.in_x(*pixel_positions(xp, self.pixels.stamps))
            gaps = xp.where(missing, b, xp.zeros_like(b))
            beta = xp.matmul(gaps, xp.matrix_transpose(functions))
            b = b + ivar * xp.matmul(xp.matmul(beta, self.fit.coefficients_cov), functions)
        weighted = xp.where(missing, xp.zeros_like(b), b) / xp.where(
            missing, xp.ones_like(ivar), ivar
        )
        covariance = xp.matmul(weighted, xp.matrix_transpose(b))
        return SolutionNoise.of(base, covariance)


@dataclass(frozen=True, kw_only=True)
class FittedStamps:
    """Gauss-Laguerre fits of the observed images.

    Parameters
    ----------
    fit : LaguerreFit
        Finite.
    pixels : Pixels
        What was fitted; `coefficients_cov` is for its `variance`.
    """

    fit: LaguerreFit
    pixels: Pixels

    @property
    def n_gal(self) -> int:
        """Number of galaxies."""
        return int(self.pixels.stamps.shape[0])

    def take(self, rows: Array) -> FittedStamps:
        """Return the given galaxies (integer array)."""
        return FittedStamps(fit=self.fit.take(rows), pixels=self.pixels.take(rows))

    def deconvolved(self, inverse_transfer: Array, grid: KGrid) -> DeconvolvedStamps:
        """Return the transforms of the galaxies before the PSF."""
        return deconvolve_fit(self.fit, inverse_transfer, grid)

    def noise(
        self, tests: NullTests, eta: Array, centroid: Array, inverse_transfer: Array
    ) -> SolutionNoise:
        """Return `beta Cov(b) betaᵀ`.

        Where the noise is correlated, that of the pixels: b follows them by `Cov(b) phi`.
        """
        xp = array_namespace(eta=eta)
        base = tests.noise(eta, centroid, xp.ones_like(tests.grid.kx)[None, :])
        h = null_test_functionals(tests, eta, base)
        h = on_image(h, centroid, inverse_transfer, tests.grid)
        beta = on_coefficients(h, self.fit.basis, tests.grid)
        followed = xp.matmul(beta, self.fit.coefficients_cov)
        if self.pixels.correlated is None:
            covariance = xp.matmul(followed, xp.matrix_transpose(beta))
        else:
            functions = self.fit.basis.in_x(*pixel_positions(xp, self.pixels.stamps))
            covariance = correlated_covariance(
                xp.matmul(followed, functions), self.pixels.correlated, self.pixels.stamp_shape
            )
        return SolutionNoise.of(base, covariance * self.pixels.variance[:, None, None])


def filled_stamps(pixels: Pixels, fit: LaguerreFit) -> UnevenStamps:
    """Return stamps whose missing pixels are those of a fit; zeros where it is not usable."""
    fit = fit.harmless()
    whole = replace(pixels, stamps=filled(pixels.stamps, pixels.ivar, fit))
    return UnevenStamps(pixels=whole.kept(fit.usable), fit=fit)
