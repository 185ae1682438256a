"""The algebra of shears: what eta, e and g are, and how shears add.

Conventions (docs, "Conventions"; SPEC of the method, section 1). A shape is the conformal
shear `eta = |eta| (cos 2b, sin 2b)`, b the position angle of the major axis counted
counter-clockwise from +x, with axis ratio `a/b = exp(|eta|)`. Distortion and reduced shear
are the same direction with another length: `e = tanh |eta|`, `g = tanh(|eta|/2)`.

The matrix of a shear is symmetric with unit determinant::

    S_eta = cosh(|eta|/2) I + sinh(|eta|/2)/|eta| [[eta1, eta2], [eta2, -eta1]],

and lensing by it gives `I_lensed(x) = I(S^-1 x)`, hence `I_lensed~(k) = I~(S k)`.
"""

from __future__ import annotations

import math
from types import ModuleType

from fdnt_xp.arrays import Array, array_namespace

_SMALL_ETA_SQUARED = 1e-4
"""Below this `|eta|²`, three terms of the series are exact to 2e-16 and divisions are not safe."""


def distortion_from_eta(eta: Array) -> Array:
    """Return `e = tanh|eta|` along the direction of `eta`, shape (..., 2)."""
    return _rescale(eta, "tanh", 1.0)


def reduced_shear_from_eta(eta: Array) -> Array:
    """Return `g = tanh(|eta|/2)` along the direction of `eta`, shape (..., 2)."""
    return _rescale(eta, "tanh", 0.5)


def eta_from_distortion(e: Array) -> Array:
    """Return `|eta| = atanh|e|` along the direction of `e`, shape (..., 2)."""
    return _rescale(e, "atanh", 1.0)


def eta_from_reduced_shear(g: Array) -> Array:
    """Return `|eta| = 2 atanh|g|` along the direction of `g`, shape (..., 2)."""
    return 2.0 * _rescale(g, "atanh", 1.0)


def shear_matrix(eta: Array) -> Array:
    """Return `S_eta`, shape (..., 2, 2), for `eta` of shape (..., 2)."""
    xp = array_namespace(eta=eta)
    half = 0.5 * eta
    cosh, sinhc, _ = hyperbolic_series(xp, half[..., 0] ** 2 + half[..., 1] ** 2)
    plus, cross = sinhc * half[..., 0], sinhc * half[..., 1]
    rows = [xp.stack([cosh + plus, cross], axis=-1), xp.stack([cross, cosh - plus], axis=-1)]
    return xp.stack(rows, axis=-2)


def eta_from_matrix(matrix: Array) -> Array:
    """Return the shear `eta` in `matrix = S_eta R`, R any rotation; shape (..., 2).

    With `P = M Mᵀ = S_eta² = cosh|eta| I + sinh|eta|/|eta| [[eta1, eta2], [eta2, -eta1]]`
    the direction is that of the traceless part, and the length follows from it.
    """
    xp = array_namespace(matrix=matrix)
    a, b = matrix[..., 0, 0], matrix[..., 0, 1]
    c, d = matrix[..., 1, 0], matrix[..., 1, 1]
    plus = 0.5 * (a * a + b * b - c * c - d * d)
    cross = a * c + b * d
    return _rescale(xp.stack([plus, cross], axis=-1), "asinh", 1.0)


def add_shears(eta_a: Array, eta_b: Array) -> Array:
    """Return the shear of `S_a S_b` with its rotation removed: first b acts, then a.

    Both of shape (..., 2). A galaxy of shape `eta_b` lensed by `eta_a` gets this shape.
    """
    xp = array_namespace(eta_a=eta_a, eta_b=eta_b)
    return eta_from_matrix(xp.matmul(shear_matrix(eta_a), shear_matrix(eta_b)))


def hyperbolic_series(xp: ModuleType, x_squared: Array) -> tuple[Array, Array, Array]:
    """Return `cosh x`, `sinh x / x` and `(cosh x - 1)/x²` as functions of `x²`, smooth at 0."""
    small = x_squared < _SMALL_ETA_SQUARED
    safe = xp.where(small, xp.ones_like(x_squared), x_squared)
    x = xp.sqrt(safe)
    sinh_half = xp.sinh(0.5 * x)
    sinhc = xp.where(small, 1.0 + x_squared / 6.0 * (1.0 + x_squared / 20.0), xp.sinh(x) / x)
    coshc = xp.where(
        small, 0.5 + x_squared / 24.0 * (1.0 + x_squared / 30.0), 2.0 * sinh_half**2 / safe
    )
    return 1.0 + x_squared * coshc, sinhc, coshc


def hyperbolic_slopes(xp: ModuleType, x_squared: Array) -> tuple[Array, Array]:
    """Return `(d/dx)/x` of `sinh x / x` and of `(cosh x - 1)/x²`, as functions of `x²`.

    They are `(cosh x - sinh x / x)/x²` and `(sinh x / x - 2 (cosh x - 1)/x²)/x²`: differences
    of nearly equal numbers, so the series is used up to `x² = 1`.
    """
    small = x_squared < 1.0
    safe = xp.where(small, xp.ones_like(x_squared), x_squared)
    cosh, sinhc, coshc = hyperbolic_series(xp, safe)
    sinhc_slope = xp.zeros_like(x_squared)
    coshc_slope = xp.zeros_like(x_squared)
    # sum over n >= 1 of 2n x^(2n-2) / (2n + 1)! and of 2n x^(2n-2) / (2n + 2)!.
    for n in range(9, 0, -1):
        sinhc_slope = sinhc_slope * x_squared + 2 * n / math.factorial(2 * n + 1)
        coshc_slope = coshc_slope * x_squared + 2 * n / math.factorial(2 * n + 2)
    return (
        xp.where(small, sinhc_slope, (cosh - sinhc) / safe),
        xp.where(small, coshc_slope, (sinhc - 2.0 * coshc) / safe),
    )


def _rescale(vector: Array, function: str, inner: float) -> Array:
    """Return `f(inner |v|) v/|v|`, with the limit `inner v` (f'(0) = 1) at v = 0."""
    xp = array_namespace(vector=vector)
    norm = xp.sqrt(vector[..., 0] ** 2 + vector[..., 1] ** 2)
    zero = norm == 0
    # 0.5: any number inside the domain of atanh, so that the unused branch does not warn.
    safe = xp.where(zero, 0.5 * xp.ones_like(norm), norm)
    # ones_like * inner, not where(zero, inner, ...): two scalars are not a standard `where`.
    factor = xp.where(zero, inner * xp.ones_like(norm), getattr(xp, function)(inner * safe) / safe)
    return vector * factor[..., None]
