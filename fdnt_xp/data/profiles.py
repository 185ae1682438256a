"""Galaxies and PSFs for tests of bias, as GalSim objects of unit flux and high accuracy.

The three galaxies are those of Bernstein 2010, section 5.3, which gives numbers for the
first alone; those of the others are ours. Lengths are in pixels, shapes are distortions e.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from fdnt_xp.errors import MissingExtraError

if TYPE_CHECKING:
    from types import ModuleType

_ACCURATE: Final = {
    # Wings of de Vaucouleurs profiles fold back into the image otherwise: errors of 1e-4.
    "maximum_fft_size": 32768,
    "folding_threshold": 1e-3,
    "stepk_minimum_hlr": 30,
    "kvalue_accuracy": 1e-7,
    "maxk_threshold": 1e-5,
}


def load_galsim() -> ModuleType:
    """Import GalSim, or raise `MissingExtraError`."""
    try:
        import galsim
    except ImportError as error:
        raise MissingExtraError(
            "simulated images need GalSim, which is not installed: pip install 'fdnt-xp[sim]'"
        ) from error
    module: ModuleType = galsim
    return module


def accurate(galsim: ModuleType) -> Any:
    """Return GSParams with which noise-free stamps are good to a part in 10⁷ or so."""
    return galsim.GSParams(**_ACCURATE)


def sersic(
    n: float, half_light_radius: float, e: tuple[float, float] = (0.0, 0.0), flux: float = 1.0
) -> Any:
    """Return a Sersic profile whose radius is that before it got its shape (equal area)."""
    galsim = load_galsim()
    round_one = galsim.Sersic(
        n=n, half_light_radius=half_light_radius, flux=flux, gsparams=accurate(galsim)
    )
    return round_one.shear(e1=e[0], e2=e[1])


def vb_spiral() -> Any:
    """Return galaxy 1, the spiral of Voigt and Bridle: a small round bulge in a disc."""
    return sersic(1.5, 1.5, (0.05, 0.0), 0.2) + sersic(1.0, 11.8, (0.2, 0.0), 0.8)


def orthogonal() -> Any:
    """Return galaxy 2: a de Vaucouleurs bulge across an exponential disc."""
    return sersic(4.0, 3.0, (-0.3, 0.0), 0.4) + sersic(1.0, 10.0, (0.4, 0.0), 0.6)


def torture() -> Any:
    """Return galaxy 3: bulge off the centre of its disc and askew, no symmetry at all."""
    bulge = sersic(4.0, 2.5, (0.1, 0.4), 0.3).shift(4.0, 3.0)
    return bulge + sersic(1.0, 9.0, (0.5, 0.0), 0.7)


def irregular(
    seed: int, *, half_light_radius: float = 5.0, n_knots: int = 30, knot_flux: float = 0.4
) -> Any:
    """Return an exponential disc, e = 0.3, with knots of star formation strewn over it.

    Parameters
    ----------
    seed : int
        Of the positions of the knots, which follow a disc of the same size and shape.
    half_light_radius : float
        Pixels.
    n_knots : int
        Points of equal flux.
    knot_flux : float
        Part of the flux in the knots.
    """
    galsim = load_galsim()
    knots = galsim.RandomKnots(
        n_knots,
        profile=galsim.Exponential(half_light_radius=half_light_radius),
        rng=galsim.BaseDeviate(seed),
        gsparams=accurate(galsim),
    )
    disc = sersic(1.0, half_light_radius, (0.3, 0.0), 1.0 - knot_flux)
    return disc + knots.withFlux(knot_flux).shear(e1=0.3, e2=0.0)


TEST_GALAXIES: Final[dict[str, Callable[[], Any]]] = {
    "vb-spiral": vb_spiral,
    "orthogonal": orthogonal,
    "torture": torture,
}
"""By the name that the command line takes, in the order of the paper."""


def gaussian_psf(half_light_radius: float, e: tuple[float, float] = (0.1, 0.05)) -> Any:
    """Return a Gaussian PSF."""
    galsim = load_galsim()
    psf = galsim.Gaussian(half_light_radius=half_light_radius, gsparams=accurate(galsim))
    return psf.shear(e1=e[0], e2=e[1])


def moffat_psf(beta: float, fwhm: float, e: tuple[float, float] = (0.1, 0.05)) -> Any:
    """Return a Moffat PSF without truncation."""
    galsim = load_galsim()
    psf = galsim.Moffat(beta=beta, fwhm=fwhm, gsparams=accurate(galsim))
    return psf.shear(e1=e[0], e2=e[1])


def is_inversion_symmetric(profile: Any) -> bool:
    """Return whether a profile looks the same after half a turn about its centroid.

    Its transform is then real, with the phase of the centroid taken off; looked at along
    eight directions, at scales from the whole galaxy to 2 pixels.
    """
    galsim = load_galsim()
    centre = profile.centroid
    for angle in np.linspace(0.0, np.pi, 8, endpoint=False) + 0.1:
        for k in np.geomspace(0.02, 3.0, 24):
            kx, ky = k * np.cos(angle), k * np.sin(angle)
            phase = np.exp(1j * (kx * centre.x + ky * centre.y))
            value = profile.kValue(galsim.PositionD(kx, ky)) * phase
            if abs(value.imag) > 1e-6 * profile.flux:
                return False
    return True
