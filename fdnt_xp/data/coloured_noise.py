"""Noise that is correlated between pixels, for simulations: stamps cut out of a plane of it.

Noise of stamps that is drawn mode by mode is periodic: its left edge knows of the right one. The
noise of a survey is not, and its spectrum as it is measured on stamps is that of the plane under
the window of a stamp (`PixelNoise.without_window`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.fourier.noise import PixelNoise


def coloured_stamps(
    rng: np.random.Generator, n: int, power: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Draw stamps of Gaussian noise whose spectrum, measured on them, is `power`.

    Parameters
    ----------
    rng : numpy.random.Generator
    n : int
        Stamps.
    power : array, shape (ny, nx)
        `E|FFT(noise)|²/(ny nx)`, the same at k and -k, as `measure_noise_power` finds it.

    Returns
    -------
    array, shape (n, ny, nx)
        Cut out of fields of twice the side, whose noise is periodic. Correlations beyond a
        quarter of a stamp come out weaker than they are in `power`.
    """
    ny, nx = power.shape
    spectrum = _plane_spectrum(power)
    white = rng.standard_normal((n, *spectrum.shape))
    half = np.sqrt(spectrum[:, : nx + 1])
    return np.fft.irfft2(np.fft.rfft2(white) * half, s=spectrum.shape)[:, :ny, :nx]


def _plane_spectrum(power: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the spectrum without the window of a stamp, on twice as many modes a side."""
    ny, nx = power.shape
    pixels = PixelNoise.of_power(power[None], 1).without_window()
    assert pixels.correlation is not None
    lags = np.zeros((2 * ny, 2 * nx))
    lags[:ny, :nx] = float(pixels.variance[0]) * pixels.correlation[0]
    # No lag to the corner; a measured spectrum may fall below zero by its errors.
    centred = np.roll(lags, (-(ny // 2), -(nx // 2)), axis=(0, 1))
    return np.maximum(np.fft.fft2(centred).real, 0.0)
