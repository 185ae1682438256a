"""Weights of shapes in a mean: `w(|eta|)` and its first three derivatives.

A shape counts `w(|eta|) eta`. Any w that is smooth as a function of `(eta1, eta2)`, hence
even in `|eta|`, has a responsivity; to third order that takes w', w'' and w'''.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Final, TypeAlias

from fdnt_xp.arrays import Array, array_namespace, as_floating, count_true
from fdnt_xp.errors import (
    FdntTypeError,
    FdntValueError,
    FdntWarning,
    RangeError,
    ShapeMismatchError,
)

Function: TypeAlias = Callable[[Array], Array]
"""An elementwise function of `|eta|`, shape (n,) to (n,), in the library of its argument."""

_STEP: Final = 0.04
"""Of `scale`: the step of the numerical derivatives."""
_HALF_WIDTH: Final = 10
"""Steps to each side. For exp(-t²) and 1/(1 + t²) the three derivatives are then good to
5e-15, 1e-12 and 3e-11, at the balance of truncation and of rounding, eps/step^n."""
_NEAR_ZERO: Final = 5e-4
"""Of `scale`: below it `w'/|eta|` comes from w'' and w''', which lose no digits there."""
_UNSURE: Final = 1e-6
"""Disagreement of two stencils, in units of w and `scale`, that is worth a warning."""


@dataclass(frozen=True, kw_only=True)
class ShapeWeight:
    """A weight `w(|eta|)` of shapes, in a mean over a population.

    Parameters
    ----------
    function : callable
        `w(abs_eta)`, elementwise on arrays of shape (n,) of any library; finite, not
        negative, and smooth as a function of `(eta1, eta2)`: even in `|eta|`, no cusp at 0.
    derivatives : tuple of 3 callables, optional
        `w'`, `w''` and `w'''` by `|eta|`. Without them they are taken by central differences
        over 21 points in float64: to 1e-10 of w at its `scale` for weights like those
        below. A warning says where w is not smooth enough for that.
    scale : float
        `|eta|` over which w varies, for the numerical derivatives.
    name : str
        For reports.

    Examples
    --------
    >>> import numpy as np
    >>> from fdnt_xp.shears.weights import ShapeWeight
    >>> ShapeWeight.gaussian(0.5)(np.array([0.0, 0.5]))
    array([1.        , 0.36787944])
    >>> ShapeWeight(function=lambda eta: 1 / (0.3**2 + eta**2), scale=0.3, name="inverse").name
    'inverse'
    """

    function: Function
    derivatives: tuple[Function, Function, Function] | None = None
    scale: float = 1.0
    name: str = "custom"

    def __post_init__(self) -> None:
        """Refuse what cannot be evaluated."""
        given = (self.function, *(self.derivatives or ()))
        if not all(callable(f) for f in given) or len(given) not in (1, 4):
            raise FdntTypeError("function must be callable, and derivatives three callables")
        if not (math.isfinite(self.scale) and self.scale > 0):
            raise RangeError("scale", self.scale, 0.0, None)

    @classmethod
    def uniform(cls) -> ShapeWeight:
        """Return `w = 1`."""

        def zero(abs_eta: Array) -> Array:
            return 0.0 * abs_eta

        return cls(function=lambda x: 0.0 * x + 1.0, derivatives=(zero, zero, zero), name="uniform")

    @classmethod
    def gaussian(cls, scale: float = 1.0) -> ShapeWeight:
        """Return `w = exp(-t²)`, `t = |eta|/scale`."""

        def value(x: Array) -> Array:
            return array_namespace(x=x).exp(-((x / scale) ** 2))

        return cls(
            function=value,
            derivatives=(
                lambda x: value(x) * (-2.0 / scale) * (x / scale),
                lambda x: value(x) * (4.0 * (x / scale) ** 2 - 2.0) / scale**2,
                lambda x: value(x) * (x / scale) * (12.0 - 8.0 * (x / scale) ** 2) / scale**3,
            ),
            scale=scale,
            name=f"gaussian({scale:g})",
        )

    @classmethod
    def lorentzian(cls, scale: float = 1.0) -> ShapeWeight:
        """Return `w = 1/(1 + t²)`, `t = |eta|/scale`: inverse variance of noise and shapes."""

        def value(x: Array) -> Array:
            return 1.0 / (1.0 + (x / scale) ** 2)

        return cls(
            function=value,
            derivatives=(
                lambda x: value(x) ** 2 * (-2.0 / scale) * (x / scale),
                lambda x: value(x) ** 3 * (6.0 * (x / scale) ** 2 - 2.0) / scale**2,
                lambda x: value(x) ** 4 * (24.0 / scale**3) * (x / scale) * (1 - (x / scale) ** 2),
            ),
            scale=scale,
            name=f"lorentzian({scale:g})",
        )

    @classmethod
    def bisquare(cls, end: float = 1.5) -> ShapeWeight:
        """Return `w = (1 - (|eta|/end)²)²` up to `end`, and 0 beyond: no shape counts there."""

        def inside(x: Array) -> Array:
            xp = array_namespace(x=x)
            return xp.maximum(1.0 - (x / end) ** 2, xp.zeros_like(x))

        def third(x: Array) -> Array:
            xp = array_namespace(x=x)
            return xp.where(x < end, 24.0 * x / end**4, xp.zeros_like(x))

        def second(x: Array) -> Array:
            xp = array_namespace(x=x)
            value = (12.0 * (x / end) ** 2 - 4.0) / end**2
            return xp.where(x < end, value, xp.zeros_like(x))

        return cls(
            function=lambda x: inside(x) ** 2,
            derivatives=(lambda x: -4.0 * x / end**2 * inside(x), second, third),
            scale=end,
            name=f"bisquare({end:g})",
        )

    def __call__(self, abs_eta: Array) -> Array:
        """Return w, shape (n,); refuse a function that changes shape or gives bad values."""
        return _checked_values(self.name, abs_eta, self.function(abs_eta))

    def expand(self, abs_eta: Array) -> WeightExpansion:
        """Return w with its derivatives at `|eta|`, shape (n,), in the dtype of `abs_eta`."""
        xp = array_namespace(abs_eta=abs_eta)
        value = self(abs_eta)
        if self.derivatives is None:
            return self._expand_numerically(xp, abs_eta, value)
        first, second, third = (derivative(abs_eta) for derivative in self.derivatives)
        zero = abs_eta == 0
        ratio = first / xp.where(zero, xp.ones_like(abs_eta), abs_eta)
        ratio = xp.where(zero, second, ratio)
        return WeightExpansion(value=value, ratio=ratio, first=first, second=second, third=third)

    def _expand_numerically(self, xp: ModuleType, abs_eta: Array, value: Array) -> WeightExpansion:
        wide = xp.astype(abs_eta, xp.float64)
        first, second, third, unsure = self._differences(xp, wide)
        if unsure:
            warnings.warn(
                f"weight {self.name!r} is not smooth on a scale of {self.scale:g}: its numerical "
                "derivatives are unsure; give its derivatives, or a smaller scale",
                FdntWarning,
                stacklevel=4,
            )
        near = wide < _NEAR_ZERO * self.scale
        ratio = first / xp.where(near, xp.ones_like(wide), wide)
        # w'/x = w'' - x w'''/3 + O(x⁴) for an even w.
        ratio = xp.where(near, second - wide * third / 3.0, ratio)
        columns = {"ratio": ratio, "first": first, "second": second, "third": third}
        return WeightExpansion(
            value=value, **{name: xp.astype(c, value.dtype) for name, c in columns.items()}
        )

    def _differences(self, xp: ModuleType, x: Array) -> tuple[Array, Array, Array, bool]:
        """Return w', w'', w''' at x in float64, and whether the last is unsure."""
        step = _STEP * self.scale
        # w is even: below 0 it is mirrored.
        right = [self(x + j * step) for j in range(_HALF_WIDTH + 1)]
        left = [self(xp.abs(x - j * step)) for j in range(_HALF_WIDTH + 1)]
        zero = xp.zeros_like(x)
        first, second, third, narrower = zero, zero, zero, zero
        for j, (c1, c2, c3) in enumerate(_stencil(_HALF_WIDTH), start=1):
            odd, even = right[j] - left[j], (right[j] - right[0]) + (left[j] - right[0])
            first, second, third = first + c1 * odd, second + c2 * even, third + c3 * odd
        for j, (_, _, c3) in enumerate(_stencil(_HALF_WIDTH - 2), start=1):
            narrower = narrower + c3 * (right[j] - left[j])
        allowed = _UNSURE * _STEP**3 * xp.max(right[0]) if int(x.shape[0]) else zero
        unsure = bool(xp.any(xp.abs(third - narrower) > allowed))
        return first / step, second / step**2, third / step**3, unsure


@dataclass(frozen=True, kw_only=True)
class WeightExpansion:
    """A weight and its derivatives by `|eta|` at every shape; all of shape (n,).

    Parameters
    ----------
    value, first, second, third : array
        w, w', w'', w'''.
    ratio : array
        `w'/|eta|`, at `|eta|` = 0 its limit w''.
    """

    value: Array
    ratio: Array
    first: Array
    second: Array
    third: Array


def as_shape_weight(weight: ShapeWeight | Function | str) -> ShapeWeight:
    """Return a weight from itself, from `w(|eta|)`, or from a name.

    The names are "uniform", "gaussian" and "lorentzian", the latter two of scale 1.
    """
    named = {
        "uniform": ShapeWeight.uniform,
        "gaussian": ShapeWeight.gaussian,
        "lorentzian": ShapeWeight.lorentzian,
    }
    if isinstance(weight, ShapeWeight):
        return weight
    if isinstance(weight, str):
        if weight not in named:
            raise FdntValueError(f"weight {weight!r} is unknown; known: {', '.join(named)}")
        return named[weight]()
    if callable(weight):
        return ShapeWeight(function=weight)
    raise FdntTypeError(
        f"weight must be a ShapeWeight, a function or a name, not {type(weight).__name__}"
    )


def galaxy_weights(usable: Array, galaxy_weight: Array | None) -> Array:
    """Return what each galaxy counts, shape (n_gal,), float64: 1 unless the caller says more.

    Parameters
    ----------
    usable : array, shape (n_gal,), bool
        The others count 0, whatever their weight.
    galaxy_weight : array, shape (n_gal,), or None

    Raises
    ------
    ShapeMismatchError, NamespaceError
        If `galaxy_weight` does not fit the galaxies.
    FdntValueError
        If it is negative or not finite for a usable galaxy.
    """
    xp = array_namespace(usable=usable, galaxy_weight=galaxy_weight)
    if galaxy_weight is None:
        return xp.astype(usable, xp.float64)
    weights = as_floating(xp, galaxy_weight, "galaxy_weight")
    if weights.shape != usable.shape:
        raise ShapeMismatchError(
            f"galaxy_weight must have the shape {tuple(usable.shape)}, not {tuple(weights.shape)}"
        )
    weights = xp.where(usable, weights, xp.zeros_like(weights))
    n_bad = count_true(~(xp.isfinite(weights) & (weights >= 0)))
    if n_bad:
        raise FdntValueError(
            f"galaxy_weight must be finite and not negative; it is not for {n_bad} galaxies"
        )
    return xp.astype(weights, xp.float64)


def _checked_values(name: str, abs_eta: Array, values: Array) -> Array:
    xp = array_namespace(abs_eta=abs_eta, values=values)
    if values.shape != abs_eta.shape:
        raise FdntValueError(
            f"weight {name!r} returned the shape {tuple(values.shape)} for {tuple(abs_eta.shape)}"
        )
    if not bool(xp.all(xp.isfinite(values) & (values >= 0))):
        raise FdntValueError(f"weight {name!r} must be finite and not negative for every |eta|")
    return xp.astype(values, abs_eta.dtype)


def _stencil(half_width: int) -> list[tuple[float, float, float]]:
    """Return what `f(j) -/+ f(-j)`, j = 1 .. m, count in f', f'' and f''' at 0, for step 1.

    Lagrange's polynomial through the points -m .. m that is 1 at j is
    `x (x + j) K prod (1 - x²/i²)`, i = 1 .. m without j, with
    `K = prod i²/(i² - j²) / 2j²`. Its derivatives at 0 follow from its expansion.
    """
    rows = []
    for j in range(1, half_width + 1):
        others = [i for i in range(1, half_width + 1) if i != j]
        k = math.prod(i * i / (i * i - j * j) for i in others) / (2 * j * j)
        rows.append((j * k, 2.0 * k, -6.0 * j * k * sum(1.0 / i**2 for i in others)))
    return rows
