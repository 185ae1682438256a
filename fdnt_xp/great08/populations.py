"""Which galaxies and PSFs the sets of each branch of GREAT08 have.

LowNoise is as Bernstein 2010, section 5.4, used it: each galaxy a pure exponential or a pure
de Vaucouleurs, one size, one PSF. RealNoise has one set at a fiducial point and others that
each change one thing; that it had three S/N, three sizes, three PSFs and three kinds of
galaxies is from memory of the challenge, and the values below are ours.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

import numpy as np

from fdnt_xp.data.profiles import load_galsim
from fdnt_xp.data.simulate import (
    PSF_BETA,
    PSF_FWHM,
    PSF_G,
    PSF_TRUNCATION,
    SERSIC_INDICES,
    SIZE_RATIO,
    Pairs,
    great08_psf,
    half_light_radius,
    quick_gsparams,
    round_galaxies,
    sheared_galaxies,
    truth_table,
)
from fdnt_xp.great08.moffat import MoffatPsf

if TYPE_CHECKING:
    from astropy.table import Table

Branch: TypeAlias = Literal["low-noise", "real-noise"]
BRANCHES: Final = ("low-noise", "real-noise")
Galaxies: TypeAlias = Literal["single", "aligned", "askew"]
"""A bulge or a disc; both, alike in shape and centre; both, neither alike."""

SNR: Final[dict[str, float]] = {"low-noise": 200.0, "real-noise": 20.0}
"""By branch; RealNoise has half and twice this as well."""
SIZE_RATIOS: Final = (1.22, SIZE_RATIO, 1.6)
"""FWHM of the round convolved galaxy over that of the PSF: small, fiducial, large."""
PSFS: Final[dict[str, tuple[float, float]]] = {
    "psf_fiducial": PSF_G,
    "psf_rotated": (-PSF_G[0], -PSF_G[1]),
    "psf_elongated": (2.0 * PSF_G[0], 2.0 * PSF_G[1]),
}
"""Shape (a-b)/(a+b) by name; all have the same round profile."""
BULGE_FLUX: Final = 0.5
"""Part of the flux of a galaxy with both."""
MISALIGNMENT: Final = 20.0
"""Standard deviation of the angle from the disc to the bulge of askew galaxies, degrees."""
DISPLACEMENT: Final = 0.3
"""Standard deviation of each component of the way from disc to bulge, before the shear, pixels."""


@dataclass(frozen=True, kw_only=True)
class Condition:
    """What the galaxies of one set have in common, but for their shear.

    Parameters
    ----------
    name : str
        What is special about it.
    snr : float
        `sqrt(sum of I²)/sigma` of every galaxy.
    size_ratio : float
        FWHM of the round convolved galaxy over that of the PSF.
    psf : str
        Name in `PSFS`.
    galaxies : {"single", "aligned", "askew"}
        What they are made of.
    """

    name: str
    snr: float
    size_ratio: float = SIZE_RATIO
    psf: str = "psf_fiducial"
    galaxies: Galaxies = "single"


def conditions(branch: Branch, snr: float) -> tuple[Condition, ...]:
    """Return what the sets of a branch go through in turn, first the fiducial one."""
    if branch == "low-noise":
        return (Condition(name="low-noise", snr=snr),)
    fiducial = Condition(name="fiducial", snr=snr, galaxies="aligned")
    small, _, large = SIZE_RATIOS
    return (
        fiducial,
        replace(fiducial, name="snr-low", snr=0.5 * snr),
        replace(fiducial, name="snr-high", snr=2.0 * snr),
        replace(fiducial, name="size-small", size_ratio=small),
        replace(fiducial, name="size-large", size_ratio=large),
        replace(fiducial, name="psf-rotated", psf="psf_rotated"),
        replace(fiducial, name="psf-elongated", psf="psf_elongated"),
        replace(fiducial, name="single", galaxies="single"),
        replace(fiducial, name="askew", galaxies="askew"),
    )


def analytic_psf(name: str) -> MoffatPsf:
    """Return the PSF of a name in `PSFS`, without the pixel."""
    trunc = PSF_TRUNCATION * PSF_FWHM
    return MoffatPsf(beta=PSF_BETA, fwhm=PSF_FWHM, g=PSFS[name], trunc=trunc)


def galaxy_table(
    rng: np.random.Generator, pairs: Pairs, condition: Condition, shear: tuple[float, float]
) -> Table:
    """Make the truth table of a set, as `data.simulate.truth_table` does.

    Galaxies with both components have the kind `exp+dev`; `intrinsic_g1`, `g1`,
    `half_light_radius` and so on are those of the disc, and columns `bulge_...` are added.
    """
    table = truth_table(pairs, shear, condition.size_ratio)
    if condition.galaxies == "single":
        return table
    n_gal = len(table)
    turn, (dx, dy) = np.zeros(n_gal), np.zeros((2, n_gal))
    if condition.galaxies == "askew":
        n_pairs = n_gal // 2
        turn = np.radians(MISALIGNMENT) * rng.standard_normal(n_pairs)[pairs.number]
        dx, dy = DISPLACEMENT * rng.standard_normal((2, n_pairs))[:, pairs.number]
        # The second of a pair is the whole galaxy turned.
        dx, dy = np.where(pairs.turned, -dy, dx), np.where(pairs.turned, dx, dy)
    shape = (pairs.shape[:, 0] + 1j * pairs.shape[:, 1]) * np.exp(2j * turn)
    radii = {kind: half_light_radius(n, condition.size_ratio) for kind, n in SERSIC_INDICES.items()}
    table.replace_column("kind", np.full(n_gal, "exp+dev"))
    table["kind"].description = "exp+dev: exponential disc with a de Vaucouleurs bulge"
    table["half_light_radius"][:] = radii["exp"]
    columns: dict[str, tuple[Any, str | None, str]] = {
        "bulge_g1": (shape.real, None, "(a-b)/(a+b) before the shear, component 1"),
        "bulge_g2": (shape.imag, None, "(a-b)/(a+b) before the shear, component 2"),
        "bulge_dx": (dx, "pix", "from the disc, before the shear, along columns"),
        "bulge_dy": (dy, "pix", "from the disc, before the shear, along rows"),
        "bulge_half_light_radius": (np.full(n_gal, radii["dev"]), "pix", "of the round bulge"),
        "bulge_flux_fraction": (np.full(n_gal, BULGE_FLUX), None, "of the flux of the galaxy"),
    }
    for name, (values, unit, description) in columns.items():
        table[name] = values
        table[name].unit, table[name].description = unit, description
    return table


def seen_galaxies(
    table: Table, condition: Condition, shear: tuple[float, float], *, gsparams: Any = None
) -> Iterator[Any]:
    """Yield each galaxy of a truth table as a GalSim object of unit flux, without the pixel.

    It is sheared, centred on its flux centroid, and convolved with the PSF.

    Parameters
    ----------
    table : astropy.table.Table
        From `galaxy_table`.
    condition : Condition
        Of the set.
    shear : tuple of float
        Reduced shear (g1, g2).
    gsparams : galsim.GSParams, optional
        Instead of `quick_gsparams`.
    """
    galsim = load_galsim()
    accuracy = quick_gsparams() if gsparams is None else gsparams
    psf = great08_psf(PSFS[condition.psf], gsparams=accuracy)
    round_ones = round_galaxies(condition.size_ratio, accuracy)
    single = condition.galaxies == "single"
    make = sheared_galaxies if single else _two_components
    for galaxy in make(table, shear, round_ones):
        yield galsim.Convolve([galaxy, psf])


def _two_components(
    table: Table, shear: tuple[float, float], round_ones: dict[str, Any]
) -> Iterator[Any]:
    disc, bulge = (1.0 - BULGE_FLUX) * round_ones["exp"], BULGE_FLUX * round_ones["dev"]
    for row in table:
        from_disc = np.array([row["bulge_dx"], row["bulge_dy"]])
        both = disc.shear(g1=row["intrinsic_g1"], g2=row["intrinsic_g2"]).shift(
            *(-BULGE_FLUX * from_disc)
        ) + bulge.shear(g1=row["bulge_g1"], g2=row["bulge_g2"]).shift(
            *((1.0 - BULGE_FLUX) * from_disc)
        )
        yield both.shear(g1=shear[0], g2=shear[1])
