"""The weight of the null tests, and the equation that sets its size.

In the frame where the galaxy is round, with `q = |k'|²` and `s = exp(|eta|/2)`,

    W(q) = 𝒯(s sqrt(q)) exp(-q sigma²/2),

B10 eq. (20) with the shrink factor of its §4.2. Because `s|k'| >= |k|`, the weight never
reaches a k outside the disc where the PSF has left information.

The size equation (B10 eq. 35 in the scale-free form of docs, "Size of the weight") matches
the mean square wave number of the weight to that of the galaxy, both under 𝒯. With
`u = s|k'|` it is a relation between two numbers, the same for every galaxy of one PSF: it
is inverted once, in a table.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fdnt_xp.arrays import Array, Rows, array_namespace, device_of, rows_of
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.fourier.interpolation import CubicTable, cubic_table
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.nulltests.forms import seen_through

_QUADRATURE: Final = 96
"""Gauss-Legendre nodes of the integrals over k in the size equation."""
_WIDTH_NODES: Final = 129
_LEAST_POSITION: Final = 1e-30
"""In the table of widths, whose root may be divided by and is far below any that matters."""
_NODES: Final = 257
"""Of the table that is inverted."""
_NEWTON_STEPS: Final = 4
"""1/<k²> is nearly linear in sigma² (exactly so for a Gaussian 𝒯): Newton needs few steps."""
_LEAST_SQUARE: Final = 1e-30
"""Of k, (rad/pixel)²: far below that of any mode but k = 0, and no trouble to divide by."""
_NARROWEST: Final = 0.5
"""Least `sigma kmax`: the Gaussian is then above 0.88 all over the disc and does no more."""


@dataclass(frozen=True, kw_only=True)
class WidthTable:
    """The size equation of each PSF, inverted.

    Widths are squares of sizes, `width = sigma²`, in pixel²: the size equation is nearly
    linear in them, and regular where the galaxy is too small to have a size.

    Parameters
    ----------
    part : CubicTable
        `kmax² sigma²` over the table's range, as a function of the root of where `kmax²/<k²>`
        is in its range (both mapped to [0, 1]), for s = 1: small widths need the finer nodes.
    width_range, square_range : array, shape (n_psf or n_gal, 2)
        The ranges of `kmax² sigma²` and `kmax²/<k²>`.
    """

    part: CubicTable
    width_range: Array
    square_range: Array

    def take(self, rows: Rows) -> WidthTable:
        """Return the ranges of the given galaxies, with all tables."""
        return replace(
            self,
            width_range=rows_of(self.width_range, rows),
            square_range=rows_of(self.square_range, rows),
        )


@dataclass(frozen=True, kw_only=True)
class Weight:
    """The weight for one PSF, or for one PSF per galaxy.

    Parameters
    ----------
    psf_part : CubicTable
        `𝒯` as a function of `k/kmax`. (Not of its square, which would take no root: many are
        not smooth in k² at 0, and a table of that costs accuracy.)
    kmax : array, shape (n_psf or n_gal,)
        Where `𝒯` ends, rad/pixel.
    widths : WidthTable, optional
        What `matched_width` needs.
    frame : array, shape (n_psf or n_gal, 2, 2), optional
        A: the weight is a function of `|A k|`, the wave number on the sky. That of the
        pixels without it.
    index : array of int64, shape (n_gal,), optional
        Which of the tables each galaxy has. Without it there is one for all, or one for each.
    """

    psf_part: CubicTable
    kmax: Array
    widths: WidthTable | None = None
    frame: Array | None = None
    index: Array | None = None

    def take(self, rows: Rows) -> Weight:
        """Return the weights of the given galaxies, with all tables; a shared one stays."""
        if self.shared:
            return self
        return replace(
            self,
            kmax=rows_of(self.kmax, rows),
            widths=None if self.widths is None else self.widths.take(rows),
            frame=None if self.frame is None else rows_of(self.frame, rows),
            index=rows_of(self._numbers, rows),
        )

    def only(self, row: Array) -> Weight:
        """Return the weight of one galaxy, shape (1,), to be shared by others."""
        one = self.take(row)
        widths = one.widths
        if widths is not None and one.index is not None:
            widths = replace(widths, part=widths.part.take(one.index))
        part = one.psf_part if one.index is None else one.psf_part.take(one.index)
        return replace(one, psf_part=part, widths=widths, index=None)

    def shrunk(self, factor: float) -> Weight:
        """Return the weights with their discs smaller by a factor, `kmax/factor`.

        For a counter-sheared grid: the disc then stays inside that of the data.
        """
        return replace(self, kmax=self.kmax / factor)

    @property
    def shared(self) -> bool:
        """Whether one weight serves all galaxies."""
        return self.index is None and int(self.kmax.shape[0]) == 1

    @property
    def _numbers(self) -> Array:
        """Which table each galaxy has."""
        if self.index is not None:
            return self.index
        xp = array_namespace(kmax=self.kmax)
        return xp.arange(int(self.kmax.shape[0]), dtype=xp.int64, device=device_of(self.kmax))

    def psf_factor(self, square: Array, shrink: Array) -> tuple[Array, Array]:
        """Return `𝒯(s sqrt(q))` and its derivative by q.

        Parameters
        ----------
        square : array, shape (n_gal, n_k)
            `q = |k'|²`; 0 where rounding makes it negative.
        shrink : array, shape (n_gal,)
            s.
        """
        xp = array_namespace(square=square)
        scale = (shrink / self.kmax)[:, None]
        # At k = 0 the derivative only ever meets factors of q: any finite number will do.
        t = xp.sqrt(xp.abs(square) + _LEAST_SQUARE)
        t *= scale
        value, slope = self.psf_part.evaluate(t, None if self.shared else self._numbers)
        slope /= t
        slope *= 0.5 * scale**2
        return value, slope

    def round_window(self, grid: KGrid, size: float, shrink: Array | None = None) -> Array:
        """Return the weight of a round galaxy on the modes of a grid, shape (n_psf, n_k).

        Parameters
        ----------
        size : float
            sigma, pixels.
        shrink : array, shape (n_psf,), optional
            s; 1 without it.
        """
        xp = array_namespace(kmax=self.kmax)
        shrink = xp.ones_like(self.kmax) if shrink is None else shrink
        square = (grid.kx**2 + grid.ky**2)[None, :]
        if self.frame is not None:
            one = xp.ones_like(self.kmax)
            form = seen_through(xp.stack([one, xp.zeros_like(one), one], axis=-1), self.frame)
            square = xp.matmul(form, grid.squares)
            # Rounding can make a tiny q negative; it is a square.
            square = xp.maximum(square, xp.zeros_like(square))
        square = xp.broadcast_to(square, (int(self.kmax.shape[0]), grid.n_k))
        psf_factor, _ = self.psf_factor(square, shrink)
        return psf_factor * xp.exp(-0.5 * size**2 * square)

    def matched_width(self, inverse_square: Array, shrink: Array) -> tuple[Array, Array, Array]:
        """Solve the size equation: the weight whose mean square wave number is the galaxy's.

        Parameters
        ----------
        inverse_square : array, shape (n_gal,)
            `1/<|k'|²>` of the galaxy under 𝒯; not NaN.
        shrink : array, shape (n_gal,)
            s.

        Returns
        -------
        width : array, shape (n_gal,)
            sigma², held inside the range of sizes.
        slope : array, shape (n_gal,)
            `d(sigma²)/d(1/<|k'|²>)`; zero at the bounds.
        at_bound : array, shape (n_gal,), bool
            Where the equation asks for a width beyond the range.
        """
        assert self.widths is not None  # its maker was told that sizes are matched
        xp = array_namespace(inverse_square=inverse_square)
        # In units where the disc of the sheared weight has radius 1: k = s|k'|/kmax.
        unit = (self.kmax / shrink) ** 2
        square_range, width_range = self.widths.square_range, self.widths.width_range
        low, high = square_range[:, 0], square_range[:, 1]
        position = (inverse_square * unit - low) / (high - low)
        at_bound = (position <= 0) | (position >= 1)
        inside = xp.minimum(xp.maximum(position, xp.zeros_like(unit)), xp.ones_like(unit))
        root = xp.sqrt(inside + _LEAST_POSITION)
        value, slope = self.widths.part.evaluate(root, None if self.shared else self._numbers)
        slope = slope / (2.0 * root)
        narrow, wide = width_range[:, 0], width_range[:, 1]
        width = (narrow + value * (wide - narrow)) / unit
        slope = slope * (wide - narrow) / (high - low)
        return width, xp.where(at_bound, xp.zeros_like(slope), slope), at_bound


def make_weight(psf: Psf, largest_size: float | None = None, *, every: int = 1) -> Weight:
    """Return the weight of each PSF.

    Parameters
    ----------
    psf : Psf
    largest_size : float, optional
        Largest sigma, pixels, to which the size can be matched. Not at all by default.
    every : int
        Leaves out nodes of the tables of sizes, whose error is of fourth order in their distance:
        with 4 they are good to 1e-4, and made in a third of the time.
    """
    widths = None if largest_size is None else _width_table(psf, largest_size, every)
    return Weight(psf_part=psf.weight, kmax=psf.kmax, widths=widths, frame=psf.frame)


def _width_table(psf: Psf, largest_size: float, every: int) -> WidthTable:
    """Invert the size equation of each PSF."""
    xp = array_namespace(kmax=psf.kmax)
    like = {"dtype": psf.kmax.dtype, "device": device_of(psf.kmax)}
    nodes, weights = np.polynomial.legendre.leggauss(_QUADRATURE)
    t = xp.asarray(0.5 * (nodes + 1.0), **like)
    row = xp.arange(psf.n_psf, dtype=xp.int64, device=device_of(psf.kmax))
    grid = xp.broadcast_to(t[None, :], (psf.n_psf, _QUADRATURE))
    measure = psf.weight.evaluate(grid, row)[0] * (t * xp.asarray(weights, **like))[None, :]

    narrow = xp.full_like(psf.kmax, _NARROWEST**2)
    # Above pi, where wave numbers are in a unit that is longer than a pixel: so is the cell then.
    kmax = xp.minimum(psf.kmax, xp.full_like(psf.kmax, math.pi))
    wide = xp.maximum((largest_size * kmax) ** 2, 4.0 * narrow)
    ends = xp.stack([narrow, wide], axis=-1)
    by_width = _SquareTable.of(measure, t, largest_size, 1 + (_NODES - 1) // every)
    square_ends, _ = by_width.inverse_mean_square(ends, row)
    fraction = xp.linspace(0.0, 1.0, 1 + (_WIDTH_NODES - 1) // every, **like)[None, :]
    low, high = square_ends[:, 0:1], square_ends[:, 1:2]
    wanted = low + fraction**2 * (high - low)
    width = ends[:, 0:1] + fraction**2 * (ends[:, 1:2] - ends[:, 0:1])
    for _ in range(_NEWTON_STEPS):
        square, slope = by_width.inverse_mean_square(width, row)
        width = xp.maximum(width + (wanted - square) / slope, ends[:, 0:1])
    relative = (width - ends[:, 0:1]) / (ends[:, 1:2] - ends[:, 0:1])
    return WidthTable(part=cubic_table(relative), width_range=ends, square_range=square_ends)


@dataclass(frozen=True, kw_only=True)
class _SquareTable:
    """`1/<t²>` under `𝒯(t) exp(-t² width/2) t dt` for each PSF, as a function of the width.

    The nodes, equidistant in the root of the width, are the same for all PSFs there may be: so
    are the exponentials, and the integrals are a matrix product.
    """

    part: CubicTable
    widest: float

    @classmethod
    def of(cls, measure: Array, t: Array, largest_size: float, n_node: int) -> _SquareTable:
        """Tabulate up to the largest size, pixels; `measure` (n_psf, n_t) holds `𝒯 t dt`."""
        xp = array_namespace(t=t)
        # As if no kmax were above pi. Beyond its end a table has no slope.
        widest = 1.01 * max(largest_size * math.pi, 2.0 * _NARROWEST)
        root = xp.linspace(_NARROWEST, widest, n_node, dtype=t.dtype, device=device_of(t))
        square = t**2
        gauss = xp.exp(square[:, None] * (-0.5 * root**2)[None, :])
        part = xp.matmul(measure, gauss) / xp.matmul(measure * square, gauss)
        return cls(part=cubic_table(part), widest=widest)

    def inverse_mean_square(self, width: Array, row: Array) -> tuple[Array, Array]:
        """Return `1/<t²>` and its derivative by the width, shape (n_psf, n_width)."""
        xp = array_namespace(width=width)
        span, root = self.widest - _NARROWEST, xp.sqrt(width)
        value, slope = self.part.evaluate((root - _NARROWEST) / span, row)
        return value, slope / (2.0 * span * root)
