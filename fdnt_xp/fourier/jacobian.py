"""Sky coordinates as the k grid sees them: the Jacobian of each galaxy's pixels.

A step x on the stamp is the step `u = J x` on the sky, J any regular matrix: pixels may be
turned, mirrored, sheared, and of any size. As `k.x` is the same in both frames, `k = Jᵀ k_sky`.
The size of a pixel on the sky, `p = sqrt|det J|`, is kept apart from the rest, `J = p B`: all
that is done in k works in units of pixels, with the unit Jacobian B (docs, "Sky coordinates").
"""

from __future__ import annotations

from typing import Final

from fdnt_xp.arrays import Array, array_namespace

MOST_STRETCHED: Final = 100.0
"""Longest over shortest stretch of a pixel on the sky beyond which J counts as singular."""


def pixel_scale(jacobian: Array) -> Array:
    """Return `p = sqrt|det J|`, the side of a pixel on the sky; shape (n,)."""
    xp = array_namespace(jacobian=jacobian)
    # Scaled first: the determinant of degrees a pixel may have no room in float32.
    largest = xp.max(xp.max(xp.abs(jacobian), axis=-1), axis=-1)
    return largest * xp.sqrt(xp.abs(_determinant(jacobian / largest[:, None, None])))


def unit_jacobian(jacobian: Array) -> Array:
    """Return `B = J/p`, of determinant 1 or -1; shape (n, 2, 2)."""
    return jacobian / pixel_scale(jacobian)[:, None, None]


def wave_frame(unit: Array) -> Array:
    """Return `A = B⁻ᵀ`, which takes k of the image to that of the sky; shape (n, 2, 2).

    B may have any determinant but 0.
    """
    xp = array_namespace(unit=unit)
    a, b, c, d = (unit[:, i, j] for i in (0, 1) for j in (0, 1))
    rows = [xp.stack([d, -c], axis=-1), xp.stack([-b, a], axis=-1)]
    return xp.stack(rows, axis=-2) / _determinant(unit)[:, None, None]


def longest_stretch(unit: Array) -> Array:
    """Return the largest singular value of B, shape (n,)."""
    xp = array_namespace(unit=unit)
    square = _square(unit)
    excess = xp.maximum(square**2 - 4.0 * _determinant(unit) ** 2, xp.zeros_like(square))
    return xp.sqrt(0.5 * (square + xp.sqrt(excess)))


def is_regular(jacobian: Array) -> Array:
    """Return where J is finite, and far enough from singular to measure through; shape (n,)."""
    xp = array_namespace(jacobian=jacobian)
    finite = xp.all(xp.all(xp.isfinite(jacobian), axis=-1), axis=-1)
    safe = xp.where(finite[:, None, None], jacobian, xp.ones_like(jacobian))
    largest = xp.max(xp.max(xp.abs(safe), axis=-1), axis=-1)
    there = largest > 0
    safe = safe / xp.where(there, largest, xp.ones_like(largest))[:, None, None]
    # |J|²/|det J| is r + 1/r, with r the ratio of the singular values.
    limit = MOST_STRETCHED + 1.0 / MOST_STRETCHED
    return finite & there & (_square(safe) <= limit * xp.abs(_determinant(safe)))


def _square(matrix: Array) -> Array:
    """Return the sum of the squares of the entries, shape (n,)."""
    xp = array_namespace(matrix=matrix)
    return xp.sum(xp.sum(matrix**2, axis=-1), axis=-1)


def _determinant(matrix: Array) -> Array:
    return matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] * matrix[:, 1, 0]
