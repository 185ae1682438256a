"""The half-plane k grid: which Fourier modes are used, and the monomials of k on them.

A real image has `I~(-k) = I~(k)*`, so one half-plane holds everything: modes with kx > 0,
and those with kx = 0 and ky > 0, count twice; k = 0 counts once. Only modes inside the
disc `|k| < kmax` are kept. Every null test and every derivative of one is a sum over the
disc of a weighted image times a monomial of k, so the grid carries those monomials as two
small matrices, with the half-plane weight folded in.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType

import numpy as np

from fdnt_xp.arrays import Array, Device, DType, Rows, array_namespace, count_true
from fdnt_xp.shear import shear_matrix


@dataclass(frozen=True, kw_only=True)
class KGrid:
    """Fourier modes inside a disc, from the middle outwards, for stamps of one shape.

    Parameters
    ----------
    kx, ky : array, shape (n_k,)
        Coordinates at which the tests are evaluated, rad/pixel. For a counter-sheared
        grid these are `S_gamma k`, while `index` still names the modes k of the data.
    fold : array, shape (n_k,)
        Half-plane weight: 2, or 1 at k = 0.
    index : array, shape (n_k,), integer
        Position of the mode in the flattened `rfftn` of a stamp of `shape`.
    shape : tuple of int
        (ny, nx) of the transform; larger than the stamp where the grid is zero-padded.
    shear : array, shape (2,), optional
        The eta-type shear gamma of a counter-shear; absent on the grid of the data.
    """

    kx: Array
    ky: Array
    fold: Array
    index: Array
    shape: tuple[int, int]
    shear: Array | None = None

    @property
    def n_k(self) -> int:
        """Number of modes."""
        return int(self.kx.shape[0])

    @property
    def n_half_plane(self) -> int:
        """Number of modes of the `rfftn`, of which `index` names some."""
        return self.shape[0] * (self.shape[1] // 2 + 1)

    @cached_property
    def row_and_column(self) -> tuple[Array, Array]:
        """Return where each mode is in the two-dimensional `rfftn`, shape (n_k,) each."""
        n_column = self.shape[1] // 2 + 1
        return self.index // n_column, self.index % n_column

    @cached_property
    def quarter_turn(self) -> tuple[Array, Array]:
        """Return how a quarter turn of the image, counter-clockwise, moves its modes.

        `I~'(kx, ky) = I~(ky, -kx)`, which is another mode of the half plane or the conjugate of
        one. Only on square grids is it always one of them.

        Returns
        -------
        source : array of int64, shape (n_k,)
            Number, in this grid, of the mode that each mode comes from.
        sign : array, shape (n_k,)
            -1 where it is conjugated.
        """
        xp = array_namespace(kx=self.kx)
        row, column = self.row_and_column
        side = self.shape[0]
        ky = xp.where(row > side // 2, row - side, row)
        # (ky, -kx), or minus that where it is in the other half plane.
        other = (ky < 0) | ((ky == 0) & (column > 0))
        new_row = xp.where(other, column, (side - column) % side)
        new_column = xp.where(ky < 0, -ky, ky)
        position = new_row * (self.shape[1] // 2 + 1) + new_column
        one = xp.ones_like(self.kx)
        return self.number_of(position), xp.where(other, -one, one)

    def number_of(self, position: Array) -> Array:
        """Return which modes of this grid are at these positions in the flattened `rfftn`.

        n_k, or any number, where none is.
        """
        xp = array_namespace(kx=self.kx)
        order = xp.argsort(self.index)
        place = xp.searchsorted(xp.take(self.index, order), position)
        outside = place == self.n_k
        number = xp.take(order, xp.where(outside, xp.zeros_like(place), place))
        return xp.where(outside, xp.full_like(number, self.n_k), number)

    def inner(self, n_k: int) -> KGrid:
        """Return the grid of the first modes, which are those nearest to k = 0 in the data."""
        return replace(
            self, kx=self.kx[:n_k], ky=self.ky[:n_k], fold=self.fold[:n_k], index=self.index[:n_k]
        )

    def n_inside(self, radius: float) -> int:
        """Return how many modes have `|k| < radius`, on the host."""
        return count_true(self.kx**2 + self.ky**2 < radius**2)

    @property
    def radius(self) -> Array:
        """Length of the coordinates of each mode, rad/pixel, shape (1, n_k)."""
        xp = array_namespace(kx=self.kx)
        return xp.sqrt(self.kx**2 + self.ky**2)[None, :]

    def take(self, rows: Rows) -> KGrid:  # noqa: ARG002  a grid may know its galaxies
        """Return the grid of the given galaxies: the same."""
        return self

    @cached_property
    def squares(self) -> Array:
        """`kx², kx ky, ky²` without the half-plane weight, shape (3, n_k)."""
        xp = array_namespace(kx=self.kx)
        return xp.stack([self.kx**2, self.kx * self.ky, self.ky**2], axis=0)

    def moments(self, field: Array, *degrees: int) -> Array:
        """Return the moments of given degrees of a field, degree after degree.

        Parameters
        ----------
        field : array, shape (n_gal, n_k)
            Even or odd in k, as all the degrees are.

        Returns
        -------
        array, shape (n_gal, number of moments)
            `sum_k field kx^(d-j) ky^j`, j = 0 .. d, over the whole plane, for each degree d.
        """
        xp = array_namespace(field=field)
        if degrees not in self._monomials:
            self._monomials[degrees] = self._monomials_of(degrees)
        # The long axis last in both: some libraries are three times slower the other way.
        return xp.matrix_transpose(xp.matmul(self._monomials[degrees], xp.matrix_transpose(field)))

    def even_moments(self, field: Array) -> tuple[Array, Array, Array]:
        """Return the moments of degree 0, 2 and 4, shapes (n_gal, 1), (n_gal, 3), (n_gal, 5)."""
        moments = self.moments(field, 0, 2, 4)
        return moments[:, :1], moments[:, 1:4], moments[:, 4:]

    def odd_moments(self, field: Array) -> tuple[Array, Array]:
        """Return the moments of degree 1 and 3 of an odd field, shapes (n_gal, 2), (n_gal, 4)."""
        moments = self.moments(field, 1, 3)
        return moments[:, :2], moments[:, 2:]

    @cached_property
    def _monomials(self) -> dict[tuple[int, ...], Array]:
        """Return the matrices made so far, by their degrees."""
        return {}

    def _monomials_of(self, degrees: tuple[int, ...]) -> Array:
        """Return `fold kx^(d-j) ky^j`, j = 0 .. d, for each degree, shape (number, n_k)."""
        xp = array_namespace(kx=self.kx)
        rows = [
            self.fold * self.kx ** (degree - j) * self.ky**j
            for degree in degrees
            for j in range(degree + 1)
        ]
        return xp.stack(rows, axis=0)

    def sheared(self, gamma: Array) -> KGrid:
        """Return the same modes with coordinates `kappa = S_gamma k`: a counter-shear.

        Evaluating any test on the returned grid measures the galaxy with the shear `gamma`
        (eta-type, shape (2,)) taken off, exactly: no image is resampled.
        """
        matrix = shear_matrix(gamma)
        return KGrid(
            kx=matrix[0, 0] * self.kx + matrix[0, 1] * self.ky,
            ky=matrix[1, 0] * self.kx + matrix[1, 1] * self.ky,
            fold=self.fold,
            index=self.index,
            shape=self.shape,
            shear=gamma,
        )

    def on_stamp(self, position: Array) -> Array:
        """Return where a position of this grid's frame lies on the stamp, shape (n_gal, 2).

        `kappa.x' = k.x` with `kappa = S_gamma k` holds for `x = S_gamma x'`.
        """
        return position if self.shear is None else _moved(self._matrices[0], position)

    def from_stamp(self, position: Array) -> Array:
        """Return the position in this grid's frame of one on the stamp, shape (n_gal, 2)."""
        return position if self.shear is None else _moved(self._matrices[1], position)

    @cached_property
    def _matrices(self) -> tuple[Array, Array]:
        """Return `S_gamma` and its inverse."""
        assert self.shear is not None
        return shear_matrix(self.shear), shear_matrix(-self.shear)


def _moved(matrix: Array, position: Array) -> Array:
    """Return `M x` for each row; M is symmetric."""
    return position[:, 0:1] * matrix[0, :] + position[:, 1:2] * matrix[1, :]


def half_plane_disc(
    xp: ModuleType, shape: tuple[int, int], kmax: float, *, dtype: DType, device: Device
) -> KGrid:
    """Return the modes of an (ny, nx) transform with `|k| < kmax` (rad/pixel).

    `kmax` must not exceed pi: the Nyquist modes of even sizes are their own conjugates and
    would need another weight. The selection is made on the host, where its size is known;
    it depends on the geometry alone, never on data.
    """
    ny, nx = shape
    ky, kx = np.meshgrid(
        2.0 * np.pi * np.fft.fftfreq(ny), 2.0 * np.pi * np.fft.rfftfreq(nx), indexing="ij"
    )
    in_half_plane = (kx > 0) | ((kx == 0) & (ky >= 0))
    radius = np.hypot(kx, ky)
    index = np.flatnonzero(in_half_plane & (radius < kmax))
    index = index[np.argsort(radius.ravel()[index], kind="stable")]
    kx, ky = kx.ravel()[index], ky.ravel()[index]
    fold = np.where((kx == 0) & (ky == 0), 1.0, 2.0)
    return KGrid(
        kx=xp.asarray(kx, dtype=dtype, device=device),
        ky=xp.asarray(ky, dtype=dtype, device=device),
        fold=xp.asarray(fold, dtype=dtype, device=device),
        index=xp.asarray(index, dtype=xp.int64, device=device),
        shape=shape,
    )
