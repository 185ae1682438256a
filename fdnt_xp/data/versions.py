"""Galaxies for tests of bias, each drawn as it is and turned, with a shear and its opposite.

The mean over such versions has no shape of its own: what an estimator makes of them is the
shear, and its bias.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.data.profiles import load_galsim
from fdnt_xp.data.simulate import PSF_BETA, PSF_FWHM, sample_g
from fdnt_xp.errors import FdntValueError, RangeError

Kind: TypeAlias = Literal["exp", "dev", "mixed"]
KINDS: Final = ("exp", "dev", "mixed")
MIXED_RADII: Final = (1.3, 2.3)
_LARGEST_G: Final = 0.6
"""Of a shape before the shear: the stamps would cut off more elongated galaxies."""
_MIXED_FLUXES, _MIXED_PSFS, _MIXED_E, _MIXED_FWHM = 6.0, 20, 0.03, 0.1
"""Brightest over faintest; PSFs, and the ranges of their e and of their FWHM around the mean."""


@dataclass(frozen=True, kw_only=True)
class Population:
    """Galaxies to draw; `draw_versions` draws them.

    Parameters
    ----------
    kind : {"exp", "dev", "mixed"}
        Exponential, de Vaucouleurs, or both, with fluxes over a factor of 6 and 20 PSFs of
        different shape and size.
    radius : float or tuple of float
        Half-light radius in pixels, or the ends of a range.
    psf_e : float
        Distortion e1 of the Moffat PSF; e2 is half of that. For "mixed" those of the mean.
    shear : float
        Reduced shear g, applied along x as +g and -g.
    n_gal : int
        Different galaxies.
    stamp_size : int
        Pixels on a side.
    seed : int
        Of everything that is drawn but the noise.
    psf_image : str, optional
        Name of the image that is the PSF, where it is no Moffat; `psf_e` says nothing then.
    """

    kind: Kind = "exp"
    radius: float | tuple[float, float] = 2.3
    psf_e: float = 0.1
    shear: float = 0.02
    n_gal: int = 1024
    stamp_size: int = 48
    seed: int = 0
    psf_image: str | None = None

    def __post_init__(self) -> None:
        """Refuse what cannot be drawn."""
        if self.kind not in KINDS:
            raise FdntValueError(f"no kind {self.kind!r} of galaxies; known are {', '.join(KINDS)}")
        low, high = self.radii
        if not (0.0 < low <= high and high < 0.25 * self.stamp_size):
            raise FdntValueError(
                f"radius must be positive, or a range from low to high, and below a quarter of "
                f"the stamp of {self.stamp_size} pixels, not {self.radius!r}"
            )
        if not 0.0 <= self.psf_e <= 0.5:
            raise RangeError("psf_e", self.psf_e, 0.0, 0.5)
        if not 0.0 < self.shear <= 0.2:
            raise RangeError("shear", self.shear, 0.0, 0.2)
        if self.n_gal < 2:
            raise RangeError("n_gal", self.n_gal, 2, None)

    @property
    def radii(self) -> tuple[float, float]:
        """Ends of the range of radii."""
        if isinstance(self.radius, int | float):
            return float(self.radius), float(self.radius)
        low, high = self.radius
        return float(low), float(high)


@dataclass(frozen=True, kw_only=True)
class Versions:
    """Galaxies without noise, each drawn four times.

    Parameters
    ----------
    population : Population
        What was drawn.
    stamps : array, shape (n_gal, 2, 2, ny, nx)
        By galaxy; as it is, and turned by 90 degrees counter-clockwise before the shear with
        its offset from the middle; shear +g, and -g. The PSF is never turned.
    psf_images : array, shape (n_psf, ny, nx)
        With the pixel.
    psf_of : array, shape (n_gal,)
        Which PSF each galaxy has.
    offsets : array, shape (n_gal, 2, 2)
        By galaxy; as it is, and turned; (x, y) of the centre from the middle of the stamp.
    e_rms : float
        Of one component of the distortions before the shear.
    """

    population: Population
    stamps: NDArray[np.float64]
    psf_images: NDArray[np.float64]
    psf_of: NDArray[np.int64]
    offsets: NDArray[np.float64]
    e_rms: float


def draw_versions(population: Population, psf: Any | None = None) -> Versions:
    """Draw every galaxy four times: as it is and turned, with shear +g and -g.

    Parameters
    ----------
    population : Population
    psf : galsim.GSObject, optional
        In place of the Moffat; the pixel response included, centred on 0, lengths in pixels.
        See `fdnt_xp.data.own_psf.psf_of_image`.

    Raises
    ------
    MissingExtraError
        If GalSim is not installed.
    """
    galsim = load_galsim()
    # The wings of an elongated de Vaucouleurs need transforms beyond GalSim's limit.
    accuracy = galsim.GSParams(folding_threshold=2e-3, maximum_fft_size=32768, kvalue_accuracy=1e-6)
    n, size = population.n_gal, population.stamp_size
    rng = np.random.default_rng([population.seed, 0])
    pixel = psf is None
    psfs = [psf] if psf is not None else [
        galsim.Moffat(beta=PSF_BETA, fwhm=fwhm, gsparams=accuracy).shear(e1=e1, e2=e2)
        for fwhm, e1, e2 in _psf_shapes(population, rng)]  # fmt: skip
    psf_of = rng.integers(len(psfs), size=n)
    g, angle = _intrinsic_g(rng, n), rng.uniform(0.0, 2.0 * np.pi, n)
    shapes = np.stack([g * np.cos(angle), g * np.sin(angle)], axis=-1)
    offset = rng.uniform(-0.5, 0.5, (n, 2))
    offsets = np.stack([offset, np.stack([-offset[:, 1], offset[:, 0]], axis=-1)], axis=1)
    mixed = population.kind == "mixed"
    radii = rng.uniform(*population.radii, n)
    fluxes = _MIXED_FLUXES ** rng.uniform(0.0, 1.0, n) if mixed else np.ones(n)
    profiles = {"exp": galsim.Exponential, "dev": galsim.DeVaucouleurs}
    kinds = rng.choice(["exp", "dev"], n) if mixed else np.full(n, population.kind)
    stamps = np.zeros((n, 2, 2, size, size))
    for i in range(n):
        round_one = profiles[kinds[i]](
            half_light_radius=radii[i], flux=fluxes[i], gsparams=accuracy
        )
        for turned, shape in enumerate((shapes[i], -shapes[i])):
            galaxy = round_one.shear(g1=shape[0], g2=shape[1])
            for minus, shear in enumerate((population.shear, -population.shear)):
                seen = galsim.Convolve([galaxy.shear(g1=shear, g2=0.0), psfs[psf_of[i]]])
                at = galsim.PositionD(*offsets[i, turned])
                stamps[i, turned, minus] = _draw(seen, size, at, pixel)
    return Versions(
        population=population,
        stamps=stamps,
        psf_images=np.stack([_draw(one, size, None, pixel) for one in psfs]),
        psf_of=psf_of,
        offsets=offsets,
        e_rms=float(np.sqrt(0.5 * np.mean((2.0 * g / (1.0 + g**2)) ** 2))),
    )


def _psf_shapes(population: Population, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return FWHM, e1 and e2 of each PSF, (n_psf, 3)."""
    mean = np.array([[PSF_FWHM, population.psf_e, 0.5 * population.psf_e]])
    if population.kind != "mixed":
        return mean
    spread = np.array([_MIXED_FWHM * PSF_FWHM, _MIXED_E, _MIXED_E])
    return mean + spread * rng.uniform(-1.0, 1.0, (_MIXED_PSFS, 3))


def _intrinsic_g(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    g = np.empty(0)
    while len(g) < n:
        more = sample_g(rng, n)
        g = np.concatenate([g, more[more < _LARGEST_G]])
    return g[:n]


def _draw(profile: Any, size: int, offset: Any, pixel: bool) -> NDArray[np.float64]:
    method = "auto" if pixel else "no_pixel"
    image = profile.drawImage(
        nx=size, ny=size, scale=1.0, offset=offset, dtype=np.float64, method=method
    )
    return np.asarray(image.array)
