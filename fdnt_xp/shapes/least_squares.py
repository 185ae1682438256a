"""Weighted least squares of every galaxy of a batch, that no galaxy can make fail."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from fdnt_xp.arrays import Array, array_namespace, device_of, joined

LARGEST_INFLATION: Final = 20.0
"""Inflation of a variance beyond which a fit is degenerate; a quadrant cut off at the centre makes
1e6."""
LARGEST_WITH_GAPS: Final = 4.0
"""The same where pixels are missing, and with them what no function says of the galaxy. A tenth of
the pixels at random or a column through the centre make 1.3, four columns or a hole of 3 pixels
radius 8 (order 12, galaxy and PSF of 3 pixels)."""
_RIDGE: Final = 10.0
"""In eps times the number of coefficients: more than rounding can take off an eigenvalue."""
_REFINEMENTS: Final = 2


@dataclass(frozen=True, kw_only=True)
class LinearFit:
    """Weighted least squares of each galaxy.

    Coefficients are finite, and without meaning where `inflation` is infinite.

    Parameters
    ----------
    coefficients, covariance : array, shape (n_gal, n_coef) and (n_gal, n_coef, n_coef)
    inflation : array, shape (n_gal,)
        Largest `M_jj (M^-1)_jj` of the normal matrix M: how much the variance of a
        coefficient grows because the pixels left cannot tell it from others. 1 where they
        can; infinite where there are fewer pixels than coefficients.
    n_pixels : array, shape (n_gal,), int32
        Pixels that were fitted.
    """

    coefficients: Array
    covariance: Array
    inflation: Array
    n_pixels: Array

    @classmethod
    def concat(cls, parts: Sequence[LinearFit]) -> LinearFit:
        """Join fits, at least one, in the order given."""
        return joined(parts)


def least_squares(functions: Array, pixels: Array, ivar: Array) -> LinearFit:
    """Fit a sum of functions to the pixels of each galaxy, by Cholesky's normal equations.

    Parameters
    ----------
    functions : array, shape (n_gal, n_coef, n_pix)
        Finite.
    pixels, ivar : array, shape (n_gal, n_pix)
        Finite where ivar > 0; ivar >= 0.

    Notes
    -----
    The matrix is scaled to a unit diagonal and gets a ridge above its rounding, so that the
    factorisation cannot fail, for one would fail the batch; the ridge is taken back by
    iterated refinement of the coefficients. The covariance keeps it: a relative error of
    the ridge, 2e-13 (in float32 1e-4) at 91 coefficients, times the inflation.
    """
    xp = array_namespace(functions=functions, pixels=pixels, ivar=ivar)
    n_coef = int(functions.shape[1])
    brightest = xp.max(ivar, axis=-1)
    unit = xp.where(brightest > 0, brightest, xp.ones_like(brightest))
    weighted = functions * (ivar / unit[:, None])[:, None, :]
    normal = xp.matmul(weighted, xp.matrix_transpose(functions))
    right = _times(weighted, xp.where(ivar > 0, pixels, xp.zeros_like(pixels)))

    n_pixels = xp.sum(xp.astype(ivar > 0, xp.int32), axis=-1, dtype=xp.int32)
    diagonal = xp.linalg.diagonal(normal)
    seen = xp.all(diagonal > float(xp.finfo(normal.dtype).smallest_normal) ** 0.5, axis=-1)
    fair = seen & (n_pixels >= n_coef) & xp.all(xp.isfinite(right), axis=-1)
    norm = 1.0 / xp.sqrt(xp.where(fair[:, None], diagonal, xp.ones_like(diagonal)))
    eye = xp.eye(n_coef, dtype=normal.dtype, device=device_of(normal))[None, :, :]
    both = norm[:, :, None] * norm[:, None, :]
    normal = xp.where(fair[:, None, None], normal * both, eye)
    right = xp.where(fair[:, None], norm * right, xp.zeros_like(right))

    ridge = _RIDGE * n_coef * float(xp.finfo(normal.dtype).eps)
    root = xp.linalg.inv(xp.linalg.cholesky(normal + ridge * eye))
    inverse = xp.matmul(xp.matrix_transpose(root), root)
    solution = _times(inverse, right)
    for _ in range(_REFINEMENTS):
        solution = solution + _times(inverse, right - _times(normal, solution))
    inflation = xp.max(xp.linalg.diagonal(inverse), axis=-1)
    return LinearFit(
        coefficients=norm * solution,
        covariance=inverse * both / unit[:, None, None],
        inflation=xp.where(fair, inflation, xp.full_like(inflation, float("inf"))),
        n_pixels=n_pixels,
    )


def _times(matrix: Array, vector: Array) -> Array:
    """Return `M v` of each galaxy."""
    xp = array_namespace(matrix=matrix)
    return xp.matmul(matrix, vector[:, :, None])[:, :, 0]
