"""Transforms of round galaxies: Gaussians, the exponential disc, de Vaucouleurs' law.

Each profile of unit flux and size r has a transform `h(q)`, `q = (k r)²`; with it come dh/dq
and d²h/dq², from which all derivatives by shape and size are made.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fdnt_xp.arrays import Array, array_namespace, device_of
from fdnt_xp.fourier.interpolation import cubic_table

Transform: TypeAlias = "Callable[[Array], tuple[Array, Array, Array]]"
"""From q to h, dh/dq and d²h/dq², of the shape of q."""

GAUSSIAN_RATIO: Final = 2.5
"""Of the sizes of one Gaussian of a sum to the next smaller."""
_DISC: Final = 1.6783469900166605
"""Half-light radius of an exponential disc, in scale lengths."""
_LAW: Final = 7.66924944250227
"""b of `exp(-b (r/r_e)^(1/4))`, r_e the half-light radius."""
_LEAST, _MOST, _CELLS = 1e-4, 1e4, 600
"""k r_e of the table: h is 1 - 5e-8 at one end, 1e-9 at the other."""


@dataclass(frozen=True, kw_only=True)
class Profile:
    """A round galaxy with a linear combination of components of one size.

    Parameters
    ----------
    components : tuple of callable
        Transform of each, of unit flux.
    """

    components: tuple[Transform, ...]

    @property
    def n_components(self) -> int:
        """Number of components, each with an amplitude of its own."""
        return len(self.components)


def gaussians(n: int) -> Profile:
    """Return a sum of n Gaussians of sigma r, `GAUSSIAN_RATIO` r, ..."""
    return Profile(components=tuple(_gaussian(GAUSSIAN_RATIO**j) for j in range(n)))


def exponential() -> Profile:
    """Return the exponential disc of half-light radius r: `h = (1 + q/1.678²)^(-3/2)`."""

    def transform(q: Array) -> tuple[Array, Array, Array]:
        base = 1.0 + q / _DISC**2
        h = base**-1.5
        slope = (-1.5 / _DISC**2) * h / base
        return h, slope, (-2.5 / _DISC**2) * slope / base

    return Profile(components=(transform,))


def de_vaucouleurs() -> Profile:
    """Return de Vaucouleurs' law of half-light radius r, its transform from tables."""
    span = math.log(_MOST / _LEAST)

    def transform(q: Array) -> tuple[Array, Array, Array]:
        xp = array_namespace(q=q)
        nodes = xp.asarray(_law_nodes(), dtype=q.dtype, device=device_of(q))
        inside = xp.maximum(q, xp.full_like(q, _LEAST**2))
        t = xp.reshape((0.5 / span) * xp.log(inside / _LEAST**2), (-1,))
        h, _ = cubic_table(nodes[:1, :]).evaluate(t)
        slope, curvature = cubic_table(nodes[1:, :]).evaluate(t)
        h, slope, curvature = (xp.reshape(part, q.shape) for part in (h, slope, curvature / span))
        # By ln(k r), of which q is the exponential of twice. At k = 0 the slopes are multiplied
        # by powers of k.
        by_q = 0.5 * slope / inside
        zero = xp.zeros_like(q)
        second = (0.25 * curvature - 0.5 * slope) / inside**2
        return h, xp.where(q >= inside, by_q, zero), xp.where(q >= inside, second, zero)

    return Profile(components=(transform,))


def _gaussian(ratio: float) -> Transform:
    def transform(q: Array) -> tuple[Array, Array, Array]:
        xp = array_namespace(q=q)
        h, rate = xp.exp((-0.5 * ratio**2) * q), -0.5 * ratio**2
        return h, rate * h, rate**2 * h

    return transform


@lru_cache
def _law_nodes() -> NDArray[np.float64]:
    """Return h and dh/dln(k r_e) at equidistant ln(k r_e), shape (2, n)."""
    return np.stack(law_transform(np.geomspace(_LEAST, _MOST, _CELLS + 1)))


def law_transform(x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the transform h of de Vaucouleurs' law at `x = k r_e`, and dh/dln x.

    The Hankel integral of `r I(r) J0(x r)` oscillates. On the imaginary axis `r = i z`, where
    `J0` becomes `K0`, it does not::

        h = C integral z K0(x z) exp(-b cos(pi/8) z^(1/4)) sin(b sin(pi/8) z^(1/4)) dz.

    In ln z the trapezoidal rule converges exponentially.
    """
    step = 0.02
    xz = np.exp(np.arange(-60.0, 20.0, step))
    z = xz[None, :] / x[:, None]
    root = _LAW * z**0.25
    law = np.exp(-math.cos(np.pi / 8) * root) * np.sin(math.sin(np.pi / 8) * root)
    # The flux over 2 pi is the integral of r exp(-b r^(1/4)) dr = 4 Gamma(8)/b^8.
    norm = (2.0 / np.pi) * step * _LAW**8 / (4.0 * math.gamma(8.0))
    law = norm * z**2 * law
    return law @ special.k0(xz), law @ (-xz * special.k1(xz))
