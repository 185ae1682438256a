"""Other people's estimators of shear, to be put to the same test as ours.

Each takes noisy stamps and returns their shear; what it needs is imported when it is called.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.data.profiles import load_galsim
from fdnt_xp.errors import FdntValueError, MissingExtraError

if TYPE_CHECKING:
    from types import ModuleType

FPFS_SIZE: Final = 2.5
"""sigma of the shapelets of FPFS, pixels: near the 0.52 arcsec that its authors use at 0.2
arcsec a pixel."""
_LARGEST_E: Final = 2.0
"""Of REGAUSS: the catalogs of HSC end there."""
_ROW: Final = 64
"""Stamps side by side on the image that AnaCal gets."""


@dataclass(frozen=True, kw_only=True)
class NoisyStamps:
    """What an estimator is given: noisy versions of galaxies, all with the same shear.

    Parameters
    ----------
    pixels, clean : array, shape (n, ny, nx)
        Square; with noise, and without.
    shear : float
        Reduced shear along x that was put on.
    identifiers, symmetry : array of integers, shape (n,)
        Of `population_null`; those of all versions of a galaxy are the same.
    psf_of : array of integers, shape (n,)
        Which PSF each has.
    offsets : array, shape (n, 2)
        True centres (x, y), from the middle of the stamp.
    variance : float
        Of the noise of a pixel.
    seed : int
        Of whatever noise the estimator adds.
    e_rms : float
        Of one component of the distortions before the shear.
    power : array, shape (ny, nx), optional
        Power spectrum of the noise, where pixels are not independent.
    """

    pixels: NDArray[np.float64]
    clean: NDArray[np.float64]
    shear: float
    identifiers: NDArray[np.int64]
    symmetry: NDArray[np.int64]
    psf_of: NDArray[np.int64]
    offsets: NDArray[np.float64]
    variance: float
    seed: int
    e_rms: float
    power: NDArray[np.float64] | None = None

    def take(self, rows: NDArray[np.int64]) -> NoisyStamps:
        """Return the stamps of the given rows."""
        names = ("pixels", "clean", "identifiers", "symmetry", "psf_of", "offsets")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})


@dataclass(frozen=True, kw_only=True)
class Found:
    """The shear of one batch: (g1, g2), error of one stamp, stamps that were used."""

    g: NDArray[np.float64]
    sigma_g: float
    n_used: int


def load_anacal() -> ModuleType:
    """Import AnaCal, or raise `MissingExtraError`."""
    try:
        import anacal
    except ImportError as error:
        raise MissingExtraError(
            "this estimator needs AnaCal, which is not installed: pip install anacal"
        ) from error
    module: ModuleType = anacal
    return module


def regauss_shear(stamps: NoisyStamps, psf_images: NDArray[np.float64]) -> Found:
    """Return the mean shape by re-Gaussianisation, `galsim.hsm.EstimateShear`, over its response.

    As is usual, the response is `2 (1 - e_rms²)`, and galaxies for which HSM fails, or finds
    `|e|` of 2 and more, are left out.

    Parameters
    ----------
    stamps : NoisyStamps
        The search begins in the middle of each.
    psf_images : array, shape (n_psf, ny, nx)
        PSFs, pixel included.

    Raises
    ------
    MissingExtraError
        If GalSim is not installed.

    References
    ----------
    .. [1] Hirata & Seljak 2003, MNRAS 343, 459.
    """
    e = np.reshape(
        [
            (shape.corrected_e1, shape.corrected_e2)
            for shape in hsm_shapes(stamps, psf_images, "REGAUSS")
            if shape.correction_status == 0
            and math.hypot(shape.corrected_e1, shape.corrected_e2) < _LARGEST_E
        ],
        (-1, 2),
    )
    return _ratio(e, np.full_like(e, 2.0 * (1.0 - stamps.e_rms**2)))


def ksb_shear(stamps: NoisyStamps, psf_images: NDArray[np.float64]) -> Found:
    """Return the mean of the shears of galaxies that KSB finds, `galsim.hsm.EstimateShear`.

    Each is the estimate of a shear as it stands; those of 1 and more are left out. Parameters
    and errors are those of `regauss_shear`.

    References
    ----------
    .. [1] Kaiser, Squires & Broadhurst 1995, ApJ 449, 460.
    """
    g = np.reshape(
        [
            (shape.corrected_g1, shape.corrected_g2)
            for shape in hsm_shapes(stamps, psf_images, "KSB")
            if shape.correction_status == 0
            and math.hypot(shape.corrected_g1, shape.corrected_g2) < 1.0
        ],
        (-1, 2),
    )
    return _ratio(g, np.ones_like(g))


def hsm_shapes(stamps: NoisyStamps, psf_images: NDArray[np.float64], method: str) -> list[Any]:
    """Return what `galsim.hsm.EstimateShear` says of each stamp, failures included."""
    galsim = load_galsim()
    psfs = [galsim.Image(image) for image in psf_images]
    return [
        galsim.hsm.EstimateShear(
            galsim.Image(np.ascontiguousarray(pixels)),
            psfs[psf],
            sky_var=stamps.variance,
            shear_est=method,
            strict=False,
        )
        for pixels, psf in zip(stamps.pixels, stamps.psf_of, strict=True)
    ]


def fpfs_shear(
    stamps: NoisyStamps, psf_images: NDArray[np.float64], *, renoise: bool = True
) -> Found:
    """Return the mean ellipticity of AnaCal's FPFS over its mean linear response.

    `sigma_shapelets1` is `FPFS_SIZE`, `kmax_thres` 1e-12; the constant `c0` is the m00 of a
    point of the mean flux. More noise, of the same variance, takes the noise bias off
    ("renoising"). Nothing is detected: the true positions stand in for that.

    Parameters
    ----------
    stamps, psf_images
        As for `regauss_shear`; of one size.
    renoise : bool
        Without it nothing is added, and the noise bias stays.

    Raises
    ------
    MissingExtraError
        If AnaCal is not installed.

    References
    ----------
    .. [1] Li & Mandelbaum 2023, MNRAS 521, 4904.
    .. [2] Li et al. 2025, MNRAS 536, 3663.
    """
    values, responses = [], []
    for measure in fpfs_calls(stamps, psf_images, renoise=renoise):
        table = measure()
        values += list(zip(table["fpfs1_e1"], table["fpfs1_e2"], strict=True))
        responses += list(zip(table["fpfs1_de1_dg1"], table["fpfs1_de2_dg2"], strict=True))
    return _ratio(np.array(values), np.array(responses))


def fpfs_calls(
    stamps: NoisyStamps, psf_images: NDArray[np.float64], *, renoise: bool = True
) -> list[Callable[[], NDArray[Any]]]:
    """Prepare the measurement by FPFS, one for each PSF; each returns a catalog of AnaCal's.

    Parameters and errors are those of `fpfs_shear`.
    """
    fpfs = load_anacal().fpfs
    size = stamps.pixels.shape[-1]
    flux = float(np.mean(np.sum(stamps.pixels, axis=(-2, -1))))
    config = fpfs.FpfsConfig(
        npix=size,
        sigma_shapelets1=FPFS_SIZE,
        kmax_thres=1e-12,
        c0=flux / (2.0 * math.pi * FPFS_SIZE**2),
    )
    more_noise = _more_noise(stamps) if renoise else None
    calls: list[Callable[[], NDArray[Any]]] = []
    for number in np.unique(stamps.psf_of):
        rows = np.flatnonzero(stamps.psf_of == number)
        calls.append(
            partial(
                fpfs.process_image,
                fpfs_config=config,
                pixel_scale=1.0,
                noise_variance=stamps.variance,
                mag_zero=fpfs.THRESHOLD_REF_MAG_ZERO,
                gal_array=_tiled(stamps.pixels[rows]),
                psf_array=psf_images[number],
                noise_array=None if more_noise is None else _tiled(more_noise[rows]),
                detection=_detection(stamps.offsets[rows], size),
            )
        )
    return calls


def turn_quarter(images: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn images, (n, ny, nx), by 90 degrees counter-clockwise; y is up."""
    return np.rot90(images, -1, axes=(-2, -1))


def _ratio(values: NDArray[np.float64], responses: NDArray[np.float64]) -> Found:
    """Return the shear of spin-2 values, (n, 2), and their responses to it."""
    if len(values) < 2:
        raise FdntValueError(f"{len(values)} galaxies are measured; a shear needs two")
    response = np.mean(responses, axis=0)
    g = np.mean(values, axis=0) / response
    influence = (values - responses * g) / response
    return Found(g=g, sigma_g=float(np.sqrt(np.mean(influence**2))), n_used=len(values))


def _more_noise(stamps: NoisyStamps) -> NDArray[np.float64]:
    """Return more noise of each galaxy, turned and of the sign of its version."""
    shape = stamps.pixels.shape[1:]
    names, which = np.unique(stamps.identifiers, return_inverse=True)
    drawn = [np.random.default_rng([stamps.seed, name]).standard_normal(shape) for name in names]
    noise = math.sqrt(stamps.variance) * np.stack(drawn)[which]
    turned = stamps.symmetry % 4 == 1
    noise[turned] = turn_quarter(noise[turned])
    noise[stamps.symmetry >= 4] *= -1.0
    return noise


def _detection(offsets: NDArray[np.float64], size: int) -> NDArray[Any]:
    """Return where the galaxies are on the tiled image, as AnaCal has it."""
    cell = np.arange(len(offsets))
    detection = np.zeros(len(offsets), dtype=[("y", "f8"), ("x", "f8")])
    # AnaCal has the PSF on the pixel size//2; ours is half a pixel before it, which moves
    # the deconvolved galaxies half a pixel on.
    detection["x"] = cell % _ROW * size + offsets[:, 0] + size // 2
    detection["y"] = cell // _ROW * size + offsets[:, 1] + size // 2
    return detection


def _tiled(stamps: NDArray[np.float64]) -> NDArray[np.float32]:
    """Lay stamps side by side, `_ROW` in a row."""
    n, size = len(stamps), stamps.shape[-1]
    image = np.zeros((-(-n // _ROW), _ROW, size, size), dtype=np.float32)
    image.reshape(-1, size, size)[:n] = stamps
    return np.ascontiguousarray(image.swapaxes(1, 2)).reshape(-1, _ROW * size)
