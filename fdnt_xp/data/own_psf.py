"""A PSF that is an image, as GalSim draws galaxies behind it.

Between its pixels an image says nothing: GalSim interpolates. Where the PSF is band-limited,
as it is if its pixels are fine enough, that is exact; a PSF whose transform has not ended where
the pixels of its image end it is another one between them, and so are the galaxies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.data.profiles import load_galsim
from fdnt_xp.errors import FdntValueError, RangeError, ShapeMismatchError

_SAMPLED: Final = 0.01
"""`|T|` at the Nyquist wave numbers of its image below which a PSF is well sampled."""


@dataclass(frozen=True, kw_only=True)
class OwnPsf:
    """A PSF to draw galaxies with; see `psf_of_image`.

    Parameters
    ----------
    profile : galsim.GSObject
        Of flux 1, centroid at 0, with the pixel response; lengths in pixels of the galaxies.
    half_light_radius : float
        Of its image, pixels of the galaxies.
    at_nyquist : float
        Largest `|T|` where the pixels of the image end it: what interpolation has to guess.
    """

    profile: Any
    half_light_radius: float
    at_nyquist: float

    @property
    def well_sampled(self) -> bool:
        """Whether interpolation between the pixels of the image is exact enough to test by."""
        return self.at_nyquist < _SAMPLED


def psf_of_image(image: NDArray[Any], *, oversampling: float = 1.0, pixel: bool = False) -> OwnPsf:
    """Return the PSF that is an image of a star.

    Parameters
    ----------
    image : array, shape (ny, nx)
        Of positive sum. Any normalisation and centring.
    oversampling : float
        Its pixels per pixel of the galaxies.
    pixel : bool
        Whether it lacks the response of the galaxies' pixels, which is then put on.

    Raises
    ------
    ShapeMismatchError, FdntValueError, RangeError
        If there are not two axes, the image is not finite or has no positive sum, or
        `oversampling` is not positive.
    MissingExtraError
        If GalSim is not installed.
    """
    galsim = load_galsim()
    image = np.asarray(image, dtype=np.float64)
    if image.ndim != 2 or min(image.shape) < 8:
        raise ShapeMismatchError(
            f"image must have the shape (ny, nx), 8 pixels or more each, not {image.shape}"
        )
    if not (np.isfinite(oversampling) and oversampling > 0):
        raise RangeError("oversampling", oversampling, 0.0, None)
    if not (np.all(np.isfinite(image)) and np.sum(image) > 0):
        raise FdntValueError("image must be finite, with a positive sum, to serve as the PSF")
    drawn = galsim.ImageD(image / np.sum(image), scale=1.0 / oversampling)
    # Nearly a sinc, which keeps the transform of the image up to where its pixels end it, and
    # nothing beyond; GalSim's own choice, a quintic, takes 2 % off at half of that.
    profile = galsim.InterpolatedImage(drawn, x_interpolant="lanczos31", flux=1.0)
    profile = profile.shift(-profile.centroid)
    if pixel:
        profile = galsim.Convolve([profile, galsim.Pixel(1.0)])
    return OwnPsf(
        profile=profile,
        half_light_radius=float(drawn.calculateHLR(flux=1.0, center=_middle(image, galsim))),
        at_nyquist=_at_nyquist(image / np.sum(image)),
    )


def _middle(image: NDArray[np.float64], galsim: Any) -> Any:
    """Return the flux centroid, counted from 1."""
    y, x = np.indices(image.shape)
    total = np.sum(image)
    return galsim.PositionD(1.0 + np.sum(x * image) / total, 1.0 + np.sum(y * image) / total)


def _at_nyquist(image: NDArray[np.float64]) -> float:
    transform = np.abs(np.fft.fft2(image, s=[2 * n for n in image.shape]))
    ny, nx = image.shape
    return float(max(np.max(transform[ny, :]), np.max(transform[:, nx])))
