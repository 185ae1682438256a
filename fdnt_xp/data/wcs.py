"""The Jacobian of the pixels at each position, from the world coordinates of an image.

(u, v) are arcsec in the tangent plane at the position: u to the *west*, v to the north of the
ICRS, which is right-handed as the sky is seen, and GalSim's choice. With east in place of west
the second component of a shape changes its sign.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.errors import CatalogError

if TYPE_CHECKING:
    from astropy.io.fits import Header

_STEP: Final = 0.5
"""Pixels to each side: the derivative is that over the pixel."""


def wcs_jacobians(header: Header, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `d(u, v)/d(x, y)` at each position, arcsec a pixel.

    Parameters
    ----------
    header : astropy.io.fits.Header
        With celestial coordinates, distortions included.
    positions : array, shape (n, 2)
        (x, y), 0-based, integer at pixel centres.

    Returns
    -------
    array, shape (n, 2, 2)
        NaN where the coordinates are not those of a place on the sky.

    Raises
    ------
    CatalogError
        If the header has no celestial coordinates, or they cannot be understood.
    """
    from astropy.utils.exceptions import AstropyWarning
    from astropy.wcs import WCS, WcsError

    with warnings.catch_warnings():
        # About keywords that are obsolete, and repaired.
        warnings.simplefilter("ignore", AstropyWarning)
        try:
            wcs = WCS(header)
            if wcs.has_celestial:
                wcs = wcs.celestial
        except (WcsError, ValueError, KeyError, MemoryError) as error:
            reason = str(error).strip().splitlines()[-1]
            raise CatalogError(f"the world coordinates cannot be understood: {reason}") from error
    if not wcs.has_celestial:
        raise CatalogError("the header of the image has no celestial coordinates")

    def directions(shift: tuple[float, float]) -> NDArray[np.float64]:
        """Return the unit vectors, (n, 3), to where the positions lie when shifted."""
        x, y = (positions + np.asarray(shift)).T
        sky = wcs.pixel_to_world(x, y).icrs
        return np.stack(sky.cartesian.xyz.value, axis=-1)

    middle = directions((0.0, 0.0))
    west = np.stack([middle[:, 1], -middle[:, 0], np.zeros(len(middle))], axis=-1)
    west = west / np.linalg.norm(west, axis=1, keepdims=True)
    north = np.cross(west, middle)
    columns = []
    for axis in np.eye(2):
        along = directions(tuple(_STEP * axis)) - directions(tuple(-_STEP * axis))
        columns.append([np.sum(along * unit, axis=1) / (2.0 * _STEP) for unit in (west, north)])
    return np.rad2deg(np.moveaxis(np.asarray(columns), 2, 0).swapaxes(1, 2)) * 3600.0
