"""NB07: Gauss-Laguerre functions fitted to the galaxy before the PSF, through the PSF.

Nakajima and Bernstein (2007; B10 §2.1): the functions of a trial centre and shape are convolved
with the PSF and fitted to the pixels; the galaxy has the centre and shape at which
`b10 = b20 = 0`. The convolved functions are `psi~(k) T(k)`, transformed back to pixels: their
transforms are known, and a fit of pixels needs nothing to be known beyond the stamp.

The size of the basis is where `b11 = 0` in the image as it is observed, at order 2: that of the
Gaussian of the greatest likelihood there. In the image before the PSF no zero of `b11` was found
for an exponential galaxy behind a PSF of its size, nor for any de Vaucouleurs galaxy; and a
basis of the size of the best Gaussian before the PSF leaves poorly resolved galaxies with
errors of 40 % and more, or without a root.

The functions of high order differ by what the PSF hardly lets pass, and the normal equations
lose digits with them: all is computed in float64, whatever the precision of the stamps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.arrays import Array, array_namespace, device_of
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.nulltests.dogleg import DoglegOptions, Status, find_root
from fdnt_xp.nulltests.scaled import inverse_if_positive
from fdnt_xp.nulltests.small_systems import inverse
from fdnt_xp.peers.batch import Fitted, Weighted, in_domain, measure_in_chunks, shapes_of
from fdnt_xp.peers.circular import CIRCULAR_METHODS
from fdnt_xp.peers.drawing import Drawing
from fdnt_xp.peers.image_fit import ImageFit
from fdnt_xp.peers.levenberg import find_minimum
from fdnt_xp.shapes.laguerre import (
    LaguerreBasis,
    degrees,
    generators,
    n_coefficients,
    position,
)
from fdnt_xp.shapes.least_squares import LARGEST_WITH_GAPS, LinearFit, least_squares
from fdnt_xp.shapes.results import ShapeResult

FINER: Final = 2
"""The k grid of the functions is this much finer than the stamps'."""
LARGEST_INFLATION: Final = 1e11
"""Inflation of a variance beyond which rounding would decide over the fit."""
_FTOL: Final = 1e-9
_TESTS: Final = (
    position(1, 0),
    position(1, 0, sine=True),
    position(2, 0),
    position(2, 0, sine=True),
)


@dataclass(frozen=True, kw_only=True)
class Nb07Method:
    """The method of one order; called as `measure_shapes` is.

    `size` of the result, and the one that may be fixed, is sigma of the basis before the PSF;
    `flux` is that of its Gaussian, b00, and `snr` that over its error at fixed basis with all
    coefficients free. There is no ellipticity gradient: `eg` is 0.

    Parameters
    ----------
    order : int
        Largest p + q, 2 to 18.
    max_iter : int
        Steps of the root finder.
    """

    order: int
    max_iter: int = 60

    def __call__(
        self,
        stamps: Array,
        psf: Psf,
        *,
        noise_variance: float | Array | None = None,
        ivar: Array | None = None,
        size: float | None = None,
        padding: int = 1,
        chunk_size: int | None = None,
    ) -> ShapeResult:
        """Measure the galaxy on each stamp; see `measure_shapes` for the arguments."""
        shape = (int(stamps.shape[-2]), int(stamps.shape[-1])) if stamps.ndim == 3 else (1, 1)
        n_modes = (FINER * padding) ** 2 * shape[0] * shape[1]

        def measure(pixels: Weighted, psf: Psf, flags: Array) -> ShapeResult:
            xp = array_namespace(stamps=pixels.stamps)
            drawing = Drawing.through(xp, psf, shape, FINER * padding, xp.float64)
            wide = pixels.astype(xp.float64)
            fit = self._fit(drawing, wide, size)
            shapes = shapes_of(fit, wide.noise, flags, stamp_shape=shape, fixed=size is not None)
            return _in_precision(shapes, pixels.stamps)

        return measure_in_chunks(
            measure,
            stamps,
            psf,
            noise_variance=noise_variance,
            ivar=ivar,
            size=size,
            padding=padding,
            chunk_size=chunk_size,
            numbers_a_galaxy=3 * n_coefficients(self.order + 2) * n_modes,
        )

    def _fit(self, drawing: Drawing, data: Weighted, size: float | None) -> Fitted:
        """Size the basis, start from the Gaussian of the greatest likelihood, solve the tests."""
        xp = array_namespace(stamps=data.stamps)
        gaussian = CIRCULAR_METHODS["gauss-1"]
        first = ImageFit.of(drawing, gaussian.profile, data.stamps, weights=data.weights, size=None)
        at = find_minimum(first, first.start(gaussian.start), max_iter=gaussian.max_iter)
        seen = replace(first, drawing=drawing.without_psf())
        as_seen = find_minimum(seen, seen.start(1.0), max_iter=gaussian.max_iter)
        sigma = xp.exp(as_seen.x[:, 4])
        if size is not None:
            sigma = xp.full_like(sigma, size)
        tests = ConvolvedTests(
            drawing=drawing,
            order=self.order,
            pixels=xp.reshape(data.stamps, first.pixels.shape) / first.norm[:, None],
            weights=xp.ones_like(first.pixels) if first.roots is None else first.roots**2,
            length=first.length,
            size=sigma,
        )
        options = DoglegOptions(
            ftol=_FTOL, max_iter=self.max_iter, initial_radius=0.5, max_radius=1.0
        )
        root = find_root(tests, at.x[:, :4], options=options)
        fit, _, _ = tests.solved(root.x)
        b00 = fit.coefficients[:, 0]
        to_flux = first.norm * sigma * (2.0 * np.pi**0.5)
        covariance, regular = _covariance(root.jac, fit)
        regular = regular & (fit.inflation < LARGEST_INFLATION)
        if data.weights is not None:
            regular = regular & (tests.growth(root.x, fit) < LARGEST_WITH_GAPS)
        lost = as_seen.status != int(Status.CONVERGED)
        return Fitted(
            eta=root.x[:, 2:],
            eta_cov=covariance / (first.norm**2)[:, None, None],
            centroid=first.length[:, None] * root.x[:, :2],
            size=sigma,
            flux=b00 * to_flux,
            flux_variance=fit.covariance[:, 0, 0] * (to_flux / first.norm) ** 2,
            regular=regular,
            status=xp.where(lost, as_seen.status, root.status),
            n_eval=root.n_eval + at.n_eval + as_seen.n_eval,
        )


@dataclass(frozen=True, kw_only=True)
class ConvolvedTests:
    """`b10` and `b20` over `b00`: a `RootProblem` in `(x0/L, y0/L, eta1, eta2)`.

    Parameters
    ----------
    drawing : Drawing
    order : int
    pixels, weights : array, shape (n_gal, n_pix)
        The sum of the squares of the pixels, weighted, is 1.
    length, size : array, shape (n_gal,)
        L and sigma, pixels.
    """

    drawing: Drawing
    order: int
    pixels: Array
    weights: Array
    length: Array
    size: Array

    def take(self, rows: Array) -> ConvolvedTests:
        """Return the tests of the given galaxies (integer array)."""
        xp = array_namespace(rows=rows)
        return replace(
            self,
            drawing=self.drawing.take(rows),
            pixels=xp.take(self.pixels, rows, axis=0),
            weights=xp.take(self.weights, rows, axis=0),
            length=xp.take(self.length, rows, axis=0),
            size=xp.take(self.size, rows, axis=0),
        )

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """Return the tests, shape (n_gal, 4), and their Jacobian, (n_gal, 4, 4)."""
        xp = array_namespace(x=x)
        fit, slopes, sane = self.solved(x)
        b00 = fit.coefficients[:, 0]
        sane = sane & (fit.inflation < LARGEST_INFLATION)
        inverse = inverse_if_positive(xp.where(sane, b00, -xp.ones_like(b00)))[:, None]
        f = xp.stack([fit.coefficients[:, j] for j in _TESTS], axis=-1) * inverse
        by_test = xp.stack([slopes[:, :, j] for j in _TESTS], axis=-1)
        jac = (by_test - slopes[:, :, :1] * f[:, None, :]) * inverse[:, :, None]
        return f, xp.matrix_transpose(jac)

    def solved(self, x: Array) -> tuple[LinearFit, Array, Array]:
        """Return the fit, what the unknowns do to its coefficients, and where the basis is sane.

        Moving the basis changes an image by the generators, up to two orders higher; what the
        fit makes of that change is the slope, shape (n_gal, 4, n_coef). It leaves out that the
        functions move against the residual too.
        """
        xp = array_namespace(x=x)
        basis, sane = self._basis(x)
        drawn = self._drawn(basis)
        n = n_coefficients(self.order)
        functions = drawn[:, :n, :]
        fit = least_squares(functions, self.pixels, self.weights)
        like = {"dtype": x.dtype, "device": device_of(x)}
        matrix = xp.asarray(_generators_of(self.order), **like)
        n_wide = int(drawn.shape[1])
        moved = xp.reshape(xp.matmul(fit.coefficients, matrix), (-1, 6, n_wide))
        changes = xp.matmul(basis.moves(self.length)[:, :4, :], moved)
        images = self.weights[:, None, :] * xp.matmul(changes, drawn)
        right = xp.matmul(images, xp.matrix_transpose(functions))
        return fit, xp.matmul(right, fit.covariance), sane

    def growth(self, x: Array, fit: LinearFit) -> Array:
        """Return how much more gaps and weights inflate a variance than the PSF does, (n_gal,).

        The inflation of a whole stamp is that of functions which the PSF made alike.
        """
        xp = array_namespace(x=x)
        basis, _ = self._basis(x)
        functions = self._drawn(basis)[:, : n_coefficients(self.order), :]
        even = xp.ones_like(self.weights)
        whole = least_squares(functions, self.pixels, even)
        squares = functions**2
        ours, theirs = (
            xp.linalg.diagonal(one.covariance) * xp.sum(weights[:, None, :] * squares, axis=-1)
            for one, weights in ((fit, self.weights), (whole, even))
        )
        seen = theirs > 0
        growth = ours / xp.where(seen, theirs, xp.ones_like(theirs))
        return xp.max(xp.where(seen, growth, xp.full_like(growth, float("inf"))), axis=-1)

    def _basis(self, x: Array) -> tuple[LaguerreBasis, Array]:
        """Return a basis two orders higher, a unit circle where absurd, and where it is not."""
        xp = array_namespace(x=x)
        eta, centroid, size = x[:, 2:], self.length[:, None] * x[:, :2], self.size
        sane = in_domain(eta, centroid, size, min(self.drawing.stamp_shape))
        basis = LaguerreBasis(
            order=self.order + 2,
            eta=xp.where(sane[:, None], eta, xp.zeros_like(eta)),
            centroid=xp.where(sane[:, None], centroid, xp.zeros_like(centroid)),
            size=xp.where(sane, size, xp.ones_like(size)),
        )
        return basis, sane

    def _drawn(self, basis: LaguerreBasis) -> Array:
        """Return the functions as they are seen, shape (n_gal, n_coef, n_pix)."""
        xp = array_namespace(eta=basis.eta)
        seen = self.drawing.transfer * self.drawing.phase(basis.centroid)
        functions = basis.in_k(self.drawing.kx, self.drawing.ky)
        powers = xp.asarray(
            (-1j) ** np.array(degrees(basis.order)), dtype=seen.dtype, device=device_of(seen)
        )
        return self.drawing.images(functions * seen[:, None, :] * powers[None, :, None])


def _covariance(jac: Array, fit: LinearFit) -> tuple[Array, Array]:
    """Return `J⁻¹ Cov(t) J⁻ᵀ` of eta, and where J is regular.

    The tests vanish at the root: the noise of b00 does not matter.
    """
    xp = array_namespace(jac=jac)
    b00 = fit.coefficients[:, 0]
    inverse_jac, regular = inverse(xp, jac)
    to_eta = inverse_jac[:, 2:, :]
    rows = [xp.stack([fit.covariance[:, i, j] for j in _TESTS], axis=-1) for i in _TESTS]
    square = xp.where(b00 > 0, b00, xp.ones_like(b00)) ** 2
    tests = xp.stack(rows, axis=1) / square[:, None, None]
    return xp.matmul(xp.matmul(to_eta, tests), xp.matrix_transpose(to_eta)), regular & (b00 > 0)


@lru_cache
def _generators_of(order: int) -> NDArray[np.float64]:
    """Return (n_coef, 6 n_wide): coefficients of the order, by what they become two higher."""
    whole = generators(order + 2)[:, :, : n_coefficients(order)]
    return np.ascontiguousarray(np.reshape(whole, (-1, whole.shape[-1])).T)


def _in_precision(shapes: ShapeResult, stamps: Array) -> ShapeResult:
    """Return the result in the precision of the stamps."""
    xp = array_namespace(stamps=stamps)
    names = ("eta", "eta_cov", "eg", "centroid", "size", "flux", "snr")
    return replace(shapes, **{n: xp.astype(getattr(shapes, n), stamps.dtype) for n in names})


NB07_METHODS: Final = {f"nb07-{n}": Nb07Method(order=n) for n in (8, 12)}
"""By the names they are registered by; "nb07" is the first."""
