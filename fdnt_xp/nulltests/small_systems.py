"""Linear algebra of many small systems at once, written out: no batch waits for its worst row."""

from __future__ import annotations

from functools import reduce
from operator import add
from types import ModuleType
from typing import Final

from fdnt_xp.arrays import Array, device_of

_SINGULAR: Final = 10.0  # eps: smallest pivot, in a row scaled to 1, of a matrix worth solving


def newton_step(xp: ModuleType, f: Array, jac: Array) -> tuple[Array, Array]:
    """Solve `J p = -f`; return p, and where J is regular; elsewhere p = 0.

    Gauss-Jordan elimination, rows scaled by their largest element, pivots from unused rows.
    Not `linalg.solve`: there one singular matrix raises for the batch (numpy, torch) or the
    host waits (CUDA), the kernel depends on the size of the batch, and a determinant to
    screen by would be a second factorisation.
    """
    tiny = _SINGULAR * float(xp.finfo(f.dtype).eps)
    n, d = f.shape
    place = xp.arange(d, dtype=xp.int64, device=device_of(f))[:, None]
    scale = scale_of(xp, largest(xp, jac), largest(xp, f)[:, None])
    work = xp.concat([jac, -f[..., None]], axis=-1) / scale[..., None]
    # The batch last, in memory too: a library then runs along it, and not along four numbers.
    numbers = xp.unstack(xp.reshape(work, (n, d * (d + 1))), axis=1)
    work = xp.reshape(xp.stack(numbers, axis=0), (d, d + 1, n))
    unused, columns = xp.ones_like(work[:, 0, :], dtype=xp.bool), []
    regular = xp.all(unused, axis=0)
    for k in range(d):
        column = work[:, k, :]
        candidates = xp.where(unused, xp.abs(column), -xp.ones_like(column))
        here = place == xp.argmax(candidates, axis=0, keepdims=True)
        # A sum of which one term is not 0 is a selection, and exact.
        row = xp.sum(xp.where(here[:, None, :], work, xp.zeros_like(work)), axis=0)
        fair = xp.max(candidates, axis=0) > tiny
        row = row / xp.where(fair, row[k, :], xp.ones_like(row[k, :]))
        rest = work - column[:, None, :] * row
        work = xp.where(here[:, None, :], row, rest)
        unused, regular = unused & ~here, regular & fair
        columns.append(here)
    answer = work[:, -1, :]
    zero = xp.zeros_like(answer)
    step = xp.stack([xp.sum(xp.where(h, answer, zero), axis=0) for h in columns], axis=-1)
    regular = regular & xp.all(xp.isfinite(step), axis=-1)
    return xp.where(regular[:, None], step, xp.zeros_like(step)), regular


def nonzero(xp: ModuleType, denominator: Array) -> Array:
    """Return what may be divided by: 1 where the denominator is 0."""
    return xp.where(denominator == 0.0, xp.ones_like(denominator), denominator)


def scale_of(xp: ModuleType, size: Array, size_f: Array) -> Array:
    """Return the size of J, infinite (J is 0) where `|f|/|J|` is absurd and might overflow."""
    sane = size > float(xp.finfo(size.dtype).eps) ** 4 * size_f
    return xp.where(sane, size, xp.full_like(size, float("inf")))


def largest(xp: ModuleType, array: Array) -> Array:
    """Return the largest magnitude along the last axis."""
    return xp.max(xp.abs(array), axis=-1)


def norm(xp: ModuleType, vector: Array) -> Array:
    """Return the length of vectors along the last axis, without over- or underflow."""
    size = largest(xp, vector)
    scaled = vector / nonzero(xp, size)[:, None]
    return size * xp.sqrt(add_up(xp, scaled * scaled))


def add_up(xp: ModuleType, terms: Array, axis: int = -1) -> Array:
    """Add from left to right: `sum` and `matmul` let layout and batch choose the order."""
    return reduce(add, xp.unstack(terms, axis=axis))
