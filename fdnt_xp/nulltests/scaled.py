"""Null tests over their scale: what the root finder sees.

A test is linear in the image, and so is the scale by which it is divided; the quotient knows
neither flux nor units. It may be of one galaxy, or of the sums over its exposures.
"""

from __future__ import annotations

from fdnt_xp.arrays import Array, array_namespace
from fdnt_xp.nulltests.values import MatchedWidth, TestValues


def scaled_tests(
    eta: Array, tests: TestValues, matched: MatchedWidth, length: float
) -> tuple[Array, Array]:
    """Return `(t1, t2, tx/L, ty/L)/t0` and its Jacobian by `(eta1, eta2, x0/L, y0/L)`.

    Parameters
    ----------
    eta : array, shape (n_gal, 2)
    tests, matched : TestValues, MatchedWidth
        There.
    length : float
        L, pixels.
    """
    xp = array_namespace(eta=eta)
    # ln s = |eta|/2. At eta = 0 its slope has no direction; the mean of all is 0.
    norm = xp.sqrt(eta[:, 0] ** 2 + eta[:, 1] ** 2)
    safe = xp.where(norm > 0, norm, xp.ones_like(norm))
    ln_shrink_slope = 0.5 * eta / safe[:, None]
    ln_shrink_slope = xp.concat([ln_shrink_slope, xp.zeros_like(eta)], axis=-1)
    width_slope = matched.by_parameter + matched.by_ln_shrink[:, None] * ln_shrink_slope
    slopes = (
        tests.by_parameter
        + tests.by_ln_shrink[:, :, None] * ln_shrink_slope[:, None, :]
        + tests.by_width[:, :, None] * width_slope[:, None, :]
    )
    f, jac = over_scale(tests.values, slopes)
    inv = 1.0 / length
    f = xp.concat([f[:, :2], inv * f[:, 2:]], axis=-1)
    jac = xp.concat([jac[:, :2, :], inv * jac[:, 2:, :]], axis=1)
    return f, xp.concat([jac[:, :, :2], length * jac[:, :, 2:]], axis=2)


def over_scale(values: Array, slopes: Array) -> tuple[Array, Array]:
    """Return tests over the last of them, their scale, and the slopes of the quotients.

    NaN where the scale is not positive: there is no galaxy to null.

    Parameters
    ----------
    values : array, shape (n_gal, m + 1)
    slopes : array, shape (n_gal, m + 1, n_parameter)
    """
    inverse = inverse_if_positive(values[:, -1:])
    f = values[:, :-1] * inverse
    return f, (slopes[:, :-1, :] - f[:, :, None] * slopes[:, -1:, :]) * inverse[:, :, None]


def inverse_if_positive(scale: Array) -> Array:
    """Return 1/x where x > 0, elsewhere NaN: tests over such a scale have no value."""
    xp = array_namespace(scale=scale)
    safe = xp.where(scale > 0, scale, xp.ones_like(scale))
    return xp.where(scale > 0, 1.0 / safe, xp.full_like(scale, float("nan")))
