"""Sheared quadratic forms: what the tests look like on the k grid of the image.

In the frame where the galaxy is round, `k' = S_eta k`, the tests need three quadratics of
k'. Each is a quadratic form of the k of the image, with coefficients that depend on eta
alone (docs, "Sheared moments are moments")::

    |k'|²         = k.F0.k,   F0 = cosh|eta| I + shc N
    k'x² - k'y²   = k.F1.k,   F1 = sz + shc eta1 I + chc eta1 N
    2 k'x k'y     = k.F2.k,   F2 = sx + shc eta2 I + chc eta2 N

with `N = eta1 sz + eta2 sx`, `shc = sinh|eta|/|eta|` and `chc = (cosh|eta| - 1)/|eta|²`.
A form is stored as its coefficients of `kx², kx ky, ky²`, shape (n_gal, 3).

Where the shape is that on the sky, `k' = S_eta A k` with `A = B⁻ᵀ` the frame of the galaxy's
pixels (`fdnt_xp.fourier.jacobian`), and each form is `AᵀF A`: still one of the same k.
"""

from __future__ import annotations

from dataclasses import dataclass

from fdnt_xp.arrays import Array, array_namespace
from fdnt_xp.shear import hyperbolic_series, hyperbolic_slopes


@dataclass(frozen=True, kw_only=True)
class ShearedForms:
    """The forms F0, F1, F2 and their derivatives by eta1 and eta2.

    Parameters
    ----------
    forms : tuple of 3 arrays, shape (n_gal, 3)
        F0 (the square of k'), F1 and F2 (the two quadrupoles).
    slopes : tuple of 2 tuples of 3 arrays, shape (n_gal, 3)
        `slopes[j][i]` is dF_i/deta_j.
    """

    forms: tuple[Array, Array, Array]
    slopes: tuple[tuple[Array, Array, Array], tuple[Array, Array, Array]]


def sheared_forms(eta: Array, frame: Array | None = None) -> ShearedForms:
    """Return the forms at `eta`.

    Parameters
    ----------
    eta : array, shape (n_gal, 2)
    frame : array, shape (n_gal or 1, 2, 2), optional
        A, where eta is a shape in another frame than that of the pixels.
    """
    xp = array_namespace(eta=eta)
    eta1, eta2 = eta[:, 0], eta[:, 1]
    square = eta1**2 + eta2**2
    cosh, shc, chc = hyperbolic_series(xp, square)
    shc_slope, chc_slope = hyperbolic_slopes(xp, square)
    one, zero = xp.ones_like(eta1), xp.zeros_like(eta1)

    def form(identity: Array, plus: Array, cross: Array) -> Array:
        """Return `identity I + plus sz + cross sx` as coefficients."""
        coefficients = xp.stack([identity + plus, 2.0 * cross, identity - plus], axis=-1)
        return coefficients if frame is None else seen_through(coefficients, frame)

    def quadrupole_slope(i: int, j: int) -> Array:
        """Return dF_i/deta_j of `F_i = s_i + shc eta_i I + chc eta_i N`, i = 1, 2."""
        eta_i, eta_j = eta[:, i - 1], eta[:, j - 1]
        same = one if i == j else zero
        chc_eta_i_slope = chc_slope * eta_j * eta_i + chc * same
        return form(
            shc_slope * eta_j * eta_i + shc * same,
            chc_eta_i_slope * eta1 + (chc * eta_i if j == 1 else zero),
            chc_eta_i_slope * eta2 + (chc * eta_i if j == 2 else zero),
        )

    def square_slope(j: int) -> Array:
        """Return dF_0/deta_j."""
        eta_j = eta[:, j - 1]
        return form(
            shc * eta_j,
            shc_slope * eta_j * eta1 + (shc if j == 1 else zero),
            shc_slope * eta_j * eta2 + (shc if j == 2 else zero),
        )

    return ShearedForms(
        forms=(
            form(cosh, shc * eta1, shc * eta2),
            form(shc * eta1, one + chc * eta1 * eta1, chc * eta1 * eta2),
            form(shc * eta2, chc * eta2 * eta1, one + chc * eta2 * eta2),
        ),
        slopes=(
            (square_slope(1), quadrupole_slope(1, 1), quadrupole_slope(2, 1)),
            (square_slope(2), quadrupole_slope(1, 2), quadrupole_slope(2, 2)),
        ),
    )


def seen_through(form: Array, frame: Array) -> Array:
    """Return the form `AᵀF A` of k, where F is one of `A k`; shape (n_gal, 3).

    Parameters
    ----------
    form : array, shape (n_gal or 1, 3)
    frame : array, shape (n_gal or 1, 2, 2)
        A.
    """
    xp = array_namespace(form=form, frame=frame)
    xx, xy, yy = form[:, 0], form[:, 1], form[:, 2]
    a, b, c, d = (frame[:, i, j] for i in (0, 1) for j in (0, 1))
    return xp.stack(
        [
            xx * a**2 + xy * a * c + yy * c**2,
            2.0 * xx * a * b + xy * (a * d + b * c) + 2.0 * yy * c * d,
            xx * b**2 + xy * b * d + yy * d**2,
        ],
        axis=-1,
    )


def contract(moments: Array, form: Array) -> Array:
    """Return the moments of `field * form`, two degrees lower than the moments of `field`.

    Parameters
    ----------
    moments : array, shape (n_gal, d + 1), d >= 2
        `sum field kx^(d-j) ky^j`, j = 0 .. d.
    form : array, shape (n_gal, 3)
        Coefficients of `kx², kx ky, ky²`.

    Returns
    -------
    array, shape (n_gal, d - 1)
    """
    return (
        form[:, 0:1] * moments[:, :-2]
        + form[:, 1:2] * moments[:, 1:-1]
        + form[:, 2:3] * moments[:, 2:]
    )
