"""Images whose truth is known without any code of the package: sums of sampled Gaussians."""

from __future__ import annotations

import math

import numpy as np

from fdnt_xp.shear import shear_matrix


def gaussian_image(
    covariance: np.ndarray,
    shape: tuple[int, int] = (48, 48),
    *,
    centre: tuple[float, float] = (0.0, 0.0),
    flux: float = 1.0,
) -> np.ndarray:
    """Return a Gaussian of the given covariance matrix (x, y), sampled at the pixel centres.

    `centre` is counted from the middle of the array. Convolving Gaussians adds covariances.
    """
    ny, nx = shape
    y, x = np.mgrid[:ny, :nx]
    d = np.stack([x - 0.5 * (nx - 1) - centre[0], y - 0.5 * (ny - 1) - centre[1]], axis=-1)
    inverse = np.linalg.inv(covariance)
    norm = flux / (2.0 * np.pi * np.sqrt(np.linalg.det(covariance)))
    return norm * np.exp(-0.5 * np.einsum("...i,ij,...j", d, inverse, d))


def gaussian_covariance(e: tuple[float, float], sigma: float) -> np.ndarray:
    """Return the covariance of distortion e and half the trace sigma²."""
    return sigma**2 * np.array([[1.0 + e[0], e[1]], [e[1], 1.0 - e[0]]])


PSF_COVARIANCE = gaussian_covariance((0.1, -0.06), 1.8)


def star(shape: tuple[int, int] = (48, 48)) -> np.ndarray:
    """Return an elliptical Gaussian PSF."""
    return gaussian_image(PSF_COVARIANCE, shape)


def galaxies(
    e: np.ndarray,
    shape: tuple[int, int] = (48, 48),
    *,
    sigma: float = 2.2,
    centres: np.ndarray | None = None,
) -> np.ndarray:
    """Return Gaussian galaxies of distortion `e` (n, 2), behind the PSF of `star`, flux 1."""
    centres = np.zeros((len(e), 2)) if centres is None else centres
    return np.stack(
        [
            gaussian_image(gaussian_covariance(tuple(one), sigma) + PSF_COVARIANCE, shape, centre=c)
            for one, c in zip(e, map(tuple, centres), strict=True)
        ]
    )


SHEAR = np.array([0.03, -0.02])
"""A reduced shear for rings."""


def eta_of(g: tuple[float, float]) -> np.ndarray:
    """Return the conformal shear of a reduced shear."""
    g = np.asarray(g)
    norm = np.linalg.norm(g)
    return 2.0 * math.atanh(norm) * g / norm if norm else np.zeros(2)


def ring(
    g: tuple[float, float],
    *,
    n: int = 8,
    eta: float = 0.7,
    sigma: float = 2.2,
    start: float = 0.1,
    shape: tuple[int, int] = (48, 48),
) -> np.ndarray:
    """Return elliptical Gaussians at n position angles, lensed by g, behind the PSF of `star`."""
    lens = shear_matrix(eta_of(g))
    images = []
    for angle in start + np.pi * np.arange(n) / n:
        intrinsic = shear_matrix(eta * np.array([np.cos(2 * angle), np.sin(2 * angle)]))
        distortion = lens @ intrinsic
        # A round Gaussian distorted by M has the covariance M Mᵀ.
        covariance = sigma**2 * distortion @ distortion.T + PSF_COVARIANCE
        images.append(gaussian_image(covariance, shape, centre=(0.3 * np.cos(5 * angle), 0.2)))
    return np.stack(images)
