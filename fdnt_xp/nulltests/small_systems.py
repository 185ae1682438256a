"""Linear algebra of many small systems at once, written out: no batch waits for its worst row."""

from __future__ import annotations

from functools import reduce
from operator import add
from types import ModuleType
from typing import Final

from fdnt_xp.arrays import Array, device_of

_SINGULAR: Final = 10.0  # eps: smallest pivot, in a row scaled to 1, of a matrix worth solving


def newton_step(xp: ModuleType, f: Array, jac: Array) -> tuple[Array, Array]:
    """Solve `J p = -f`; return p, and where J is regular; elsewhere p = 0."""
    step, regular = _solve(xp, jac, -f[..., None])
    return step[:, :, 0], regular


def inverse(xp: ModuleType, matrix: Array) -> tuple[Array, Array]:
    """Return the inverse of each matrix, and where there is one; elsewhere 0."""
    d = int(matrix.shape[-1])
    unit = xp.eye(d, dtype=matrix.dtype, device=device_of(matrix))
    return _solve(xp, matrix, xp.broadcast_to(unit, matrix.shape))


def _solve(xp: ModuleType, matrix: Array, right: Array) -> tuple[Array, Array]:
    """Solve `A X = B` for A of shape (n, d, d) and B (n, d, m); X = 0 where A is singular.

    Gauss-Jordan elimination, rows scaled by their largest element, pivots from unused rows.
    Not `linalg.solve`: there one singular matrix raises for the batch (numpy, torch) or the
    host waits (CUDA), the kernel depends on the size of the batch, and a determinant to
    screen by would be a second factorisation.
    """
    tiny = _SINGULAR * float(xp.finfo(matrix.dtype).eps)
    n, d, m = (int(length) for length in right.shape)
    scale = scale_of(xp, largest(xp, matrix), largest(xp, right))
    work = xp.concat([matrix, right], axis=-1) / scale[..., None]
    # The batch last, in memory too: a library then runs along it, and not along four numbers.
    numbers = xp.unstack(xp.reshape(work, (n, d * (d + m))), axis=1)
    work = xp.reshape(xp.stack(numbers, axis=0), (d, d + m, n))
    place = xp.arange(d, dtype=xp.int64, device=device_of(matrix))[:, None]
    unused, pivots = xp.ones_like(work[:, 0, :], dtype=xp.bool), []
    regular = xp.all(unused, axis=0)
    for _ in range(d):
        column, work = work[:, 0, :], work[:, 1:, :]
        candidates = xp.where(unused, xp.abs(column), -xp.ones_like(column))
        here = place == xp.argmax(candidates, axis=0, keepdims=True)
        # A sum of which one term is not 0 is a selection, and exact.
        one = xp.astype(here, work.dtype)
        pivot = xp.sum(one * column, axis=0)
        fair = xp.abs(pivot) > tiny
        row = xp.sum(one[:, None, :] * work, axis=0) / xp.where(fair, pivot, xp.ones_like(pivot))
        # Less 1 in the row of the pivot, which so becomes `row` itself.
        work = work - (column - one)[:, None, :] * row
        unused, regular = unused & ~here, regular & fair
        pivots.append(one)
    solution = xp.stack([xp.sum(one[:, None, :] * work, axis=0) for one in pivots], axis=0)
    regular = regular & xp.all(xp.isfinite(xp.reshape(solution, (d * m, n))), axis=0)
    solution = xp.where(regular, solution, xp.zeros_like(solution))
    return xp.permute_dims(solution, (2, 0, 1)), regular


def nonzero(xp: ModuleType, denominator: Array) -> Array:
    """Return what may be divided by: 1 where the denominator is 0."""
    return xp.where(denominator == 0.0, xp.ones_like(denominator), denominator)


def scale_of(xp: ModuleType, size: Array, size_f: Array) -> Array:
    """Return the size of J, infinite (J is 0) where `|f|/|J|` is absurd and might overflow."""
    sane = size > float(xp.finfo(size.dtype).eps) ** 4 * size_f
    return xp.where(sane, size, xp.full_like(size, float("inf")))


def largest(xp: ModuleType, array: Array) -> Array:
    """Return the largest magnitude along the last axis: a short one, which `max` is slow on."""
    return reduce(xp.maximum, xp.unstack(xp.abs(array), axis=-1))


def norm(xp: ModuleType, vector: Array) -> Array:
    """Return the length of vectors along the last axis, without over- or underflow."""
    size = largest(xp, vector)
    scaled = vector / nonzero(xp, size)[:, None]
    return size * xp.sqrt(add_up(xp, scaled * scaled))


def add_up(xp: ModuleType, terms: Array, axis: int = -1) -> Array:
    """Add from left to right: `sum` and `matmul` let layout and batch choose the order."""
    return reduce(add, xp.unstack(terms, axis=axis))


def all_of(xp: ModuleType, conditions: Array) -> Array:
    """Return whether all hold along the last axis."""
    return reduce(xp.logical_and, xp.unstack(conditions, axis=-1))
