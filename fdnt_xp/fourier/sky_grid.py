"""The k grid seen in another frame by each galaxy: pixels that are not alike on the sky.

In the frame of a trial shear on the sky the modes of the data are at `kappa = M k`, with
`M = S_gamma A` and A the frame of the galaxy's pixels (`fdnt_xp.fourier.jacobian`). A sum over
modes of a field times a monomial of kappa is a combination of the sums with the monomials of
k of the same degree: the grid, and what is tabulated on it, stays that of all galaxies.
"""

from __future__ import annotations

from dataclasses import dataclass

from fdnt_xp.arrays import Array, Rows, array_namespace, rows_of
from fdnt_xp.fourier.grid import KGrid


@dataclass(frozen=True, kw_only=True)
class SkyGrid(KGrid):
    """The modes of `plain`, at the coordinates `kappa = M k`; made by `SkyGrid.of`.

    `kx`, `ky` and `squares` are those of `plain`: the weight knows M itself
    (`Weight.frame`). Moments and positions are those of the frame.

    Parameters
    ----------
    plain : KGrid
        Of the data.
    matrix : array, shape (n_gal or 1, 2, 2)
        M.
    """

    plain: KGrid
    matrix: Array

    @classmethod
    def of(cls, plain: KGrid, matrix: Array) -> SkyGrid:
        """Make it of the grid of the data and M."""
        return cls(
            kx=plain.kx,
            ky=plain.ky,
            fold=plain.fold,
            index=plain.index,
            shape=plain.shape,
            plain=plain,
            matrix=matrix,
        )

    def take(self, rows: Rows) -> SkyGrid:
        """Return the grid of the given galaxies."""
        if int(self.matrix.shape[0]) == 1:
            return self
        return SkyGrid.of(self.plain, rows_of(self.matrix, rows))

    def inner(self, n_k: int) -> SkyGrid:
        """Return the grid of the first modes, those nearest to k = 0 in the data."""
        return SkyGrid.of(self.plain.inner(n_k), self.matrix)

    @property
    def radius(self) -> Array:
        """`|M k|`, shape (n_gal or 1, n_k)."""
        xp = array_namespace(matrix=self.matrix)
        m = self.matrix
        kx, ky = (m[:, i, 0:1] * self.kx + m[:, i, 1:2] * self.ky for i in (0, 1))
        return xp.sqrt(kx**2 + ky**2)

    def moments(self, field: Array, *degrees: int) -> Array:
        """Return the moments of given degrees by kappa; see `KGrid.moments`."""
        xp = array_namespace(field=field)
        by_k = self.plain.moments(field, *degrees)
        parts, first = [], 0
        for degree in degrees:
            some = by_k[:, first : first + degree + 1]
            products = _products(self.matrix, degree)
            parts.append(xp.sum(products * some[:, None, :], axis=-1))
            first += degree + 1
        return xp.concat(parts, axis=-1)

    def on_stamp(self, position: Array) -> Array:
        """Return where a position of this frame lies on the stamp: `x = Mᵀ x'`."""
        xp = array_namespace(position=position)
        m, x, y = self.matrix, position[:, 0], position[:, 1]
        return xp.stack([m[:, 0, j] * x + m[:, 1, j] * y for j in (0, 1)], axis=-1)

    def from_stamp(self, position: Array) -> Array:
        """Return the position in this frame of one on the stamp: `x' = M⁻ᵀ x`."""
        xp = array_namespace(position=position)
        a, b, c, d = (self.matrix[:, i, j] for i in (0, 1) for j in (0, 1))
        x, y = position[:, 0], position[:, 1]
        return xp.stack([d * x - c * y, a * y - b * x], axis=-1) / (a * d - b * c)[:, None]


def _products(matrix: Array, degree: int) -> Array:
    """Return the coefficients of `kappa_x^(d-j) kappa_y^j` by `kx^(d-m) ky^m`.

    Returns
    -------
    array, shape (n, d + 1, d + 1)
        By j and m.
    """
    xp = array_namespace(matrix=matrix)
    rows = []
    for j in range(degree + 1):
        product = [xp.ones_like(matrix[:, 0, 0])]
        for factor in range(degree):
            line = matrix[:, 1, :] if factor < j else matrix[:, 0, :]
            zero = xp.zeros_like(product[0])
            by_x = [line[:, 0] * one for one in product] + [zero]
            by_y = [zero] + [line[:, 1] * one for one in product]
            product = [one + other for one, other in zip(by_x, by_y, strict=True)]
        rows.append(xp.stack(product, axis=-1))
    return xp.stack(rows, axis=-2)
