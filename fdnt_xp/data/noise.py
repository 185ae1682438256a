"""The noise of an image, measured where its galaxies are not: on the borders of the stamps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.data.noise_power import SIGMA_PER_MAD, group_error
from fdnt_xp.data.stamps import StampSource

_MOST_STAMPS: Final = 2000
"""Enough for the variance to a few parts in a thousand, and quick to read."""
_GROUPS: Final = 50
"""Of neighbouring stamps, read at a time; their scatter tells the error."""
_MAD_EFFICIENCY: Final = 0.3675
"""Of the median absolute deviation of a Gaussian: its variance over the least possible."""
_ROUNDING: Final = 1.0 / 12.0
"""Variance of a number uniform over one unit."""


@dataclass(frozen=True, kw_only=True)
class BorderNoise:
    """Noise and background level of an image.

    Parameters
    ----------
    variance : float
        Of one pixel, in (unit of the image)²; NaN if no border pixel is finite.
    variance_err : float
        Its standard error: the larger of that of independent Gaussian pixels,
        `variance sqrt(2/(0.3675 n_pixels))`, and of the scatter between 50 groups of
        neighbouring stamps, in which correlated pixels, bright neighbours and changes over
        the image are seen. Neighbours that all groups have alike are not: they raise the
        variance itself. What the error does to a shear, `fdnt_xp.data.noise_power` says.
    level : float
        Median of the border pixels: the background that was left in the image.
    level_err : float
        Its error by the pixel noise.
    n_pixels : int
        How many pixels were used.
    """

    variance: float
    variance_err: float
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


def measure_border_noise(source: StampSource, mask: StampSource | None = None) -> BorderNoise:
    """Measure the noise by the median absolute deviation of the stamps' border pixels.

    The border is a sixteenth of the stamp wide. All stamps are pooled, or 2000 of them
    evenly spread, so that a few bright neighbours, however bright, change nothing. Pixels
    where `mask`, a source beside the other, is not 0 are left out.
    """
    groups = [group for group in _border_pixels(source, mask) if group.size]
    n_pixels = sum(group.size for group in groups)
    if n_pixels == 0:
        nan = math.nan
        return BorderNoise(variance=nan, variance_err=nan, level=nan, level_err=nan, n_pixels=0)
    rounded = not np.issubdtype(source.pixels.dtype, np.floating)
    if rounded and max(np.max(group) for group in groups) > min(map(np.min, groups)):
        # Deviations of whole numbers are whole numbers: spread them over their unit.
        rng = np.random.default_rng(0)
        groups = [group + rng.uniform(-0.5, 0.5, group.size) for group in groups]
    level, raw = _level_and_variance(np.concatenate(groups))
    variance = max(raw - _ROUNDING, 0.0) if rounded else raw
    by_chance = raw * math.sqrt(2.0 / (_MAD_EFFICIENCY * n_pixels))
    scatter = group_error(np.array([_level_and_variance(group)[1] for group in groups]))
    return BorderNoise(
        variance=variance,
        variance_err=float(np.fmax(by_chance, scatter)),
        level=level,
        level_err=math.sqrt(0.5 * math.pi * variance / n_pixels),
        n_pixels=n_pixels,
    )


def _level_and_variance(pixels: NDArray[np.float64]) -> tuple[float, float]:
    level = float(np.median(pixels))
    return level, float(SIGMA_PER_MAD * np.median(np.abs(pixels - level))) ** 2


def _border_pixels(source: StampSource, mask: StampSource | None) -> list[NDArray[np.float64]]:
    """Return the finite border pixels of whole stamps, of a fair sample of them, in groups."""
    rows = np.flatnonzero(source.flags == 0)
    if len(rows) > _MOST_STAMPS:
        rows = rows[np.linspace(0, len(rows) - 1, _MOST_STAMPS).astype(np.int64)]
    ny, nx = source.stamp_shape
    width = max(1, min(ny, nx) // 16)
    border = np.ones((ny, nx), dtype=bool)
    border[width : ny - width, width : nx - width] = False
    groups = np.array_split(rows, min(_GROUPS, max(len(rows), 1)))
    parts = []
    for group in groups:
        pixels = source.take(group)[:, border].astype(np.float64)
        there = np.isfinite(pixels)
        if mask is not None:
            there &= mask.take(group)[:, border] == 0
        parts.append(pixels[there])
    return parts
