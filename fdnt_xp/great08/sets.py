"""What is simulated: the parameters of a challenge, and the drawing of each of its sets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.data.simulate import (
    NOISE_SIGMA,
    draw_offsets,
    draw_pairs,
    draw_stamp,
    set_positions,
)
from fdnt_xp.data.stamps import SMALLEST_STAMP
from fdnt_xp.errors import FdntValueError, RangeError
from fdnt_xp.great08.populations import (
    BRANCHES,
    PSFS,
    SNR,
    Branch,
    Condition,
    conditions,
    galaxy_table,
    seen_galaxies,
)

if TYPE_CHECKING:
    from astropy.table import Table

PsfKind: TypeAlias = Literal["star", "moffat"]
PSF_KINDS: Final = ("star", "moffat")
SETS: Final[dict[str, int]] = {"low-noise": 15, "real-noise": 27}
"""How many by branch, if not said."""
MAX_SHEAR: Final = 0.05
_LARGEST_SHEAR: Final = 0.3
_POPULATION, _NOISE, _SHEARS = range(3)
"""Streams of random numbers, so that a set's do not depend on how many another has used."""


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """What to draw; made by `make_simulation`, which knows the defaults of the branches.

    Parameters
    ----------
    branch : {"low-noise", "real-noise"}
        Which part of the challenge.
    n_sets : int
        Images.
    grid : int
        Cells on a side of an image; even, for the galaxies come in pairs.
    cell : int
        Pixels on a side of a cell.
    snr : float
        `sqrt(sum of I²)/sigma` of a galaxy; for "real-noise" that of most sets.
    seed : int
        Of everything random.
    n_shears : int
        Different root shears.
    max_shear : float
        They are uniform in the disc `|g| <= max_shear`.
    psf_kind : {"star", "moffat"}
        Whether the PSF is given as the image of a star or by its formula.
    oversampling : int
        Pixels of the star's image per pixel of the galaxies, along one axis.
    """

    branch: Branch
    n_sets: int
    grid: int
    cell: int
    snr: float
    seed: int
    n_shears: int
    max_shear: float
    psf_kind: PsfKind
    oversampling: int

    def __post_init__(self) -> None:
        """Refuse what cannot be drawn."""
        for name, known in (("branch", BRANCHES), ("psf_kind", PSF_KINDS)):
            if getattr(self, name) not in known:
                raise FdntValueError(
                    f"{name} must be {' or '.join(known)}, not {getattr(self, name)!r}"
                )
        if self.grid < 2 or self.grid % 2:
            raise FdntValueError(f"galaxies come in pairs: grid must be even, not {self.grid}")
        if self.cell < SMALLEST_STAMP:
            raise RangeError("cell", self.cell, SMALLEST_STAMP, None)
        if not 0.0 < self.snr < math.inf:
            raise RangeError("snr", self.snr, 0.0, None)
        if not 0.0 <= self.max_shear <= _LARGEST_SHEAR:
            raise RangeError("max_shear", self.max_shear, 0.0, _LARGEST_SHEAR)
        least = {"n_sets": 1, "n_shears": 1, "oversampling": 1, "seed": 0}
        for name, minimum in least.items():
            if getattr(self, name) < minimum:
                raise RangeError(name, getattr(self, name), minimum, None)

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """What the sets go through in turn."""
        return conditions(self.branch, self.snr)

    def condition(self, number: int) -> Condition:
        """Return the condition of a set, numbered from 1."""
        return self.conditions[(number - 1) % len(self.conditions)]

    def shear_number(self, number: int) -> int:
        """Return the root shear of a set, from 0: all conditions have one before the next."""
        return (number - 1) // len(self.conditions) % self.n_shears

    def shear(self, number: int) -> tuple[float, float]:
        """Return the reduced shear of a set."""
        rng = np.random.default_rng([self.seed, self.shear_number(number), _SHEARS])
        radius = self.max_shear * math.sqrt(rng.uniform())
        angle = 2.0 * math.pi * rng.uniform()
        return radius * math.cos(angle), radius * math.sin(angle)


@dataclass(frozen=True, kw_only=True)
class DrawnSet:
    """One set.

    Parameters
    ----------
    image : array, shape (grid cell, grid cell), float32
        One galaxy in each cell, with noise of `NOISE_SIGMA`.
    truth : astropy.table.Table
        One row for each cell, along x first.
    """

    image: NDArray[np.float32]
    truth: Table


def make_simulation(
    branch: Branch = "low-noise",
    *,
    n_sets: int | None = None,
    grid: int = 100,
    cell: int = 64,
    snr: float | None = None,
    seed: int = 1,
    n_shears: int | None = None,
    max_shear: float = MAX_SHEAR,
    psf_kind: PsfKind = "star",
    oversampling: int = 1,
) -> Simulation:
    """Return what to draw, with the defaults of the branch; see `Simulation`.

    "low-noise" has 15 sets, each with a shear of its own, at S/N 200; "real-noise" 27, three
    shears for each of nine conditions, at S/N 20 and for two of the nine half and twice that.

    Raises
    ------
    FdntValueError, RangeError
        If it cannot be drawn.
    """
    if branch not in BRANCHES:
        raise FdntValueError(f"branch must be {' or '.join(BRANCHES)}, not {branch!r}")
    n_sets = SETS[branch] if n_sets is None else n_sets
    snr = SNR[branch] if snr is None else snr
    if n_shears is None:
        n_shears = max(1, math.ceil(n_sets / len(conditions(branch, snr))))
    return Simulation(
        branch=branch,
        n_sets=n_sets,
        grid=grid,
        cell=cell,
        snr=snr,
        seed=seed,
        n_shears=n_shears,
        max_shear=max_shear,
        psf_kind=psf_kind,
        oversampling=oversampling,
    )


def draw_set(simulation: Simulation, number: int) -> DrawnSet:
    """Draw one set, numbered from 1.

    Raises
    ------
    MissingExtraError
        If GalSim is not installed.
    """
    grid, cell = simulation.grid, simulation.cell
    condition, shear = simulation.condition(number), simulation.shear(number)
    rng = np.random.default_rng([simulation.seed, number, _POPULATION])
    pairs = draw_pairs(rng, grid**2)
    offsets = draw_offsets(rng, grid**2)
    truth = galaxy_table(rng, pairs, condition, shear)
    set_positions(truth, offsets, grid, cell)
    noise = np.random.default_rng([simulation.seed, number, _NOISE])
    image = np.empty((grid * cell, grid * cell), dtype=np.float32)
    galaxies = seen_galaxies(truth, condition, shear)
    for row in range(grid):
        # In double precision a row of cells at a time, for an image may have 0.2 GB.
        strip = NOISE_SIGMA * noise.standard_normal((cell, grid * cell))
        for column in range(grid):
            i = row * grid + column
            stamp, truth["flux"][i] = draw_stamp(next(galaxies), cell, offsets[i], condition.snr)
            strip[:, column * cell : (column + 1) * cell] += stamp
        image[row * cell : (row + 1) * cell] = strip
    return DrawnSet(image=image, truth=truth)


def shear_table(simulation: Simulation) -> Table:
    """Return the true shears of all sets, and what each set has, as `read_truth` reads it."""
    from astropy.table import Table

    rows = []
    for number in range(1, simulation.n_sets + 1):
        condition, (g1, g2) = simulation.condition(number), simulation.shear(number)
        psf_g1, psf_g2 = PSFS[condition.psf]
        to_e = 2.0 / (1.0 + psf_g1**2 + psf_g2**2)
        rows.append(
            {
                "set": number,
                "shear": simulation.shear_number(number),
                "g1": g1,
                "g2": g2,
                "condition": condition.name,
                "snr": condition.snr,
                "size_ratio": condition.size_ratio,
                "galaxies": condition.galaxies,
                "psf": condition.psf,
                "psf_e1": to_e * psf_g1,
                "psf_e2": to_e * psf_g2,
            }
        )
    table = Table(rows=rows)
    for name, description in _DESCRIPTIONS.items():
        table[name].description = description
    return table


_DESCRIPTIONS: Final = {
    "set": "number of the image: 1 for set0001",
    "shear": "number of the root shear",
    "g1": "reduced shear, component 1",
    "g2": "reduced shear, component 2",
    "condition": "what is special about the set",
    "snr": "sqrt(sum I^2)/sigma of every galaxy",
    "size_ratio": "FWHM of the round convolved galaxy over that of the PSF",
    "galaxies": "single: bulge or disc; aligned, askew: both",
    "psf": "name of the PSF",
    "psf_e1": "its distortion without the pixel, component 1",
    "psf_e2": "its distortion without the pixel, component 2",
}
