"""Are the errors that are reported those that there are? Noise is put on, and the scatter seen."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.arrays import Array, to_numpy
from fdnt_xp.data.coloured_noise import coloured_stamps
from fdnt_xp.data.noise_power import SIGMA_PER_MAD
from fdnt_xp.data.versions import Versions
from fdnt_xp.errors import FdntValueError, FdntWarning, RangeError
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.shapes.measure import measure_shapes
from fdnt_xp.shears.population import population_null

_GALAXIES: Final = 32
"""Whose shear is measured again and again; each is there turned as well."""
_TIMES: Final = 10
_SHAPES: Final = 2
"""Of those times in which shapes are measured too: faint ones take a while to fail."""


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Scatter over reported error, and what failed, at one S/N.

    Parameters
    ----------
    shear_ratio, shear_ratio_err : float
        Scatter of the shear of the same galaxies in noise that is new each time, over the mean
        `ShearEstimate.g_err_noise`; 1 is right. With its standard error.
    shape_ratio, shape_ratio_err : float
        Robust scatter of eta of a galaxy, over `eta_cov`, of those with a shape.
    shapes_failed : float
        Fraction of the stamps without a shape by `measure_shapes`.
    lost : float
        Fraction that the population null could not use.
    n_stamps : int
        Noisy stamps whose shear was measured; the shapes of a fifth of them were, too.
    """

    shear_ratio: float
    shear_ratio_err: float
    shape_ratio: float
    shape_ratio_err: float
    shapes_failed: float
    lost: float
    n_stamps: int


def error_calibration(
    versions: Versions,
    snr: float,
    *,
    power: NDArray[np.float64] | None = None,
    n_stamps: int = 6400,
    seed: int = 0,
    to_array: Callable[[NDArray[np.float64]], Array] = np.asarray,
) -> Calibration:
    """Compare the scatter that noise makes with the errors that are reported.

    Groups of 32 galaxies, each as it is and turned, get noise of their own ten times over.

    Parameters
    ----------
    versions : Versions
        From `draw_versions`, all with one PSF.
    snr : float
        `sqrt(<sum of I²>)/sigma`.
    power : array, shape (ny, nx), optional
        Power spectrum of the noise, up to a factor, where it is correlated between pixels.
    n_stamps : int
        Noisy stamps to measure, rounded up to whole groups.
    seed : int
        Of the noise.
    to_array : callable
        Takes a NumPy array to the library, device and precision that shall compute.

    Raises
    ------
    FdntValueError, RangeError
        If there is more than one PSF, or a number is out of range.
    """
    if len(versions.psf_images) != 1:
        raise FdntValueError(f"versions must have one PSF, not {len(versions.psf_images)}")
    if not 0.0 < snr < math.inf:
        raise RangeError("snr", snr, 0.0, None)
    if n_stamps < 1:
        raise RangeError("n_stamps", n_stamps, 1, None)
    sigma = math.sqrt(np.mean(np.sum(versions.stamps**2, axis=(-2, -1)))) / snr
    shape = versions.stamps.shape[-2:]
    spectrum = None if power is None else sigma**2 * power / np.mean(power)
    told = {"noise_variance": sigma**2} if spectrum is None else {"noise_power": to_array(spectrum)}
    psf = Psf.from_image(to_array(versions.psf_images[0]))
    n_groups = max(2, math.ceil(n_stamps / (2 * _GALAXIES * _TIMES)))
    rng = np.random.default_rng([seed, 77, round(1000 * snr)])
    shears, errors, pulls, failed, lost = [], [], [], [], []
    for group in range(n_groups):
        rows = (group * _GALAXIES + np.arange(_GALAXIES)) % len(versions.stamps)
        clean = np.concatenate([versions.stamps[rows, turned, 0] for turned in (0, 1)])
        noise = _noise(rng, _TIMES * len(clean), shape, sigma, spectrum).reshape(-1, *clean.shape)
        truth = measure_shapes(to_array(clean), psf)
        for number in range(_TIMES):
            stamps = to_array(clean + noise[number])
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", FdntWarning)
                shear = population_null(stamps, psf, seed=seed + number, **told)
            shears.append(to_numpy(shear.g))
            errors.append(to_numpy(shear.g_err_noise))
            lost.append(shear.n_excluded / len(clean))
            if number >= _SHAPES:
                continue
            seen = measure_shapes(stamps, psf, **told)
            off = to_numpy(seen.eta) - to_numpy(truth.eta)
            pulls.append(off / np.sqrt(to_numpy(seen.eta_cov)[:, [0, 1], [0, 1]]))
            failed.append(np.mean(~np.isfinite(off[:, 0])))
    return _calibration(
        np.reshape(shears, (n_groups, _TIMES, 2)),
        np.asarray(errors),
        np.concatenate(pulls),
        float(np.mean(failed)),
        float(np.mean(lost)),
    )


def _noise(
    rng: np.random.Generator,
    n: int,
    shape: tuple[int, int],
    sigma: float,
    spectrum: NDArray[np.float64] | None,
) -> NDArray[np.float64]:
    if spectrum is None:
        return sigma * rng.standard_normal((n, *shape))
    return coloured_stamps(rng, n, spectrum)


def _calibration(
    shears: NDArray[np.float64],
    errors: NDArray[np.float64],
    pulls: NDArray[np.float64],
    failed: float,
    lost: float,
) -> Calibration:
    """Sum up; `shears` is (n_groups, n_times, 2)."""
    variance = np.mean(np.var(shears, axis=1, ddof=1))
    freedom = shears.shape[0] * (shears.shape[1] - 1) * 2
    ratio = math.sqrt(variance / np.mean(errors**2))
    pulls = pulls[np.all(np.isfinite(pulls), axis=1)].ravel()
    # The median absolute deviation of a Gaussian has 0.37 of the efficiency of its variance.
    robust = SIGMA_PER_MAD * float(np.median(np.abs(pulls))) if pulls.size else math.nan
    return Calibration(
        shear_ratio=ratio,
        shear_ratio_err=ratio / math.sqrt(2.0 * freedom),
        shape_ratio=robust,
        shape_ratio_err=robust / math.sqrt(2.0 * 0.3675 * max(pulls.size, 1)),
        shapes_failed=failed,
        lost=lost,
        n_stamps=len(errors) * 2 * _GALAXIES,
    )
