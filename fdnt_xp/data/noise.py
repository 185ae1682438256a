"""The noise of an image, measured where its galaxies are not: on the borders of the stamps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.data.stamps import StampSource

_SIGMA_PER_MAD: Final = 1.482602218505602
"""Standard deviation of a Gaussian over its median absolute deviation."""
_MOST_STAMPS: Final = 2000
"""Enough for the variance to a few parts in a thousand, and quick to read."""
_READ_AT_ONCE: Final = 200
_ROUNDING: Final = 1.0 / 12.0
"""Variance of a number uniform over one unit."""


@dataclass(frozen=True, kw_only=True)
class BorderNoise:
    """Noise and background level of an image.

    Parameters
    ----------
    variance : float
        Of one pixel, in (unit of the image)²; NaN if no border pixel is finite.
    level : float
        Median of the border pixels: the background that was left in the image.
    level_err : float
        Its error by the pixel noise.
    n_pixels : int
        How many pixels were used.
    """

    variance: float
    level: float
    level_err: float
    n_pixels: int

    @property
    def known(self) -> bool:
        """Whether there is a variance to work with: constant borders have none."""
        return math.isfinite(self.variance) and self.variance > 0

    @property
    def has_background(self) -> bool:
        """Whether the level is certainly not zero, and more than the wings of galaxies.

        That is, five times its error and a tenth of the noise of one pixel.
        """
        noise = math.sqrt(self.variance) if self.known else 0.0
        return abs(self.level) > max(5.0 * self.level_err, 0.1 * noise) and self.known


def measure_border_noise(source: StampSource) -> BorderNoise:
    """Measure the noise by the median absolute deviation of the stamps' border pixels.

    The border is a sixteenth of the stamp wide. All stamps are pooled, or 2000 of them
    evenly spread, so that a few bright neighbours, however bright, change nothing.
    """
    pixels = _border_pixels(source)
    if pixels.size == 0:
        return BorderNoise(variance=math.nan, level=math.nan, level_err=math.nan, n_pixels=0)
    rounded = not np.issubdtype(source.pixels.dtype, np.floating)
    if rounded and np.ptp(pixels) > 0:
        # Deviations of whole numbers are whole numbers: spread them over their unit.
        pixels = pixels + np.random.default_rng(0).uniform(-0.5, 0.5, pixels.size)
    level = float(np.median(pixels))
    variance = float(_SIGMA_PER_MAD * np.median(np.abs(pixels - level))) ** 2
    if rounded:
        variance = max(variance - _ROUNDING, 0.0)
    level_err = math.sqrt(0.5 * math.pi * variance / pixels.size)
    return BorderNoise(variance=variance, level=level, level_err=level_err, n_pixels=pixels.size)


def _border_pixels(source: StampSource) -> NDArray[np.floating[Any]]:
    """Return the finite border pixels of the whole stamps, or of a fair sample of them."""
    rows = np.flatnonzero(source.flags == 0)
    if len(rows) > _MOST_STAMPS:
        rows = rows[np.linspace(0, len(rows) - 1, _MOST_STAMPS).astype(np.int64)]
    ny, nx = source.stamp_shape
    width = max(1, min(ny, nx) // 16)
    border = np.ones((ny, nx), dtype=bool)
    border[width : ny - width, width : nx - width] = False
    parts = [
        source.take(rows[start : start + _READ_AT_ONCE])[:, border].ravel()
        for start in range(0, len(rows), _READ_AT_ONCE)
    ]
    pixels = np.concatenate(parts) if parts else np.empty(0)
    return pixels[np.isfinite(pixels)].astype(np.float64, copy=False)
