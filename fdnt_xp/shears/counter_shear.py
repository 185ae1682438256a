"""Statistics of galaxies seen through a trial counter-shear, for the population null.

For a trial shear gamma everything is evaluated at `kappa = S_gamma k`: exactly the galaxies
with gamma taken off. A statistic is a spin-2 quantity of each galaxy in that frame, two
numbers that turn with the image. If gamma is the shear that was applied, the galaxies are
isotropic there and its mean is zero, whatever the PSF and the morphology.

The weight ends at `kmax/reach`, so that its disc, sheared by any `|gamma|` <= 2 ln(reach),
stays where the PSF has left information.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Protocol

from fdnt_xp.arrays import Array, array_namespace
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.fourier.transform import DeconvolvedStamps
from fdnt_xp.nulltests.dogleg import DoglegOptions, find_root
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.nulltests.weights import Weight
from fdnt_xp.shapes.centroid import DipoleTests
from fdnt_xp.shears.weights import ShapeWeight

_OPTIONS: Final = DoglegOptions(max_iter=30, initial_radius=1.0, max_radius=3.0)
"""Radii in `|eta|` and in the length unit of centroids."""


@dataclass(frozen=True, kw_only=True)
class FrameValues:
    """A statistic of each galaxy in one counter-sheared frame.

    Parameters
    ----------
    v : array, shape (n_gal, 2)
        The statistic, of such a sign that it falls as gamma takes shear off; 0 where it
        failed.
    found : array, shape (n_gal,), bool
        Where it did not fail.
    solution : array, shape (n_gal, d)
        Unknowns that were solved, the start of the next frame.
    """

    v: Array
    found: Array
    solution: Array


class Statistic(Protocol):
    """A spin-2 quantity of each galaxy in a counter-sheared frame."""

    @property
    def n_unknown(self) -> int:
        """Unknowns that are solved for each galaxy; the last two are the centroid."""
        ...

    def evaluate(
        self, grid: KGrid, galaxies: DeconvolvedStamps, weight: Weight, start: Array
    ) -> FrameValues:
        """Return the statistic on a counter-sheared grid.

        Parameters
        ----------
        grid : KGrid
            `KGrid.sheared(gamma)`.
        galaxies : DeconvolvedStamps
        weight : Weight
            Shrunk by the reach.
        start : array, shape (n_gal, n_unknown)
            A solution in another frame, or a first guess; the centroid in units of `length`.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class FrozenQuadrupole:
    """The quadrupole of each galaxy under one fixed round weight, over its monopole.

    `v = -(sum W Re I~ (kx² - ky²), sum W Re I~ 2 kx ky) / sum W Re I~ |kappa|²` in the
    counter-sheared frame, at the centroid where the dipole vanishes. No shape is solved:
    eta stays 0. A galaxy elongated along x is narrow in kx, hence the sign.

    Parameters
    ----------
    size : float
        sigma of the Gaussian part of the weight, pixels: one for the whole sample.
    length : float
        Unit of centroids, pixels.
    """

    size: float
    length: float

    @property
    def n_unknown(self) -> int:
        """The centroid."""
        return 2

    def evaluate(
        self, grid: KGrid, galaxies: DeconvolvedStamps, weight: Weight, start: Array
    ) -> FrameValues:
        """Return the statistic on a counter-sheared grid: see `Statistic`."""
        xp = array_namespace(start=start)
        window = weight.round_window(grid, self.size)
        dipole = DipoleTests(grid=grid, galaxies=galaxies, weight=window, length=self.length)
        root = find_root(dipole, start, options=_OPTIONS)
        re, _ = galaxies.shifted(grid, self.length * root.x)
        _, even, _ = grid.even_moments(window * re)
        monopole = even[:, 0] + even[:, 2]
        found = root.success & (monopole > 0)
        safe = xp.where(found, monopole, xp.ones_like(monopole))
        v = xp.stack([even[:, 2] - even[:, 0], -2.0 * even[:, 1]], axis=-1) / safe[:, None]
        solution = xp.where(root.success[:, None], root.x, start)
        return FrameValues(v=_or_zero(v, found), found=found, solution=solution)


@dataclass(frozen=True, kw_only=True)
class SolvedEta:
    """The shape of each galaxy in the counter-sheared frame, `w(|eta|) eta`.

    The five null tests are solved anew in every frame, at `k' = S_eta S_gamma k` with the
    shrink factor `exp(|eta|/2)` that the unlensed galaxy has.

    Parameters
    ----------
    weight : ShapeWeight
        w.
    length : float
        Unit of centroids, pixels.
    size : float, optional
        Fixes sigma of the Gaussian part of the weight, pixels.
    """

    weight: ShapeWeight
    length: float
    size: float | None

    @property
    def n_unknown(self) -> int:
        """Shape and centroid."""
        return 4

    def evaluate(
        self, grid: KGrid, galaxies: DeconvolvedStamps, weight: Weight, start: Array
    ) -> FrameValues:
        """Return the statistic on a counter-sheared grid: see `Statistic`."""
        xp = array_namespace(start=start)
        column = start[:, 0]
        tests = NullTests(
            grid=grid,
            galaxies=galaxies,
            weight=weight,
            length=self.length,
            fixed_width=None if self.size is None else xp.full_like(column, self.size**2),
        )
        root = find_root(tests, start, options=_OPTIONS)
        found = root.success
        eta = _or_zero(root.x[:, :2], found)
        abs_eta = xp.sqrt(eta[:, 0] ** 2 + eta[:, 1] ** 2)
        v = self.weight(abs_eta)[:, None] * eta
        solution = xp.where(found[:, None], root.x, start)
        return FrameValues(v=_or_zero(v, found), found=found, solution=solution)


def in_new_frame(solution: Array, old: KGrid, new: KGrid) -> Array:
    """Return solutions with their centroids carried from one frame to another."""
    xp = array_namespace(solution=solution)
    centroid = new.from_stamp(old.on_stamp(solution[:, -2:]))
    return xp.concat([solution[:, :-2], centroid], axis=-1)


def _or_zero(v: Array, found: Array) -> Array:
    xp = array_namespace(v=v)
    return xp.where(found[:, None], v, xp.zeros_like(v))
