"""Where to start: the centroid of each galaxy under a wide round weight.

The null tests have many roots far from the galaxy; a start that is centred finds the
right one. Under a fixed round weight the dipole alone is solved, from the stamp's centre.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from fdnt_xp.arrays import Array, Rows, array_namespace, blocks_in_cache, device_of, rows_of
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.fourier.transform import DeconvolvedStamps
from fdnt_xp.nulltests.dogleg import DoglegOptions, RootProblem, find_root
from fdnt_xp.nulltests.scaled import over_scale
from fdnt_xp.nulltests.weights import Weight
from fdnt_xp.shear import shear_matrix

_WIDE: Final = 0.125
"""Size of the weight of the first centroid, in sides of the stamp: it reaches a third of it."""
_LEAST_WEIGHT: Final = 1e-4
"""Of a mode that is looked at for a first centroid, in units of that at k = 0."""


@dataclass(frozen=True, kw_only=True)
class DipoleTests:
    """The dipole of each galaxy under a fixed weight: a `RootProblem` in `(x0/L, y0/L)`.

    Parameters
    ----------
    grid : KGrid
    galaxies : DeconvolvedStamps
    weight : array, shape (n_gal or 1, n_k)
        W on the modes of the grid.
    length : float
        L, pixels.
    """

    grid: KGrid
    galaxies: DeconvolvedStamps
    weight: Array
    length: float

    def take(self, rows: Rows) -> DipoleTests:
        """Return the problem of the given galaxies."""
        shared = int(self.weight.shape[0]) == 1
        weight = self.weight if shared else rows_of(self.weight, rows)
        return replace(
            self, grid=self.grid.take(rows), galaxies=self.galaxies.take(rows), weight=weight
        )

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """Return `sum W Im I~ k / (L sum W Re I~ |k|²)` and its Jacobian by x0/L.

        NaN where the denominator is not positive: there the weight sees no galaxy.
        """
        xp = array_namespace(x=x)
        values, slopes = self.raw(self.length * x)
        units = xp.asarray([1.0, 1.0, self.length], dtype=x.dtype, device=device_of(x))
        f, jac = over_scale(values * units, slopes * units[:, None])
        return f, self.length * jac

    def raw(self, centroid: Array) -> tuple[Array, Array]:
        """Return `sum W Im I~ k` and `sum W Re I~ |k|²`, (n_gal, 3), and slopes, (n_gal, 3, 2).

        Parameters
        ----------
        centroid : array, shape (n_gal, 2)
            Pixels from the centre of the stamp, by which the slopes are.
        """
        xp = array_namespace(centroid=centroid)
        evens, odds = [], []
        for rows in blocks_in_cache(self.galaxies.re):
            block = self.take(rows)
            re, im = block.galaxies.shifted(block.grid, centroid[rows, :])
            evens.append(block.grid.moments(block.weight * re, 2))
            odds.append(block.grid.moments(block.weight * im, 1, 3))
        even, odd = xp.concat(evens), xp.concat(odds)
        odd, cubic = odd[:, :2], odd[:, 2:]
        # d Im/dx0 = kx Re, and d(scale)/dx0 = -sum W Im k |k|².
        slopes = [even[:, 0:2], even[:, 1:3], -(cubic[:, 0:2] + cubic[:, 2:4])]
        values = xp.concat([odd, even[:, 0:1] + even[:, 2:3]], axis=-1)
        return values, xp.stack(slopes, axis=1)


def starting_centroid(
    grid: KGrid, galaxies: DeconvolvedStamps, weight: Array, length: float, *, reach: float
) -> Array:
    """Return a first centroid, pixels from the centre of the stamp; shape (n_gal, 2).

    Where no centroid is found within `reach` pixels, the centre of the stamp.
    """
    xp = array_namespace(weight=weight)
    # A host read: a wide weight is narrow in k, and its modes are few.
    number = xp.arange(grid.n_k, dtype=xp.int64, device=device_of(weight))
    seen = xp.any(weight > _LEAST_WEIGHT, axis=0)
    n_k = 1 + int(xp.max(xp.where(seen, number, xp.zeros_like(number))))
    problem = DipoleTests(
        grid=grid.inner(n_k), galaxies=galaxies.inner(n_k), weight=weight[:, :n_k], length=length
    )
    return find_centroid(problem, galaxies.re[:, :2], length, reach=reach)


def find_centroid(problem: RootProblem, like: Array, length: float, *, reach: float) -> Array:
    """Return where dipoles vanish, or the origin where that is not within `reach`.

    Parameters
    ----------
    problem : RootProblem
        In `(x0/L, y0/L)`.
    like : array, shape (n_gal, 2)
        Of the library, dtype and device of the result.
    length : float
        L.
    """
    xp = array_namespace(like=like)
    centre = xp.zeros_like(like)
    options = DoglegOptions(ftol=1e-2, max_iter=12, initial_radius=2.0, max_radius=8.0)
    found = length * find_root(problem, centre, options=options).x
    near = xp.abs(found) <= reach
    return xp.where((near[:, 0] & near[:, 1])[:, None], found, centre)


def wide_weight(
    weight: Weight, grid: KGrid, side: int, applied_shear: Array | None = None
) -> Array:
    """Return the weight of the first centroid, shape (n_psf, n_k).

    Parameters
    ----------
    side : int
        Shorter side of the stamps, pixels.
    applied_shear : array, shape (2,), optional
        Makes the weight round in the frame from which this eta is taken off: the null of
        its dipole then follows that shear. By default it is round on the image, or, where the
        weight has a frame, on the sky.
    """
    xp = array_namespace(kmax=weight.kmax)
    shrink = xp.ones_like(weight.kmax)
    if applied_shear is not None:
        if weight.frame is None:
            grid = grid.sheared(applied_shear)
        else:
            weight = replace(
                weight, frame=xp.matmul(shear_matrix(applied_shear)[None, :, :], weight.frame)
            )
        # As in the null tests: the weight may not reach out of the disc.
        shrink = shrink * xp.exp(0.5 * xp.sqrt(xp.sum(applied_shear**2)))
    return weight.round_window(grid, _WIDE * side, shrink)
