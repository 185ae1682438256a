"""The noise of blank sky: its variance, its power spectrum, and how well both are known.

Noise that is made round (docs, "Noise made round") needs the power of the noise that is in
the stamps. An error of 1 % in it makes a multiplicative bias of the shear of 2.5e-4 at S/N
15, and of `2.5e-4 (15/(S/N))²` at another: 4 % will do for `|m| < 1e-3` there, and 30 % made
m = 0.0075. Resampled and stacked images have noise that is correlated between pixels; one
that is taken for white is wrong by such amounts, mode by mode.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincc

from fdnt_xp.errors import FdntValueError, FdntWarning, ShapeMismatchError

SIGMA_PER_MAD: Final = 1.482602218505602
"""Standard deviation of a Gaussian over its median absolute deviation."""
_FEWEST: Final = 10
"""Stamps below which neither the outliers nor the power of a mode (32 %) are known."""
_MOST_GROUPS: Final = 50
_OUTLIER: Final = 6.0
"""Standard deviations over the median at which a stamp is no noise. The largest pixel of a
stamp has a long tail of its own, by which one blank stamp in a thousand is lost."""
_BLUR: Final = 1.5
"""Pixels, sigma of a smoothing that shows a faint galaxy better than any pixel does."""
_MANY_REJECTED: Final = 0.2
_NEAR: Final = 3
"""Lags in pixels within which resampling correlates neighbours first of all."""
_CHANCE: Final = 1e-3
"""Of white noise to be taken for coloured, in each of two tests."""
_AT_ONCE: Final = 256


@dataclass(frozen=True, kw_only=True)
class NoisePower:
    """Noise of blank stamps; see `measure_noise_power`.

    Parameters
    ----------
    variance : float
        Of one pixel, in (unit of the image)²: the mean of `power`.
    variance_err : float
        Its standard error.
    power : array, shape (ny, nx), float64
        `E|FFT(noise)|²/(ny nx)` in the order of the FFT, the same to the bit at k and -k.
    power_err : array, shape (ny, nx), float64
        Standard error of each mode; those of different modes are independent, but for k
        and -k.
    n_stamps : int
        Stamps that were used.
    n_rejected : int
        Stamps that were left out, because they hold more than noise, or less.
    is_white : bool
        Whether the power is the same in all modes, as far as these stamps can tell.
    """

    variance: float
    variance_err: float
    power: NDArray[np.float64]
    power_err: NDArray[np.float64]
    n_stamps: int
    n_rejected: int
    is_white: bool

    @property
    def relative_err(self) -> float:
        """Relative error of the variance: `noise_error` of `population_null`."""
        return self.variance_err / self.variance


def measure_noise_power(blank_stamps: NDArray[Any]) -> NoisePower:
    """Measure variance and power spectrum of the noise on stamps without galaxies.

    Stamps with an object or a cosmic ray are found and left out; the others are averaged.
    Where `is_white`, give `noise_variance=variance` to `measure_responses` and
    `population_null`; otherwise `noise_power=power`. To both, `noise_error=relative_err`.

    Parameters
    ----------
    blank_stamps : array, shape (n, ny, nx), on the host
        Of the shape of the stamps of the galaxies: the window of a stamp is part of its
        power spectrum. Any number type. Stamps with a NaN are left out.

    Returns
    -------
    NoisePower
        In (unit of the image)².

    Warns
    -----
    FdntWarning
        If more than a fifth of the stamps are left out.

    Raises
    ------
    ShapeMismatchError
        If there are not three axes, or stamps of fewer than 8 pixels on a side.
    FdntValueError
        If fewer than 10 stamps are noise; constant ones are not.

    Notes
    -----
    A stamp is left out if its mean square, its largest pixel or its largest pixel after
    smoothing by a Gaussian of sigma 1.5 pixels lies more than 6 robust standard deviations
    from the median over the stamps. Galaxies of S/N above 10 or so are found thus. What
    stays adds `f nu²/(ny nx)` to the variance, relatively, for a share f of stamps with
    galaxies of S/N nu: 3e-4 for 5 % of S/N 5 on 64 x 64 pixels. The median of each mode's
    periodogram over ln 2 would need no rejection, but has twice the variance and is
    biased by 1.4 f whatever the S/N.

    The spectrum is not smoothed: what counts for the shear are sums over many modes, to
    which smoothing adds no knowledge. The relative error of a mode is `1/sqrt(n)`, and
    `sqrt(2/n)` where k = -k. It raises the largest power among the directions, and so the
    noise that is added to make all of it round: with 100 stamps the error of a shear at
    S/N 15 was 2 % larger than with the true spectrum, with 400 1 %, and the S/N of the
    galaxies 6 % and 2 % lower.

    The mode k = 0 is the background's. The measurement makes no use of it; here the mean
    of its eight neighbours stands for it.

    `variance_err` is the larger of what Gaussian noise of this spectrum must have, and of
    the scatter between 50 groups of neighbouring stamps.
    """
    stamps = _checked(blank_stamps)
    summaries = np.concatenate([np.empty((0, 3)), *map(_summaries, _parts(stamps))])
    good = np.flatnonzero(_is_noise(summaries))
    n, (ny, nx) = len(good), stamps.shape[1:]
    if n < _FEWEST:
        raise FdntValueError(
            f"{n} of {len(stamps)} blank stamps hold noise and nothing else, "
            f"and {_FEWEST} are needed; constant stamps and those with NaN do not count"
        )
    if n < (1.0 - _MANY_REJECTED) * len(stamps):
        warnings.warn(
            f"{len(stamps) - n} of {len(stamps)} blank stamps were left out: they hold more "
            "than noise, or NaN",
            FdntWarning,
            stacklevel=2,
        )
    power = _mean_periodogram(stamps, good)
    by_chance = math.sqrt(2.0 * float(np.sum(power**2)) / n) / (ny * nx)
    return NoisePower(
        variance=float(np.mean(power)),
        variance_err=max(by_chance, group_error(summaries[good, 0])),
        power=power,
        power_err=power * _relative_errors(ny, nx, n),
        n_stamps=n,
        n_rejected=len(stamps) - n,
        is_white=_is_white(power, n),
    )


def noise_stamps(image: NDArray[Any], shape: tuple[int, int]) -> NDArray[Any]:
    """Cut a blank image into as many stamps as fit, side by side from its first pixel.

    Parameters
    ----------
    image : array, shape (height, width)
        Noise, with few objects.
    shape : tuple of int
        (ny, nx) of the stamps.

    Returns
    -------
    array, shape (n, ny, nx)
        Of the type of the image.

    Raises
    ------
    ShapeMismatchError
        If the image has not two axes, or no stamp fits.
    """
    if image.ndim != 2:
        raise ShapeMismatchError(f"a noise image has two axes, not the shape {image.shape}")
    ny, nx = shape
    rows, columns = image.shape[0] // ny, image.shape[1] // nx
    if rows * columns == 0:
        raise ShapeMismatchError(
            f"no stamp of {nx} x {ny} pixels fits into a noise image of {image.shape[1]} x "
            f"{image.shape[0]}"
        )
    cells = image[: rows * ny, : columns * nx].reshape(rows, ny, columns, nx)
    return cells.swapaxes(1, 2).reshape(-1, ny, nx)


def group_error(values: NDArray[np.float64]) -> float:
    """Return the error of a mean by the scatter of up to 50 groups of neighbours.

    It sees what single values do not: that neighbours deviate together. NaN for fewer than
    two values.
    """
    n_groups = min(_MOST_GROUPS, len(values))
    if n_groups < 2:
        return math.nan
    means = [np.mean(group) for group in np.array_split(values, n_groups)]
    return float(np.std(means, ddof=1)) / math.sqrt(n_groups)


def _checked(blank_stamps: NDArray[Any]) -> NDArray[Any]:
    stamps = np.asarray(blank_stamps)
    if stamps.ndim != 3 or min(stamps.shape[1:]) < 2 * _NEAR + 2:
        raise ShapeMismatchError(
            "blank_stamps must have the shape (n, ny, nx) with 8 pixels or more on a side, "
            f"not {stamps.shape}"
        )
    return stamps


def _parts(stamps: NDArray[Any], rows: NDArray[np.intp] | None = None) -> Iterator[NDArray[Any]]:
    """Yield stamps a few at a time, as float64."""
    rows = np.arange(len(stamps)) if rows is None else rows
    for start in range(0, len(rows), _AT_ONCE):
        yield stamps[rows[start : start + _AT_ONCE]].astype(np.float64)


def _summaries(stamps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return mean square, largest pixel and largest smoothed pixel, (n, 3); NaN if useless."""
    useful = np.all(np.isfinite(stamps), axis=(1, 2)) & (np.ptp(stamps, axis=(1, 2)) > 0)
    stamps = np.where(useful[:, None, None], stamps, 0.0)
    stamps -= np.mean(stamps, axis=(1, 2), keepdims=True)
    ny, nx = stamps.shape[1:]
    k2 = np.fft.fftfreq(ny)[:, None] ** 2 + np.fft.rfftfreq(nx)[None, :] ** 2
    blur = np.exp(-0.5 * (2.0 * np.pi * _BLUR) ** 2 * k2)
    smooth = np.fft.irfft2(np.fft.rfft2(stamps) * blur, s=(ny, nx))
    peaks = [np.max(np.abs(pixels), axis=(1, 2)) for pixels in (stamps, smooth)]
    summaries = np.stack([np.mean(stamps**2, axis=(1, 2)), *peaks], axis=-1)
    return np.where(useful[:, None], summaries, np.nan)


def _is_noise(summaries: NDArray[np.float64]) -> NDArray[np.bool_]:
    useful = np.isfinite(summaries[:, 0])
    if not np.any(useful):
        return useful
    middle = np.median(summaries[useful], axis=0)
    width = SIGMA_PER_MAD * np.median(np.abs(summaries[useful] - middle), axis=0)
    near: NDArray[np.bool_] = np.all(np.abs(summaries - middle) <= _OUTLIER * width, axis=-1)
    return near  # False where NaN


def _mean_periodogram(stamps: NDArray[Any], rows: NDArray[np.intp]) -> NDArray[np.float64]:
    ny, nx = stamps.shape[1:]
    total = np.zeros((ny, nx))
    for part in _parts(stamps, rows):
        total += np.sum(np.abs(np.fft.fft2(part)) ** 2, axis=0)
    # -k is at the index (-j) mod n, along both axes.
    power = 0.5 * (total + np.roll(np.flip(total), (1, 1), axis=(0, 1))) / (len(rows) * ny * nx)
    around = power[np.ix_((-1, 0, 1), (-1, 0, 1))]
    power[0, 0] = (np.sum(around) - power[0, 0]) / 8.0
    return np.asarray(power)


def _relative_errors(ny: int, nx: int, n: int) -> NDArray[np.float64]:
    """Return the errors of Gaussian noise: exponential periodograms, χ² of 1 where k = -k."""
    errors = np.full((ny, nx), math.sqrt(1.0 / n))
    halves = [(0, size // 2) if size % 2 == 0 else (0,) for size in (ny, nx)]
    errors[np.ix_(*halves)] = math.sqrt(2.0 / n)
    errors[0, 0] = math.sqrt(0.25 / n)
    return errors


def _is_white(power: NDArray[np.float64], n: int) -> bool:
    """Test the scatter of the modes, and the correlations of near neighbours, by χ².

    The modes see lines and patterns, to `0.3/sqrt(n)` in all; the neighbours, of which each
    is known to `1/sqrt(n ny nx)`, what resampling does.
    """
    ny, nx = power.shape
    relative = power / np.mean(power)
    deviations = (relative - 1.0) / _relative_errors(ny, nx, n)
    deviations[0, 0] = 0.0
    # Each mode comes twice, the three where k = -k but once: a trifle too much for them.
    n_modes = 0.5 * (power.size - 1)
    excess = 0.5 * float(np.sum(deviations**2)) - n_modes
    # A mean of n exponential numbers has kurtosis, which widens the distribution of χ².
    chi2_modes = n_modes + excess / math.sqrt(1.0 + 3.0 / n)
    near = np.fft.ifft2(relative).real[np.ix_(*[np.arange(-_NEAR, _NEAR + 1)] * 2)]
    n_near = (near.size - 1) // 2
    chi2_near = 0.5 * n * power.size * (float(np.sum(near**2)) - near[_NEAR, _NEAR] ** 2)
    chances = [gammaincc(0.5 * n_modes, 0.5 * chi2_modes), gammaincc(0.5 * n_near, 0.5 * chi2_near)]
    return bool(min(chances) > _CHANCE)
