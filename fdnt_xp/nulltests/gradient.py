"""The ellipticity gradient: how a galaxy's shape changes with the scale at which it is seen.

The weight shrinks by `s = exp(|eta|/2)` as a galaxy gets more elongated. A galaxy whose
core and outskirts differ in shape therefore responds to shear by `1/(1 - EG)` times too
much along its own axis (B10 §5.1), with

    EG = deta_par/dln s · dln s/d|eta| = ½ deta_par/dln s.
"""

from __future__ import annotations

from fdnt_xp.arrays import Array, array_namespace, device_of
from fdnt_xp.nulltests.small_systems import newton_step
from fdnt_xp.nulltests.values import MatchedWidth, TestValues


def ellipticity_gradient(
    eta: Array, tests: TestValues, matched: MatchedWidth, length: float
) -> Array:
    """Return EG of each galaxy, shape (n_gal,); 0 for a round one, which has no axis.

    The implicit derivative of the solution: at fixed s the tests vanish at `p(s)`, so
    `dp/dln s = -J⁻¹ dt/dln s`, both with the size equation solved anew at every s.

    Parameters
    ----------
    eta : array, shape (n_gal, 2)
        The solution.
    tests, matched : TestValues, MatchedWidth
        Both at the solution.
    length : float
        Pixels: the unit of centroids, for the conditioning of J.
    """
    xp = array_namespace(eta=eta)
    by_width = tests.by_width[:, :4]
    jac = tests.by_parameter[:, :4, :] + by_width[:, :, None] * matched.by_parameter[:, None, :]
    slope = tests.by_ln_shrink[:, :4] + by_width * matched.by_ln_shrink[:, None]
    units = xp.asarray([1.0, 1.0, length, length], dtype=eta.dtype, device=device_of(eta))
    by_ln_shrink, regular = newton_step(xp, slope, jac * units)
    norm = xp.sqrt(eta[:, 0] ** 2 + eta[:, 1] ** 2)
    along = by_ln_shrink[:, 0] * eta[:, 0] + by_ln_shrink[:, 1] * eta[:, 1]
    along = along / xp.where(norm > 0, norm, xp.ones_like(norm))
    return xp.where(regular, 0.5 * along, xp.full_like(along, float("nan")))
