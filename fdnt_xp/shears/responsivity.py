"""The shear of a population from its mean shape, by the responsivity of shapes to shear.

A small shear g changes the mean shape of isotropic galaxies by `<eta> = 2 g <R1>` with

    R1 = ½ (1 + Y),   Y = |eta|/tanh|eta|,

B10 eq. (33) without the ellipticity gradient: half the response of the length of eta, which
is 1, and half that of its direction, Y (docs, "Responsivity").
"""

from __future__ import annotations

from fdnt_xp.arrays import Array, array_namespace
from fdnt_xp.errors import FdntValueError, ShapeMismatchError


def responsivity(eta: Array) -> Array:
    """Return `R1 = ½ (1 + |eta|/tanh|eta|)` of each shape, shape (n_gal,), at least 1.

    Parameters
    ----------
    eta : array, shape (n_gal, 2)
        Conformal shears.
    """
    xp = array_namespace(eta=eta)
    norm = xp.sqrt(eta[:, 0] ** 2 + eta[:, 1] ** 2)
    round_ = norm == 0
    safe = xp.where(round_, xp.ones_like(norm), norm)
    return 0.5 * (1.0 + xp.where(round_, xp.ones_like(norm), safe / xp.tanh(safe)))


def mean_shear(eta: Array) -> tuple[Array, Array]:
    """Return the reduced shear of a population, and its error from the scatter of shapes.

    Parameters
    ----------
    eta : array, shape (n_gal, 2), n_gal >= 2
        Finite conformal shears of the galaxies that were measured.

    Returns
    -------
    g, g_err : array, shape (2,)
        `g = sum eta / (2 sum R1)`, and the standard error of its influence function
        `(eta - 2 g R1)/(2 <R1>)`.

    Raises
    ------
    ShapeMismatchError
        If `eta` has another shape.
    FdntValueError
        If a shape is not finite, or there are fewer than two.
    """
    xp = array_namespace(eta=eta)
    if eta.ndim != 2 or eta.shape[1] != 2:
        raise ShapeMismatchError(f"eta must have the shape (n_gal, 2), not {tuple(eta.shape)}")
    n_gal = int(eta.shape[0])
    if n_gal < 2:
        raise FdntValueError(f"eta holds {n_gal} galaxies; a mean with an error needs two")
    if not bool(xp.all(xp.isfinite(eta))):
        raise FdntValueError("eta must be finite; leave out the galaxies without a shape")
    r1 = responsivity(eta)[:, None]
    mean_r1 = xp.mean(r1)
    g = xp.mean(eta, axis=0) / (2.0 * mean_r1)
    influence = (eta - 2.0 * g[None, :] * r1) / (2.0 * mean_r1)
    return g, xp.sqrt(xp.sum(influence**2, axis=0) / (n_gal * (n_gal - 1.0)))
