"""FDNT-GL: the transform of each galaxy from its Gauss-Laguerre fit, B10 §4.4.

The functions are their own transforms, so a fit to the *observed* pixels is a transform of
the galaxy at any k, whatever pixels were missing. Divided by that of the PSF it is what
the null tests work on.
"""

from __future__ import annotations

from fdnt_xp.arrays import Array, array_namespace
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.fourier.transform import DeconvolvedStamps, mode_phase
from fdnt_xp.shapes.gl_fit import LaguerreFit


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
