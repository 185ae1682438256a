"""Noise-free galaxies drawn by GalSim, accurate enough to test a part in a million."""

from __future__ import annotations

import galsim
import numpy as np
from numpy.typing import NDArray

ACCURATE = galsim.GSParams(
    maximum_fft_size=32768,
    folding_threshold=1e-3,
    stepk_minimum_hlr=30,
    kvalue_accuracy=1e-7,
    maxk_threshold=1e-5,
)
# The wings of an Airy disc would want an image of 10^5 pixels for the settings above; these
# give the same shapes to 1e-6 (compared at folding_threshold = 1e-4).
ACCURATE_AIRY = galsim.GSParams(
    maximum_fft_size=32768, folding_threshold=1e-3, kvalue_accuracy=1e-7, maxk_threshold=1e-4
)

SERSIC = (0.5, 1.0, 2.0, 4.0)
DISTORTION = (0.1, 0.3, 0.5, 0.7)
ANGLE = 25.0
OFFSET = (0.31, -0.23)

GREAT08_PSF = galsim.Moffat(beta=3, fwhm=2.85, trunc=5.7).shear(g1=-0.019, g2=-0.007)


def psf_image(
    psf: galsim.GSObject, method: str, n: int = 128, gsparams: galsim.GSParams = ACCURATE
) -> NDArray[np.float64]:
    """Return the star, with the pixel unless `method` is "no_pixel"."""
    drawn = psf.withGSParams(gsparams).drawImage(nx=n, ny=n, scale=1.0, method=method, dtype=float)
    return np.asarray(drawn.array)


def sersic_stamps(
    psf: galsim.GSObject,
    method: str,
    *,
    half_light_radius: float = 3.0,
    n: int = 128,
    sersic: tuple[float, ...] = SERSIC,
    angle: float = ANGLE,
    gsparams: galsim.GSParams = ACCURATE,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return galaxies of each Sersic index and distortion, off-centre and off-axis.

    Returns
    -------
    stamps, e : arrays, shape (n_sersic * n_distortion, n, n) and (..., 2)
    """
    stamps, shapes = [], []
    direction = [np.cos(2.0 * np.radians(angle)), np.sin(2.0 * np.radians(angle))]
    for index in sersic:
        for e in DISTORTION:
            galaxy = galsim.Sersic(index, half_light_radius=half_light_radius, gsparams=gsparams)
            galaxy = galaxy.shear(e=e, beta=angle * galsim.degrees).shift(*OFFSET)
            both = galsim.Convolve([galaxy, psf], gsparams=gsparams)
            stamps.append(both.drawImage(nx=n, ny=n, scale=1.0, method=method, dtype=float).array)
            shapes.append(np.multiply(e, direction))
    return np.array(stamps), np.array(shapes)


def relative_error(measured: NDArray[np.float64], e: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `|e_measured - e|/|e|`."""
    return np.linalg.norm(measured - e, axis=1) / np.linalg.norm(e, axis=1)
