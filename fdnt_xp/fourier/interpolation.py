"""Piecewise-cubic tables on uniform nodes: smooth functions that are cheap on any backend."""

from __future__ import annotations

from dataclasses import dataclass

from fdnt_xp.arrays import Array, Rows, array_namespace, device_of, rows_of


@dataclass(frozen=True, kw_only=True)
class CubicTable:
    """`n_table` functions of `t` in [0, 1], each a cubic Hermite spline with one derivative.

    Parameters
    ----------
    coefficients : tuple of 4 arrays, shape (n_table * (n_cell + 1),)
        Polynomial coefficients of each cell in its own coordinate in [0, 1], constant first.
        The last cell of each table is flat: the function for t >= 1.
    n_cell : int
        Cells between 0 and 1.
    """

    coefficients: tuple[Array, Array, Array, Array]
    n_cell: int

    def take(self, rows: Rows) -> CubicTable:
        """Return the tables with the given row numbers, in that order."""
        xp = array_namespace(coefficients=self.coefficients[0])
        tables = (xp.reshape(c, (-1, self.n_cell + 1)) for c in self.coefficients)
        c0, c1, c2, c3 = (xp.reshape(rows_of(c, rows), (-1,)) for c in tables)
        return CubicTable(coefficients=(c0, c1, c2, c3), n_cell=self.n_cell)

    def evaluate(self, t: Array, row: Array | None = None) -> tuple[Array, Array]:
        """Return the function and its derivative d/dt at `t` >= 0, both of the shape of `t`.

        Parameters
        ----------
        t : array, shape (n,) or (n, m)
            Not NaN; negative by no more than rounding. Values above 1 give the value at 1
            and a zero derivative.
        row : array of integers, shape (n,), optional
            The table of each row of `t`; the only table if absent.
        """
        xp = array_namespace(t=t)
        end = xp.full((1,) * t.ndim, float(self.n_cell), dtype=t.dtype, device=device_of(t))
        z = xp.minimum(t * self.n_cell, end)
        # Not int64, to which some processors convert four times as slowly.
        cell = xp.astype(z, xp.int32)
        z -= xp.astype(cell, t.dtype)
        if row is not None:
            first = xp.astype(row * (self.n_cell + 1), xp.int32)
            cell += first if t.ndim == 1 else first[:, None]
        cell = xp.reshape(cell, (-1,))
        value, linear, square, cube = (
            xp.reshape(xp.take(c, cell, axis=0), t.shape) for c in self.coefficients
        )
        # Horner's scheme for both at once, in the arrays that are there: new ones cost more
        # than the arithmetic.
        cube *= z
        square += cube
        cube += square
        cube *= z
        square *= z
        linear += square
        cube += linear
        cube *= self.n_cell
        linear *= z
        value += linear
        return value, cube


def cubic_table(values: Array, *, zero_beyond: bool = False) -> CubicTable:
    """Tabulate functions from their values at uniform nodes of [0, 1].

    Slopes are fourth-order central differences (one-sided at the ends): local, so a rough
    spot does not ring through the table.

    Parameters
    ----------
    values : array, shape (n_table, n_node), n_node >= 5
        Values at `t = 0, 1/(n_node - 1), ..., 1`.
    zero_beyond : bool
        Whether the slope at t = 1 is forced to zero (the function ends smoothly there).
    """
    xp = array_namespace(values=values)
    slopes = _node_slopes(values)
    if zero_beyond:
        slopes = xp.concat([slopes[:, :-1], xp.zeros_like(slopes[:, -1:])], axis=1)
    left, right = values[:, :-1], values[:, 1:]
    slope_left, slope_right = slopes[:, :-1], slopes[:, 1:]
    end = values[:, -1:]
    zero = xp.zeros(end.shape, dtype=values.dtype, device=device_of(values))
    columns = (
        (left, end),
        (slope_left, zero),
        (3.0 * (right - left) - 2.0 * slope_left - slope_right, zero),
        (2.0 * (left - right) + slope_left + slope_right, zero),
    )
    c0, c1, c2, c3 = (xp.reshape(xp.concat(pair, axis=1), (-1,)) for pair in columns)
    return CubicTable(coefficients=(c0, c1, c2, c3), n_cell=int(values.shape[1]) - 1)


def _node_slopes(f: Array) -> Array:
    """Return df/d(node number), fourth order inside, third order at the two outer nodes."""
    xp = array_namespace(f=f)
    inner = (f[:, :-4] - 8.0 * f[:, 1:-3] + 8.0 * f[:, 3:-1] - f[:, 4:]) / 12.0
    first = (-11.0 * f[:, 0] + 18.0 * f[:, 1] - 9.0 * f[:, 2] + 2.0 * f[:, 3]) / 6.0
    second = (-2.0 * f[:, 0] - 3.0 * f[:, 1] + 6.0 * f[:, 2] - f[:, 3]) / 6.0
    last = (11.0 * f[:, -1] - 18.0 * f[:, -2] + 9.0 * f[:, -3] - 2.0 * f[:, -4]) / 6.0
    before = (2.0 * f[:, -1] + 3.0 * f[:, -2] - 6.0 * f[:, -3] + f[:, -4]) / 6.0
    ends = (first[:, None], second[:, None], inner, before[:, None], last[:, None])
    return xp.concat(ends, axis=1)
