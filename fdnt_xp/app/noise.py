"""The noise that is handed to a measurement: given, or found in the image or beside it."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.data.images import Pixels, native_pixels
from fdnt_xp.data.noise import BorderNoise, measure_border_noise
from fdnt_xp.data.noise_power import NoisePower, measure_noise_power, noise_stamps
from fdnt_xp.data.stamps import StampSource
from fdnt_xp.errors import FdntValueError, FdntWarning, RangeError, ShapeMismatchError

_BLANK_BYTES: Final = 2**28
"""Of blank stamps that are looked at: enough for their power to a per cent, and no more memory."""


@dataclass(frozen=True, kw_only=True)
class Noise:
    """The noise that is handed to the measurement.

    Parameters
    ----------
    variance : float or None
        Per pixel; None if there is none.
    border : BorderNoise, optional
        What it was measured from: the borders of the stamps,
    blank : NoisePower, optional
        or blank stamps; it was given if both are None.
    mapped : bool
        Whether a map has it for each pixel; there is no number then.
    """

    variance: float | None
    border: BorderNoise | None = None
    blank: NoisePower | None = None
    mapped: bool = False

    @property
    def origin(self) -> str:
        """Where the number came from."""
        if self.mapped:
            return "weight map"
        if self.blank is not None:
            return "noise image"
        return "given" if self.border is None else "stamp borders"

    @property
    def relative_err(self) -> float | None:
        """Relative error of the variance; None if it was given."""
        measured = self.blank or self.border
        if measured is None or self.variance is None:
            return None
        return measured.variance_err / self.variance

    @property
    def power(self) -> NDArray[np.float64] | None:
        """Power spectrum, shape (ny, nx); None if the noise is white as far as is known."""
        return None if self.blank is None or self.blank.is_white else self.blank.power


def find_noise(
    source: StampSource,
    given: float | None = None,
    blank: Pixels | None = None,
    *,
    mask: StampSource | None = None,
    mapped: bool = False,
) -> Noise:
    """Return the variance given, or the noise of blank sky, or that of the stamps' borders.

    Warns (`FdntWarning`) of a background left in the image, and if there is no noise.

    Parameters
    ----------
    source : StampSource
        The stamps.
    given : float, optional
        Variance of a pixel.
    blank : array, shape (height, width) or (n, ny, nx), optional
        Image of noise, or stamps of it of the shape of those of the source.
    mask : StampSource, optional
        Beside the source; pixels of the borders where it is not 0 are left out.
    mapped : bool
        Whether a map has the inverse variance of each pixel, so that none is to be found.
    """
    if mapped and (given is not None or blank is not None):
        raise FdntValueError(
            "--weight says what the noise of each pixel is: give no --noise-variance and no "
            "--noise-image with it"
        )
    if mapped:
        return Noise(variance=None, mapped=True)
    if given is not None and blank is not None:
        raise FdntValueError("give --noise-variance or --noise-image, not both")
    if given is not None:
        if not (np.isfinite(given) and given > 0):
            raise RangeError("noise_variance", given, 0.0, None)
        return Noise(variance=given)
    if blank is not None:
        measured = measure_noise_power(_blank_stamps(blank, source.stamp_shape))
        return Noise(variance=measured.variance, blank=measured)
    border = measure_border_noise(source, mask)
    if border.has_background:
        warnings.warn(
            f"the borders of the stamps are not at zero but at {border.level:.4g} +- "
            f"{border.level_err:.2g} (noise {border.variance**0.5:.4g}): "
            "take the background off the image",
            FdntWarning,
            stacklevel=2,
        )
    if not border.known and source.n_gal:
        warnings.warn(
            "no noise can be measured on the borders of the stamps, so there are no errors "
            "and no S/N; give the variance (--noise-variance, --noise-image)",
            FdntWarning,
            stacklevel=2,
        )
    return Noise(variance=border.variance if border.known else None, border=border)


def _blank_stamps(blank: Pixels, shape: tuple[int, int]) -> NDArray[Any]:
    """Return stamps of a blank image, or the planes of a cube; evenly spread ones of many."""
    most = max(_BLANK_BYTES // (8 * shape[0] * shape[1]), 1)
    if blank.ndim == 2:
        ny, (height, width) = shape[0], blank.shape
        if min(height // ny, width // shape[1]) == 0:
            return noise_stamps(native_pixels(blank), shape)  # which says what is wrong
        rows = _evenly(height // ny, max(most // (width // shape[1]), 1))
        bands = (native_pixels(blank[row * ny : (row + 1) * ny]) for row in rows)
        return np.concatenate([noise_stamps(band, shape) for band in bands])
    if blank.shape[1:] != shape:
        raise ShapeMismatchError(
            f"the planes of the noise image have {blank.shape[2]} x {blank.shape[1]} pixels, "
            f"the stamps of the galaxies {shape[1]} x {shape[0]}; they must be the same"
        )
    return np.stack([native_pixels(blank[int(row)]) for row in _evenly(len(blank), most)])


def _evenly(n: int, most: int) -> NDArray[np.int64]:
    """Return the numbers 0 to n - 1, or so many of them, evenly spread."""
    return np.arange(n) if n <= most else np.linspace(0, n - 1, most).astype(np.int64)
