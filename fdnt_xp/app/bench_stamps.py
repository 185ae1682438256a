"""Stamps to time measurements on: GREAT08's galaxies, or Gaussian ones where GalSim is not."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.data.simulate import NOISE_SIGMA, great08_image, sample_g
from fdnt_xp.data.stamps import SMALLEST_STAMP
from fdnt_xp.errors import RangeError

_DIFFERENT: Final = 128
"""Galaxies that are drawn; more stamps are those again with other noise."""
_ACROSS: Final = 2
"""Galaxies side by side on the image that is drawn: they come in pairs."""
_DRAWN_SNR: Final = 200.0
_SHEAR: Final = (0.02, -0.01)
_PSF_VARIANCE, _GALAXY_VARIANCE = 2.25, 4.0
"""Of the Gaussians, pixel²: about the sizes that GREAT08 has."""


@dataclass(frozen=True, kw_only=True)
class BenchStamps:
    """What is measured.

    Parameters
    ----------
    pixels : array, shape (n_gal, size, size), float64
    star : array, shape (size, size), float64
    variance : float
        Of the noise of a pixel.
    origin : str
        What drew them.
    """

    pixels: NDArray[np.float64]
    star: NDArray[np.float64]
    variance: float
    origin: str


def make_stamps(n_gal: int, size: int, snr: float = 200.0, *, seed: int = 3) -> BenchStamps:
    """Draw stamps by GalSim, or Gaussian galaxies if it is not installed.

    Parameters
    ----------
    n_gal, size : int
        Stamps, and pixels on a side. Up to 128 galaxies are different; the noise always is.
    snr : float
        `sqrt(sum of I²)/sigma`.
    seed : int
        Of everything random.

    Raises
    ------
    RangeError
        If there is no stamp, or they are too small, or `snr` is not positive.
    """
    if n_gal < 1:
        raise RangeError("n", n_gal, 1, None)
    if size < SMALLEST_STAMP:
        raise RangeError("stamp size", size, SMALLEST_STAMP, None)
    if not snr > 0:
        raise RangeError("snr", snr, 0.0, None)
    pairs = (min(n_gal, _DIFFERENT) + 1) // 2
    with_galsim = importlib.util.find_spec("galsim") is not None
    clean, star = (_drawn if with_galsim else _gaussian)(2 * pairs, size, seed)
    sigma = NOISE_SIGMA * _DRAWN_SNR / snr
    rng = np.random.default_rng(seed)
    pixels = sigma * rng.standard_normal((n_gal, size, size))
    for first in range(0, n_gal, len(clean)):
        part = pixels[first : first + len(clean)]
        part += clean[: len(part)]
    return BenchStamps(
        pixels=pixels,
        star=star,
        variance=sigma**2,
        origin="GREAT08's galaxies, drawn by GalSim" if with_galsim else "Gaussian galaxies",
    )


def _drawn(n_gal: int, size: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return stamps without noise, and the star."""
    field = great08_image(
        n_x=_ACROSS, n_y=n_gal // _ACROSS, cell=size, shear=_SHEAR, snr=None, seed=seed
    )
    cells = field.image.reshape(n_gal // _ACROSS, size, _ACROSS, size).swapaxes(1, 2)
    return np.ascontiguousarray(cells).reshape(n_gal, size, size), field.psf_image


def _gaussian(n_gal: int, size: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the same of Gaussian galaxies and a round Gaussian star: no image is convolved."""
    rng = np.random.default_rng(seed)
    g, angle = sample_g(rng, n_gal // 2), rng.uniform(0.0, 2.0 * np.pi, n_gal // 2)
    shape = np.concatenate([g * np.exp(1j * angle), -g * np.exp(1j * angle)])
    shear = _SHEAR[0] + 1j * _SHEAR[1]
    g_seen = (shape + shear) / (1.0 + np.conj(shear) * shape)
    e = 2.0 * g_seen / (1.0 + np.abs(g_seen) ** 2)
    # The covariance of an ellipse of distortion e whose determinant does not depend on it.
    spread = _GALAXY_VARIANCE / np.sqrt(1.0 - np.abs(e) ** 2)
    xx = spread * (1.0 + e.real) + _PSF_VARIANCE
    yy = spread * (1.0 - e.real) + _PSF_VARIANCE
    xy = spread * e.imag
    x, y = np.meshgrid(*2 * [np.arange(size) - 0.5 * (size - 1)])
    x0, y0 = rng.uniform(-0.5, 0.5, (2, n_gal, 1, 1))
    dx, dy = x - x0, y - y0
    xx, xy, yy = (a[:, None, None] for a in (xx, xy, yy))
    quadratic = (yy * dx**2 - 2.0 * xy * dx * dy + xx * dy**2) / (xx * yy - xy**2)
    stamps = np.exp(-0.5 * quadratic)
    flux = _DRAWN_SNR * NOISE_SIGMA / np.sqrt(np.sum(stamps**2, axis=(-2, -1), keepdims=True))
    star = np.exp(-0.5 * (x**2 + y**2) / _PSF_VARIANCE)
    return flux * stamps, star / np.sum(star)
