"""Simulated fields: the LowNoise galaxies of GREAT08, drawn with GalSim.

Bridle et al. 2009 (GREAT08 handbook) and Bernstein 2010, section 5.4: half the galaxies pure
exponential, half pure de Vaucouleurs, one size, one signal to noise, one shear; a truncated
and slightly elliptical Moffat PSF; pairs at 90 degrees, so that the mean shape without shear
is zero.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import j0

from fdnt_xp.data.profiles import load_galsim
from fdnt_xp.data.stamps import SMALLEST_STAMP
from fdnt_xp.errors import FdntValueError, RangeError

if TYPE_CHECKING:
    from astropy.table import Table

PSF_BETA: Final = 3.0
PSF_FWHM: Final = 2.85
"""Pixels."""
PSF_TRUNCATION: Final = 2.0
"""Radius where the Moffat ends, in FWHM."""
PSF_G: Final = (-0.019, -0.007)
SIZE_RATIO: Final = 1.4
"""FWHM of the round convolved galaxy over that of the round PSF, both before the pixel."""
SERSIC_INDICES: Final = {"exp": 1.0, "dev": 4.0}
NOISE_SIGMA: Final = 1000.0
"""Of one pixel: Poisson noise of the sky of 1e6, which is taken off."""
CENTROID_RADIUS: Final = 1.0
"""Pixels."""
MAX_G: Final = 0.95
"""Where the distribution of shapes is cut; 1e-4 of it lie beyond, with an axis ratio over 39."""


@dataclass(frozen=True, kw_only=True)
class SimulatedField:
    """An image of known galaxies.

    Parameters
    ----------
    image : array, shape (n_y cell, n_x cell), float64
        One galaxy in each cell.
    psf_image : array, shape (cell, cell), float64
        The PSF with the pixel, of unit sum.
    truth : astropy.table.Table
        One row for each cell, along x first.
    """

    image: NDArray[np.float64]
    psf_image: NDArray[np.float64]
    truth: Table


def great08_image(
    *,
    n_x: int = 40,
    n_y: int = 40,
    cell: int = 64,
    shear: tuple[float, float] = (0.02, -0.01),
    snr: float | None = 200.0,
    seed: int = 0,
    psf: Any = None,
) -> SimulatedField:
    """Draw galaxies of GREAT08's LowNoise population with a known shear.

    The same arguments give the same image, to the bit.

    Parameters
    ----------
    n_x, n_y : int
        Cells; their product must be even, for the galaxies come in pairs.
    cell : int
        Pixels on a side of a cell. GREAT08 had 40, which truncates its elongated galaxies.
    shear : tuple of float
        Applied reduced shear (g1, g2).
    snr : float or None
        `sqrt(sum of I²)/sigma` of every galaxy. None draws no noise, with fluxes as for 200.
    seed : int
        Of everything random.
    psf : galsim.GSObject, optional
        Instead of GREAT08's, without the pixel. Sizes of the galaxies stay as they are.

    Raises
    ------
    MissingExtraError
        If GalSim is not installed.
    """
    galsim = load_galsim()
    n_gal = n_x * n_y
    _check(n_gal, cell, shear, snr)
    rng = np.random.default_rng(seed)
    truth = truth_table(draw_pairs(rng, n_gal), shear)
    offsets = draw_offsets(rng, n_gal)
    psf = great08_psf() if psf is None else psf
    image = np.zeros((n_y * cell, n_x * cell))
    galaxies = sheared_galaxies(truth, shear, round_galaxies(SIZE_RATIO, fine_gsparams()))
    for i, galaxy in enumerate(galaxies):
        y, x = i // n_x * cell, i % n_x * cell
        stamp, truth["flux"][i] = draw_stamp(
            galsim.Convolve([galaxy, psf]), cell, offsets[i], 200.0 if snr is None else snr
        )
        image[y : y + cell, x : x + cell] = stamp
    if snr is not None:
        image += NOISE_SIGMA * rng.standard_normal(image.shape)
    set_positions(truth, offsets, n_x, cell)
    psf_image = _draw(psf, cell, (0.0, 0.0))
    return SimulatedField(image=image, psf_image=psf_image / psf_image.sum(), truth=truth)


def great08_psf(g: tuple[float, float] = PSF_G, *, gsparams: Any = None) -> Any:
    """Return the fiducial PSF of GREAT08 as a GalSim object, without the pixel.

    Parameters
    ----------
    g : tuple of float
        Another shape for it, (a-b)/(a+b).
    gsparams : galsim.GSParams, optional
        Instead of `fine_gsparams`.
    """
    galsim = load_galsim()
    moffat = galsim.Moffat(
        beta=PSF_BETA,
        fwhm=PSF_FWHM,
        trunc=PSF_TRUNCATION * PSF_FWHM,
        gsparams=fine_gsparams() if gsparams is None else gsparams,
    )
    return moffat.shear(g1=g[0], g2=g[1])


def fine_gsparams() -> Any:
    """Return the accuracy of `great08_image`: wings fold back at 1e-5 of the peak."""
    # The wings of an elongated de Vaucouleurs need transforms beyond GalSim's limit.
    return load_galsim().GSParams(folding_threshold=2e-3, maximum_fft_size=32768)


def quick_gsparams() -> Any:
    """Return an accuracy for many images: still within 1e-4 of the peak, in a third of the time.

    What is left there is from the end of the PSF's transform, as with `fine_gsparams`.
    """
    return load_galsim().GSParams(
        folding_threshold=2e-2, minimum_fft_size=64, maximum_fft_size=32768
    )


@lru_cache(maxsize=16)
def half_light_radius(sersic_n: float, size_ratio: float = SIZE_RATIO) -> float:
    """Solve for the half-light radius that makes the FWHM of the seen galaxy a ratio.

    Galaxy and PSF are round and without the pixel: `FWHM(galaxy * psf) = ratio FWHM(psf)`.

    Parameters
    ----------
    sersic_n : float
        Index of the galaxy's profile.
    size_ratio : float
        Above 1.

    Returns
    -------
    float
        Pixels; 1.268 for an exponential and 3.016 for a de Vaucouleurs at a ratio of 1.4.
    """
    galsim = load_galsim()
    fine = galsim.GSParams(kvalue_accuracy=1e-6)
    psf = galsim.Moffat(
        beta=PSF_BETA, fwhm=PSF_FWHM, trunc=PSF_TRUNCATION * PSF_FWHM, gsparams=fine
    )
    k, psf_k = _transform(psf)
    # I(r) is the integral of k J0(kr) I~(k), so this is I(r) - I(0)/2 at half the wanted FWHM.
    kernel = k * psf_k * (j0(0.5 * size_ratio * PSF_FWHM * k) - 0.5)

    def excess(radius: float) -> float:
        galaxy = galsim.Sersic(n=sersic_n, half_light_radius=radius, gsparams=fine)
        return float(np.sum(kernel * _transform(galaxy)[1]))

    return float(brentq(excess, 0.1, 20.0, xtol=1e-6))


def sample_g(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    """Draw `|g| = (a - b)/(a + b)` of unsheared galaxies, by the inverse of its distribution.

    `P(g) ∝ g cos²(πg/2) exp(-(2g/0.19)^0.58)` up to `MAX_G`, the handbook's.
    """
    g = np.linspace(0.0, MAX_G, 9001)
    cumulative = np.concatenate([[0.0], np.cumsum(0.5 * (density_g(g[1:]) + density_g(g[:-1])))])
    return np.interp(rng.uniform(0.0, cumulative[-1], n), cumulative, g)


def density_g(g: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distribution of `sample_g`, not normalised."""
    density: NDArray[np.float64] = (
        g * np.cos(0.5 * np.pi * g) ** 2 * np.exp(-((2.0 * g / 0.19) ** 0.58))
    )
    return density


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """Unsheared shapes in pairs at 90 degrees, spread over the cells at random.

    Parameters
    ----------
    shape : array, shape (n_gal, 2), float64
        (g1, g2) of each, `(a - b)/(a + b)`.
    number : array, shape (n_gal,), int64
        Of the pair that it belongs to.
    turned : array, shape (n_gal,), bool
        Whether it is the second of its pair: the first, turned by 90 degrees.
    """

    shape: NDArray[np.float64]
    number: NDArray[np.int64]
    turned: NDArray[np.bool_]


def draw_pairs(rng: np.random.Generator, n_gal: int) -> Pairs:
    """Draw the shapes of an even number of galaxies."""
    n_pairs = n_gal // 2
    size, angle = sample_g(rng, n_pairs), rng.uniform(0.0, 2.0 * np.pi, n_pairs)
    first = np.stack([size * np.cos(angle), size * np.sin(angle)], axis=-1)
    order = rng.permutation(n_gal)
    return Pairs(
        shape=np.concatenate([first, -first])[order],
        number=np.tile(np.arange(n_pairs), 2)[order],
        turned=order >= n_pairs,
    )


def draw_offsets(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    """Draw (x, y) of centroids from the middle of their cells, shape (n, 2), in pixels."""
    radius, angle = CENTROID_RADIUS * np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def truth_table(pairs: Pairs, shear: tuple[float, float], size_ratio: float = SIZE_RATIO) -> Table:
    """Make the truth table, one row for each cell; `x`, `y` and `flux` are zero as yet.

    Every second pair is exponential, the others are de Vaucouleurs.
    """
    from astropy.table import Table

    galsim = load_galsim()
    n_gal = len(pairs.number)
    kinds = np.where(pairs.number % 2 == 0, "exp", "dev")
    applied = galsim.Shear(g1=shear[0], g2=shear[1])
    lensed = [applied + galsim.Shear(g1=g1, g2=g2) for g1, g2 in pairs.shape]
    radii = {kind: half_light_radius(n, size_ratio) for kind, n in SERSIC_INDICES.items()}
    columns: dict[str, tuple[Any, str | None, str]] = {
        "id": (np.arange(n_gal), None, "number of the cell, along x first"),
        "x": (np.zeros(n_gal), "pix", "centroid along columns, 0-based"),
        "y": (np.zeros(n_gal), "pix", "centroid along rows, 0-based"),
        "intrinsic_g1": (pairs.shape[:, 0], None, "(a-b)/(a+b) before the shear, component 1"),
        "intrinsic_g2": (pairs.shape[:, 1], None, "(a-b)/(a+b) before the shear, component 2"),
        "g1": (np.array([s.g1 for s in lensed]), None, "reduced shear shape, component 1"),
        "g2": (np.array([s.g2 for s in lensed]), None, "reduced shear shape, component 2"),
        "kind": (kinds, None, "exp: exponential, dev: de Vaucouleurs"),
        "pair": (pairs.number, None, "number of the pair at 90 degrees"),
        "half_light_radius": (np.vectorize(radii.get)(kinds), "pix", "of the round galaxy"),
        "flux": (np.zeros(n_gal), None, "in units of the image"),
    }
    table = Table({name: values for name, (values, _, _) in columns.items()})
    for name, (_, unit, description) in columns.items():
        table[name].unit, table[name].description = unit, description
    return table


def set_positions(truth: Table, offsets: NDArray[np.float64], n_x: int, cell: int) -> None:
    """Write `x` and `y` of galaxies, given from the middle of their cells, into their table."""
    row, column = np.divmod(np.arange(len(truth)), n_x)
    truth["x"][:] = column * cell + 0.5 * (cell - 1) + offsets[:, 0]
    truth["y"][:] = row * cell + 0.5 * (cell - 1) + offsets[:, 1]


def round_galaxies(size_ratio: float, gsparams: Any) -> dict[str, Any]:
    """Return by kind a round galaxy of unit flux whose seen FWHM has the ratio to the PSF's."""
    galsim = load_galsim()
    return {
        kind: galsim.Sersic(
            n=n, half_light_radius=half_light_radius(n, size_ratio), gsparams=gsparams
        )
        for kind, n in SERSIC_INDICES.items()
    }


def sheared_galaxies(
    truth: Table, shear: tuple[float, float], round_ones: dict[str, Any]
) -> Iterator[Any]:
    """Yield each galaxy of a truth table with unit flux, sheared, centred."""
    for row in truth:
        galaxy = round_ones[row["kind"]].shear(g1=row["intrinsic_g1"], g2=row["intrinsic_g2"])
        yield galaxy.shear(g1=shear[0], g2=shear[1])


def draw_stamp(
    profile: Any, cell: int, offset: Any, snr: float
) -> tuple[NDArray[np.float64], float]:
    """Draw a profile of unit flux with the pixel, and give it a signal to noise.

    Parameters
    ----------
    profile : galsim.GSObject
        What is seen, without the pixel.
    cell : int
        Pixels on a side.
    offset : pair of float
        (x, y) of the centre from the middle of the cell, pixels.
    snr : float
        `sqrt(sum of I²)/NOISE_SIGMA` that it gets.

    Returns
    -------
    array, shape (cell, cell), float64
        Without noise.
    float
        The flux that it was given.
    """
    stamp = _draw(profile, cell, offset)
    flux = snr * NOISE_SIGMA / math.sqrt(np.sum(stamp**2))
    return flux * stamp, flux


def _draw(profile: Any, cell: int, offset: Any) -> NDArray[np.float64]:
    galsim = load_galsim()
    stamp = galsim.ImageD(cell, cell)
    profile.drawImage(stamp, scale=1.0, offset=galsim.PositionD(*offset))
    return np.asarray(stamp.array)


def _transform(profile: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return wave numbers, to 30 rad/pixel, and the transform of a round profile there."""
    n, step = 30_000, 0.001
    line = profile.drawKImage(nx=2 * n + 1, ny=1, scale=step).array[0]
    return np.linspace(0.0, n * step, n + 1), np.ascontiguousarray(line[n:].real)


def _check(n_gal: int, cell: int, shear: tuple[float, float], snr: float | None) -> None:
    if n_gal < 2 or n_gal % 2:
        raise FdntValueError(f"galaxies come in pairs: n_x n_y must be even, not {n_gal}")
    if cell < SMALLEST_STAMP:
        raise RangeError("cell", cell, SMALLEST_STAMP, None)
    if math.hypot(*shear) >= 1:
        raise RangeError("|shear|", math.hypot(*shear), 0.0, 1.0)
    if snr is not None and not snr > 0:
        raise RangeError("snr", snr, 0.0, None)
