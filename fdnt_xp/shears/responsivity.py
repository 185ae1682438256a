"""How the mean shape of galaxies responds to shear, to first and to third order.

Isotropic galaxies of one `|eta|` get from a reduced shear g along x the mean::

    <w eta1> = 2 g R1 + 2 g³ R3,
    R1 = ½ [(eta w' + w)/(1 - EG) + Y w],      Y = eta/tanh eta,
    R3 = ¼ {w [2 - Y + Y² (Y - 1)/eta²] + 2 eta w' [1 - 2Y (Y - 1)/eta² + 3Y²/2eta²]
            + w'' (2Y + 3) + eta w'''},

B10 eqs. (A3) to (A5) and (A10), with the ½ that they lack (docs, "Responsivity"). R3 is
that of ellipses: the effect of EG on it is not known. B10's gamma is g, to this order
(docs, "Which shear").
"""

from __future__ import annotations

from fdnt_xp.arrays import Array, array_namespace, as_floating, require_dtype
from fdnt_xp.errors import ShapeMismatchError
from fdnt_xp.shear import hyperbolic_series, hyperbolic_slopes
from fdnt_xp.shears.weights import Function, ShapeWeight, WeightExpansion, as_shape_weight


def R1(
    abs_eta: Array, weight: ShapeWeight | Function | str = "uniform", eg: Array | None = None
) -> Array:
    """Return the responsivity of first order of each shape, shape (n_gal,).

    Parameters
    ----------
    abs_eta : array, shape (n_gal,), real floating
        `|eta|`, finite and not negative.
    weight : ShapeWeight, callable or str
        `w(|eta|)`; a name or function as for `as_shape_weight`.
    eg : array, shape (n_gal,), optional
        Ellipticity gradients EG. Where one is not finite, or not below 1, where a shape
        would run away from the shear, the result is NaN.

    Raises
    ------
    ShapeMismatchError
        If an array has another shape.

    References
    ----------
    .. [1] Bernstein 2010, MNRAS 406, 2793, eq. (A10).

    Examples
    --------
    >>> import numpy as np
    >>> from fdnt_xp.shears.responsivity import R1
    >>> R1(np.array([0.0, 0.5]), eg=np.array([0.0, 0.02])).round(6)
    array([1.      , 1.051192])
    """
    abs_eta = _checked(abs_eta, eg)
    return first_order(abs_eta, as_shape_weight(weight).expand(abs_eta), eg)


def R3(abs_eta: Array, weight: ShapeWeight | Function | str = "uniform") -> Array:
    """Return the responsivity of third order of each shape, shape (n_gal,).

    Parameters
    ----------
    abs_eta : array, shape (n_gal,), real floating
        `|eta|`, finite and not negative.
    weight : ShapeWeight, callable or str
        `w(|eta|)`; a name or function as for `as_shape_weight`.

    Raises
    ------
    ShapeMismatchError
        If `abs_eta` has not one axis.

    References
    ----------
    .. [1] Bernstein 2010, MNRAS 406, 2793, eq. (A5).

    Examples
    --------
    >>> import numpy as np
    >>> from fdnt_xp.shears.responsivity import R3
    >>> R3(np.array([0.0])).round(6)  # eta = 2 atanh g = 2 g + 2 g³/3 + ...
    array([0.333333])
    """
    abs_eta = _checked(abs_eta, None)
    return third_order(abs_eta, as_shape_weight(weight).expand(abs_eta))


def has_response(eg: Array) -> Array:
    """Return where an ellipticity gradient leaves a shape a response to shear, (n_gal,) bool."""
    xp = array_namespace(eg=eg)
    return xp.isfinite(eg) & (eg < 1)


def first_order(abs_eta: Array, w: WeightExpansion, eg: Array | None) -> Array:
    """Return R1 from a weight that is expanded already; see `R1`."""
    along, across = along_and_across(abs_eta, w, eg)
    return 0.5 * (along + across)


def along_and_across(abs_eta: Array, w: WeightExpansion, eg: Array | None) -> tuple[Array, Array]:
    """Return the responses to shear along the shape and at 45 degrees to it, (n_gal,) each.

    `(eta w' + w)/(1 - EG)` and `Y w`: the derivatives of `w eta` by 2g. R1 is their mean.
    """
    xp = array_namespace(abs_eta=abs_eta)
    along = w.value + abs_eta * w.first
    if eg is not None:
        good = has_response(eg)
        response = 1.0 - xp.where(good, eg, xp.zeros_like(eg))
        along = xp.where(good, along / response, xp.full_like(along, float("nan")))
    return along, (1.0 + abs_eta**2 * _excess(abs_eta)) * w.value


def third_order(abs_eta: Array, w: WeightExpansion) -> Array:
    """Return R3 from a weight that is expanded already; see `R3`."""
    z = _excess(abs_eta)
    y = 1.0 + abs_eta**2 * z
    # 2 eta w' · 3Y²/2eta² = 3Y² w'/eta, finite at 0.
    return 0.25 * (
        w.value * (2.0 - y + y**2 * z)
        + 2.0 * abs_eta * w.first * (1.0 - 2.0 * y * z)
        + 3.0 * y**2 * w.ratio
        + w.second * (2.0 * y + 3.0)
        + abs_eta * w.third
    )


def _checked(abs_eta: Array, eg: Array | None) -> Array:
    """Refuse what is not one number for each galaxy; return `|eta|` as floats."""
    xp = array_namespace(abs_eta=abs_eta, eg=eg)
    abs_eta = as_floating(xp, abs_eta, "abs_eta")
    require_dtype(abs_eta.dtype, eg=eg)
    if abs_eta.ndim != 1:
        raise ShapeMismatchError(
            f"abs_eta must have the shape (n_gal,), not {tuple(abs_eta.shape)}"
        )
    if eg is not None and eg.shape != abs_eta.shape:
        raise ShapeMismatchError(
            f"eg must have the shape {tuple(abs_eta.shape)} of abs_eta, not {tuple(eg.shape)}"
        )
    return abs_eta


def _excess(abs_eta: Array) -> Array:
    """Return `(Y - 1)/eta²`, Y = eta/tanh eta; 1/3 at 0, with all its digits around it."""
    xp = array_namespace(abs_eta=abs_eta)
    small = abs_eta < 1
    # Y - 1 = (cosh - sinh/x)/(sinh/x). Beyond 1 it has no digits to lose, and sinh overflows.
    inside = xp.where(small, abs_eta, xp.zeros_like(abs_eta)) ** 2
    slope, _ = hyperbolic_slopes(xp, inside)
    _, sinhc, _ = hyperbolic_series(xp, inside)
    outside = xp.where(small, xp.ones_like(abs_eta), abs_eta)
    return xp.where(small, slope / sinhc, (outside / xp.tanh(outside) - 1.0) / outside**2)
