"""FDNT-GL: the transform of each galaxy from its Gauss-Laguerre fit, B10 §4.4.

The functions are their own transforms, so a fit to the *observed* pixels is a transform of
the galaxy at any k, whatever pixels were missing. Divided by that of the PSF it is what
the null tests work on.
"""

from __future__ import annotations

from typing import Final

from fdnt_xp.arrays import Array, array_namespace, count_true
from fdnt_xp.flags import Flag
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.fourier.transform import DeconvolvedStamps, mode_phase
from fdnt_xp.shapes.gl_fit import LaguerreFit, fit_laguerre
from fdnt_xp.shapes.pixels import Pixels

SCALE_OF_WHOLE: Final = 1.14
SCALE_WITH_GAPS: Final = 1.09
"""Size of the basis over the matched one, by whether pixels are missing. A larger one follows
the wings of n = 2 and 4 better, and n = 1 behind a mask worse (docs, "Gauss-Laguerre fits")."""
SCALE_OF_LARGE: Final = 1.0
"""That of whole stamps that do not hold the functions of the larger one."""


def fit_pixels_of(pixels: Pixels, order: int) -> LaguerreFit:
    """Fit the observed images, weighted by `ivar`, or evenly where there is none.

    Parameters
    ----------
    pixels : Pixels
        Screened.
    """
    xp = array_namespace(stamps=pixels.stamps)
    ivar = xp.ones_like(pixels.stamps) if pixels.ivar is None else pixels.ivar
    whole = pixels.masked_fraction() == 0
    scale = xp.where(
        whole,
        xp.full_like(pixels.variance, SCALE_OF_WHOLE),
        xp.full_like(pixels.variance, SCALE_WITH_GAPS),
    )
    fit = fit_laguerre(pixels.stamps, ivar, order=order, scale=scale)
    # A gap that the larger functions cannot be told apart behind must not pass by smaller ones.
    cut_off = whole & (fit.flags == int(Flag.GL_FAILURE))
    # A host read: how many are to be fitted again decides the size of that batch.
    n_again = count_true(cut_off)
    if n_again == 0:
        return fit
    place = xp.argsort(xp.astype(~cut_off, xp.int32), stable=True)
    rows = place[:n_again]
    again = fit_laguerre(
        xp.take(pixels.stamps, rows, axis=0),
        xp.take(ivar, rows, axis=0),
        order=order,
        scale=SCALE_OF_LARGE,
    )
    return LaguerreFit.concat([again, fit.take(place[n_again:])]).take(xp.argsort(place))


def deconvolve_fit(fit: LaguerreFit, inverse_transfer: Array, grid: KGrid) -> DeconvolvedStamps:
    """Return the transform of the fitted images, divided by that of the PSF.

    Parameters
    ----------
    fit : LaguerreFit
        NaN where it is not usable.
    inverse_transfer : array, shape (n_gal or 1, n_k), complex
        `1/T(k)` about the flux centroid of the PSF, from `Psf.inverse_transfer`.
    grid : KGrid
        That of the data, not counter-sheared. Nothing is periodic here: it may be as fine
        as the integrals over k ask for.
    """
    xp = array_namespace(b=fit.coefficients, inverse_transfer=inverse_transfer)
    re, im = fit.basis.transform(fit.coefficients, grid.kx, grid.ky)
    factor = inverse_transfer / mode_phase(grid, fit.basis.centroid)
    cos, sin = xp.real(factor), xp.imag(factor)
    return DeconvolvedStamps(re=cos * re - sin * im, im=sin * re + cos * im)
