"""Gauss-Laguerre functions: a basis for images that is its own Fourier transform.

On the plane of `u = (r cos theta, r sin theta)`, for `p >= q >= 0` and `m = p - q`::

    psi_pq = (-1)^q sqrt(q!/(pi p!)) r^m exp(i m theta) exp(-r²/2) L_q^(m)(r²)

and `psi_qp = psi_pq*`: orthonormal, `integral psi_pq* psi_p'q' d²u = 1` or 0. A real image
has `b_qp = b_pq*`, so `sum b_pq psi_pq` over all p + q <= N is a sum over real functions::

    phi = psi_pp,                                      coefficient b_pp,
    phi = sqrt(2) Re psi_pq and sqrt(2) Im psi_pq,     coefficients sqrt(2) Re b_pq and
                                                       -sqrt(2) Im b_pq,  p > q,

orthonormal again. They are packed by p + q first, so that a lower order is a beginning of a
higher one; then by m, the cosine before the sine: 00 | 10c 10s | 11 20c 20s | 21c 21s ...

An elliptical basis has `u = S_eta^-1 (x - x0)/sigma` and functions `phi(u)/sigma`, orthonormal
over x. The transform `integral f(x) exp(-i k.x) d²x` of one is, with `l = sigma S_eta k`::

    2 pi sigma (-i)^(p+q) exp(-i k.x0) phi(l).
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.arrays import Array, Rows, array_namespace, device_of, rows_of
from fdnt_xp.errors import FdntTypeError, RangeError
from fdnt_xp.shear import hyperbolic_series, hyperbolic_slopes, shear_matrix

MAX_ORDER: Final = 20
"""Largest p + q."""
_FARTHEST: Final = 1e4
"""Largest r² that is told from others: every function is 0 there, and none is 0 times infinity."""


def check_order(order: int) -> None:
    """Raise `FdntTypeError` or `RangeError` if there is no basis of this order."""
    if not isinstance(order, numbers.Real) or (isinstance(order, float) and order % 1 == 0):
        raise FdntTypeError(f"order must be an integer, not {order!r}")
    if not (isinstance(order, numbers.Integral) and 0 <= order <= MAX_ORDER):
        raise RangeError("order", order, 0, MAX_ORDER)


def n_coefficients(order: int) -> int:
    """Return how many real functions have p + q <= order."""
    return (order + 1) * (order + 2) // 2


def position(p: int, q: int, *, sine: bool = False) -> int:
    """Return where the function of `p >= q` is in the packed order."""
    m = p - q
    return n_coefficients(p + q - 1) + (m if sine else max(m - 1, 0))


def degrees(order: int) -> list[int]:
    """Return p + q of each packed function."""
    return [degree for degree in range(order + 1) for _ in range(degree + 1)]


def complex_coefficients(coefficients: Array, order: int) -> dict[tuple[int, int], Array]:
    """Return `b_pq`, p >= q, of packed coefficients of shape (n_gal, n_coef); each (n_gal,)."""
    xp = array_namespace(coefficients=coefficients)
    dtype = xp.complex64 if coefficients.dtype == xp.float32 else xp.complex128
    b = {}
    for degree in range(order + 1):
        for q in range(degree // 2 + 1):
            p = degree - q
            value = xp.astype(coefficients[:, position(p, q)], dtype)
            if p > q:
                sine = xp.astype(coefficients[:, position(p, q, sine=True)], dtype)
                value = (value - 1j * sine) * math.sqrt(0.5)
            b[p, q] = value
    return b


@dataclass(frozen=True, kw_only=True)
class LaguerreBasis:
    """An elliptical Gauss-Laguerre basis for each galaxy.

    Parameters
    ----------
    order : int
        Largest p + q.
    eta : array, shape (n_gal, 2)
        Its shape: the functions are round in `S_eta^-1 x`.
    centroid : array, shape (n_gal, 2)
        x0, pixels from the origin of x, which on stamps is their centre.
    size : array, shape (n_gal,)
        sigma of the Gaussian factor, pixels.
    """

    order: int
    eta: Array
    centroid: Array
    size: Array

    @property
    def n_coef(self) -> int:
        """Number of functions."""
        return n_coefficients(self.order)

    def take(self, rows: Rows) -> LaguerreBasis:
        """Return the bases of the given galaxies."""
        return LaguerreBasis(
            order=self.order,
            eta=rows_of(self.eta, rows),
            centroid=rows_of(self.centroid, rows),
            size=rows_of(self.size, rows),
        )

    def in_x(self, x: Array, y: Array) -> Array:
        """Return the functions at positions, pixels; shape (n_gal, n_coef, n_x).

        The positions come last: each function of a galaxy is then contiguous, as the
        recurrence makes it, and sums over pixels are products of matrices.

        Parameters
        ----------
        x, y : array, shape (n_x,)
        """
        xp = array_namespace(eta=self.eta, x=x, y=y)
        functions = round_functions(xp, self.order, *self._round_x(x, y))
        return functions / self.size[:, None, None]

    def in_k(self, kx: Array, ky: Array) -> Array:
        """Return `2 pi sigma phi(sigma S_eta k)`, shape (n_gal, n_coef, n_k), k in rad/pixel.

        Times `(-i)^(p+q) exp(-i k.x0)` they are the transforms of the functions of x.
        """
        xp = array_namespace(eta=self.eta, kx=kx, ky=ky)
        functions = round_functions(xp, self.order, *self._round_k(kx, ky))
        return functions * (2.0 * math.pi * self.size)[:, None, None]

    def image(self, coefficients: Array, x: Array, y: Array) -> Array:
        """Return `sum b phi(u)/sigma` at positions, shape (n_gal, n_x)."""
        xp = array_namespace(eta=self.eta, coefficients=coefficients)
        u, v = self._round_x(x, y)
        total = xp.zeros_like(u)
        for j, function in _functions(xp, self.order, u, v):
            total = total + coefficients[:, j : j + 1] * function
        return total / self.size[:, None]

    def transform(self, coefficients: Array, kx: Array, ky: Array) -> tuple[Array, Array]:
        """Return the real and imaginary parts of the transform of an image.

        They are those about the centroid x0 of the basis: without its `exp(-i k.x0)`.

        Parameters
        ----------
        coefficients : array, shape (n_gal, n_coef)
        kx, ky : array, shape (n_k,)
            rad/pixel.

        Returns
        -------
        re, im : array, shape (n_gal, n_k)
        """
        xp = array_namespace(eta=self.eta, coefficients=coefficients)
        u, v = self._round_k(kx, ky)
        parts = [xp.zeros_like(u), xp.zeros_like(u)]
        degree = degrees(self.order)
        for j, function in _functions(xp, self.order, u, v):
            # (-i)^n is 1, -i, -1, i.
            imaginary, negative = degree[j] % 2, degree[j] % 4 in (1, 2)
            term = coefficients[:, j : j + 1] * function
            parts[imaginary] = parts[imaginary] + (-term if negative else term)
        scale = (2.0 * math.pi * self.size)[:, None]
        return scale * parts[0], scale * parts[1]

    def moves(self, length: Array) -> Array:
        """Return how a change of the basis moves u, in the order of `generators`.

        A point at `x = x0 + sigma S u` stays where it is: what the changed basis has at u'
        this one has at `u = u' + S^-1 dx0/sigma + (S^-1 dS + dln sigma) u'`.

        Parameters
        ----------
        length : array, shape (n_gal,)
            L, the unit of x0, pixels.

        Returns
        -------
        array, shape (n_gal, 5, 6)
            By `(x0/L, y0/L, eta1, eta2, ln sigma)`.
        """
        xp = array_namespace(eta=self.eta, length=length)
        back = shear_matrix(-self.eta)
        zero, one = xp.zeros_like(length), xp.ones_like(length)
        shift = back * (length / self.size)[:, None, None]
        moves = [[shift[:, 0, j], shift[:, 1, j], zero, zero, zero, zero] for j in (0, 1)]
        for slope in _shear_slopes(self.eta):
            a = 0.5 * xp.sum(back[:, :, :, None] * slope[:, None, :, :], axis=2)
            size, plus = a[:, 0, 0] + a[:, 1, 1], a[:, 0, 0] - a[:, 1, 1]
            cross, turn = a[:, 1, 0] + a[:, 0, 1], a[:, 1, 0] - a[:, 0, 1]
            moves.append([zero, zero, size, plus, cross, turn])
        moves.append([zero, zero, one, zero, zero, zero])
        return xp.stack([xp.stack(row, axis=-1) for row in moves], axis=1)

    def _round_x(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return `u = S_eta^-1 (x - x0)/sigma`, two of shape (n_gal, n_x)."""
        dx, dy = x[None, :] - self.centroid[:, 0:1], y[None, :] - self.centroid[:, 1:2]
        return _moved(shear_matrix(-self.eta) / self.size[:, None, None], dx, dy)

    def _round_k(self, kx: Array, ky: Array) -> tuple[Array, Array]:
        """Return `l = sigma S_eta k`, two of shape (n_gal, n_k)."""
        matrix = shear_matrix(self.eta) * self.size[:, None, None]
        return _moved(matrix, kx[None, :], ky[None, :])


def round_functions(xp: ModuleType, order: int, u: Array, v: Array) -> Array:
    """Return the packed functions phi at (u, v) of shape (n_gal, n); (n_gal, n_coef, n)."""
    planes = dict(_functions(xp, order, u, v))
    return xp.stack([planes[j] for j in range(n_coefficients(order))], axis=1)


def _functions(xp: ModuleType, order: int, u: Array, v: Array) -> Iterator[tuple[int, Array]]:
    """Yield the place in the packed order and the values of each function.

    `psi_m0 = z psi_m-1,0 / sqrt(m)`, z = u + iv, then by the recurrence of the Laguerre
    polynomials in q. All numbers are of order one: the normalisation is in each step.
    """
    square = u * u + v * v
    square = xp.minimum(square, xp.full_like(square, _FARTHEST))
    cosine = xp.exp(-0.5 * square) * math.sqrt(1.0 / math.pi)
    sine = xp.zeros_like(cosine)
    for m in range(order + 1):
        if m > 0:
            # sqrt(2) once: Re and Im of psi share its norm.
            step = math.sqrt(2.0 if m == 1 else 1.0 / m)
            cosine, sine = step * (u * cosine - v * sine), step * (u * sine + v * cosine)
        yield from _radial(xp, order, m, square, cosine, sine=False)
        if m > 0:
            yield from _radial(xp, order, m, square, sine, sine=True)


def _radial(
    xp: ModuleType, order: int, m: int, square: Array, first: Array, *, sine: bool
) -> Iterator[tuple[int, Array]]:
    """Yield the functions of one m and parity, q from 0 up, from that of q = 0."""
    previous, current = xp.zeros_like(first), first
    for q in range((order - m) // 2 + 1):
        yield position(q + m, q, sine=sine), current
        norm = 1.0 / math.sqrt((q + 1) * (q + 1 + m))
        following = (square - (2 * q + 1 + m)) * current - math.sqrt(q * (q + m)) * previous
        previous, current = current, norm * following


def _shear_slopes(eta: Array) -> list[Array]:
    """Return `dS_eta/deta_j`, j = 1, 2, each (n_gal, 2, 2).

    With h = eta/2, `S = cosh|h| + shc N(h)`, `N = [[h1, h2], [h2, -h1]]`.
    """
    xp = array_namespace(eta=eta)
    half = 0.5 * eta
    square = xp.sum(half**2, axis=-1)
    shc = hyperbolic_series(xp, square)[1]
    shc_slope = hyperbolic_slopes(xp, square)[0]
    slopes = []
    for j in (0, 1):
        identity = shc * half[:, j]
        plus, cross = (
            shc_slope * half[:, j] * half[:, i] + (shc if i == j else 0.0) for i in (0, 1)
        )
        rows = [[identity + plus, cross], [cross, identity - plus]]
        slopes.append(0.5 * xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2))
    return slopes


def pixel_positions(xp: ModuleType, stamps: Array) -> tuple[Array, Array]:
    """Return x and y of the pixels of stamps from their centre, each of shape (ny nx,)."""
    ny, nx = (int(n) for n in stamps.shape[1:])
    like = {"dtype": stamps.dtype, "device": device_of(stamps)}
    x = xp.arange(nx, **like) - 0.5 * (nx - 1)
    y = xp.arange(ny, **like) - 0.5 * (ny - 1)
    x, y = xp.broadcast_to(x[None, :], (ny, nx)), xp.broadcast_to(y[:, None], (ny, nx))
    return xp.reshape(x, (ny * nx,)), xp.reshape(y, (ny * nx,))


def _moved(matrix: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Return `M x` of positions (n_gal or 1, n) by matrices (n_gal, 2, 2)."""
    return (
        matrix[:, 0, 0][:, None] * x + matrix[:, 0, 1][:, None] * y,
        matrix[:, 1, 0][:, None] * x + matrix[:, 1, 1][:, None] * y,
    )


def generators(order: int) -> NDArray[np.float64]:
    """Return what six differential operators do to packed coefficients.

    Moving, sizing and shearing a basis changes the coefficients of an image by these: where
    `u' = u + t + A u`, small t and A, they gain `(t + A u).grad` of the image.

    Returns
    -------
    array, shape (6, n_coef, n_coef)
        `d/du`, `d/dv`, `u d/du + v d/dv`, `u d/du - v d/dv`, `u d/dv + v d/du` and
        `u d/dv - v d/du`. Rows: coefficients of the result. What leaves the order is cut off.
    """
    z, dz, pairs = _ladders(order + 2)
    # With z = u + iv: dz is d/dz, and conjugation exchanges p and q.
    swap = np.array([pairs.index((q, p)) for p, q in pairs])
    z_bar, dz_bar = z[swap][:, swap], dz[swap][:, swap]
    operators = [
        dz + dz_bar,
        1j * (dz - dz_bar),
        z @ dz + z_bar @ dz_bar,
        z @ dz_bar + z_bar @ dz,
        -1j * (z @ dz_bar - z_bar @ dz),
        1j * (z @ dz - z_bar @ dz_bar),
    ]
    pack = _packing(order, pairs)
    return np.stack([np.real(np.conj(pack) @ op @ pack.T) for op in operators])


def _ladders(order: int) -> tuple[NDArray[np.float64], NDArray[np.float64], list[tuple[int, int]]]:
    """Return the matrices of z and d/dz on `b_pq`, and the (p, q) of their rows.

    `z psi_pq = sqrt(p+1) psi_p+1,q + sqrt(q) psi_p,q-1` and
    `2 d/dz psi_pq = sqrt(p) psi_p-1,q - sqrt(q+1) psi_p,q+1`.
    """
    pairs = [(p, n - p) for n in range(order + 1) for p in range(n + 1)]
    row = {pair: i for i, pair in enumerate(pairs)}
    z, dz = np.zeros((2, len(pairs), len(pairs)))
    for (p, q), i in row.items():
        for matrix, target, value in (
            (z, (p + 1, q), math.sqrt(p + 1)),
            (z, (p, q - 1), math.sqrt(q)),
            (dz, (p - 1, q), 0.5 * math.sqrt(p)),
            (dz, (p, q + 1), -0.5 * math.sqrt(q + 1)),
        ):
            if target in row:
                matrix[row[target], i] = value
    return z, dz, pairs


def _packing(order: int, pairs: list[tuple[int, int]]) -> NDArray[np.complex128]:
    """Return T of `phi_j = sum T_j,pq psi_pq`, shape (n_coef, n_pairs)."""
    pack = np.zeros((n_coefficients(order), len(pairs)), dtype=np.complex128)
    half = math.sqrt(0.5)
    for column, (p, q) in enumerate(pairs):
        if p + q > order:
            continue
        if p == q:
            pack[position(p, q), column] = 1.0
        else:
            high, low = max(p, q), min(p, q)
            pack[position(high, low), column] = half
            pack[position(high, low, sine=True), column] = -1j * half if p > q else 1j * half
    return pack
