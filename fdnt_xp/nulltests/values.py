"""What the null tests say of each galaxy: their values, the width of their weight, their noise."""

from __future__ import annotations

from dataclasses import dataclass

from fdnt_xp.arrays import Array, array_namespace


@dataclass(frozen=True, kw_only=True)
class TestValues:
    """The tests `(t1, t2, tx, ty, t0)` of each galaxy, with their partial derivatives.

    Parameters
    ----------
    values : array, shape (n_gal, 5)
    by_parameter : array, shape (n_gal, 5, 4)
        By `(eta1, eta2, x0, y0)`, at fixed s and weight width.
    by_ln_shrink : array, shape (n_gal, 5)
        By ln s, at fixed width.
    by_width : array, shape (n_gal, 5)
        By the width `sigma²` of the weight.
    """

    __test__ = False  # not a class of pytest's

    values: Array
    by_parameter: Array
    by_ln_shrink: Array
    by_width: Array


@dataclass(frozen=True, kw_only=True)
class MatchedWidth:
    """The width of each galaxy's weight: the solution of the size equation, or given.

    Parameters
    ----------
    width : array, shape (n_gal,)
        sigma², pixel².
    by_parameter, by_ln_shrink : array, shape (n_gal, 4) and (n_gal,)
        Its derivatives by `(eta1, eta2, x0, y0)` at fixed s, and by ln s.
    by_ln_square : array, shape (n_gal,)
        Its derivative by the logarithm of the galaxy's mean `|k'|²`.
    flux, square : array, shape (n_gal,)
        `sum 𝒯 Re I~` and `sum 𝒯 Re I~ |k'|²`, whose ratio is that mean.
    at_bound : array, shape (n_gal,), bool
        Where the equation asks for a width out of range.
    """

    width: Array
    by_parameter: Array
    by_ln_shrink: Array
    by_ln_square: Array
    flux: Array
    square: Array
    at_bound: Array

    @classmethod
    def held(cls, width: Array, flux: Array, square: Array) -> MatchedWidth:
        """Return a width that was given, and follows nothing."""
        xp = array_namespace(flux=flux)
        zero = xp.zeros_like(flux)
        return cls(
            width=width,
            by_parameter=xp.stack([zero] * 4, axis=-1),
            by_ln_shrink=zero,
            by_ln_square=zero,
            flux=flux,
            square=square,
            at_bound=zero > 0,
        )


def inverse_mean_square(flux: Array, square: Array) -> tuple[Array, Array]:
    """Return `1/<|k'|²>` for the size equation, and where the galaxy has such a number.

    A mean square that noise made negative or tiny asks for the widest weight; and pixels
    beyond all range, whose ratio would be NaN, for any.
    """
    xp = array_namespace(flux=flux)
    positive = (square > 0) & (flux > 0) & xp.isfinite(flux)
    safe = xp.where(positive, square, xp.ones_like(square))
    return xp.where(positive, flux / safe, xp.full_like(flux, 1e30)), positive


@dataclass(frozen=True, kw_only=True)
class TestNoise:
    """What the solution is worth: noise of the tests, and flux under the weight.

    Variances are for unit noise power per mode of the grid.

    Parameters
    ----------
    even, odd : array, shape (n_gal, 2, 2)
        Covariances of (t1, t2), the noise of a free width included, and of (tx, ty) at
        fixed width: what a free one adds there, and between even and odd tests, vanishes
        for galaxies with inversion symmetry and is left out for all.
    flux, flux_variance : array, shape (n_gal,)
        Amplitude F of the Gaussian galaxy `F exp(-q sigma²/2)` that has the same sum under
        the weight.
    scale_variance : array, shape (n_gal,)
        Of t0 at fixed width.
    tests, matched : TestValues, MatchedWidth
        The raw tests and the width of the weight.
    """

    __test__ = False

    even: Array
    odd: Array
    flux: Array
    flux_variance: Array
    scale_variance: Array
    tests: TestValues
    matched: MatchedWidth
