"""One elliptical model for each galaxy, with its derivatives by shape, centre and size.

A round profile h of size r, sheared, has the transform `h(q)`, a function of one quadratic
form::

    q = r² |S_eta k|² = u (kx² + ky²) + v (kx² - ky²) + w 2 kx ky,
    u = r² cosh|eta|,  (v, w) = r² sinh|eta|/|eta| eta.

q is linear in (u, v, w), so all derivatives of a model are h', h'' and monomials of k. What
they are by `(eta1, eta2, ln r)` follows from a few numbers for each galaxy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from fdnt_xp.arrays import Array, array_namespace
from fdnt_xp.peers.drawing import Drawing
from fdnt_xp.peers.profiles import Profile
from fdnt_xp.shear import hyperbolic_series, hyperbolic_slopes


@dataclass(frozen=True, kw_only=True)
class Model:
    """The transforms of the models of a batch; derivatives are by `(x0, y0, u, v, w)`.

    Parameters
    ----------
    drawing : Drawing
    values, slopes, curvatures : tuple of arrays, shape (n_gal, n_k)
        h, dh/dq and d²h/dq² of each component, of unit flux.
    seen : array, shape (n_gal, n_k), complex
        `T(k) exp(-i k.x0)`.
    """

    drawing: Drawing
    values: tuple[Array, ...]
    slopes: tuple[Array, ...]
    curvatures: tuple[Array, ...]
    seen: Array

    @classmethod
    def at(cls, drawing: Drawing, profile: Profile, centroid: Array, form: Array) -> Model:
        """Evaluate a profile.

        Parameters
        ----------
        centroid : array, shape (n_gal, 2)
            Pixels from the centre of the stamp.
        form : array, shape (n_gal, 3)
            (u, v, w), pixels².
        """
        xp = array_namespace(form=form)
        q = sum(form[:, j : j + 1] * k for j, k in enumerate(drawing.quadratics))
        q = xp.maximum(q, xp.zeros_like(q))  # rounding
        parts = [transform(q) for transform in profile.components]
        return cls(
            drawing=drawing,
            values=tuple(part[0] for part in parts),
            slopes=tuple(part[1] for part in parts),
            curvatures=tuple(part[2] for part in parts),
            seen=drawing.transfer * drawing.phase(centroid),
        )

    def draw_components(self) -> Array:
        """Return the images of the components of unit flux, (n_gal, n_component, n_pix)."""
        xp = array_namespace(seen=self.seen)
        return self.drawing.images(xp.stack([h * self.seen for h in self.values], axis=1))

    def draw_slopes(self, amplitudes: Array) -> Array:
        """Return the derivatives of the image of the sum, (n_gal, 5, n_pix)."""
        xp = array_namespace(seen=self.seen)
        moved = self.seen * (-1j * _sum(amplitudes, self.values))
        changed = self.seen * _sum(amplitudes, self.slopes)
        planes = [moved * self.drawing.kx, moved * self.drawing.ky]
        planes += [changed * k for k in self.drawing.quadratics]
        return self.drawing.images(xp.stack(planes, axis=1))

    def overlaps(self, residual: Array, amplitudes: Array) -> tuple[Array, Array]:
        """Return the products of an image with derivatives of the model, summed over pixels.

        They are sums over k: no image of a second derivative is drawn.

        Parameters
        ----------
        residual : array, shape (n_gal, n_pix)

        Returns
        -------
        first : array, shape (n_gal, n_component, 5)
            With the first derivatives of each component of unit flux.
        second : array, shape (n_gal, 5, 5)
            With the second derivatives of the sum.
        """
        xp = array_namespace(residual=residual)
        overlap = self.drawing.transform(residual) * self.seen
        even, odd = xp.real(overlap), xp.imag(overlap)
        k, k2 = [self.drawing.kx, self.drawing.ky], list(self.drawing.quadratics)
        first = [
            _moments(odd * h, k) + _moments(even * slope, k2)
            for h, slope in zip(self.values, self.slopes, strict=True)
        ]
        h, slope = _sum(amplitudes, self.values), _sum(amplitudes, self.slopes)
        curvature = _sum(amplitudes, self.curvatures)
        rows = [_moments(-even * h * a, k) + _moments(odd * slope * a, k2) for a in k]
        rows += [_moments(odd * slope * a, k) + _moments(even * curvature * a, k2) for a in k2]
        return (
            xp.stack([xp.stack(row, axis=-1) for row in first], axis=1),
            xp.stack([xp.stack(row, axis=-1) for row in rows], axis=1),
        )


@dataclass(frozen=True, kw_only=True)
class Form:
    """`(u, v, w)` of galaxies, and their derivatives by `(eta1, eta2, ln r)`.

    Parameters
    ----------
    values : array, shape (n_gal, 3)
    slopes : array, shape (n_gal, 3, 3)
        Row m: those of (u, v, w)_m.
    curvatures : array, shape (n_gal, 3, 3, 3)
        The second derivatives, m first.
    """

    values: Array
    slopes: Array
    curvatures: Array

    @classmethod
    def of(cls, eta: Array, size: Array) -> Form:
        """Return the quadratic form of shapes (n_gal, 2) and sizes (n_gal,)."""
        xp = array_namespace(eta=eta)
        x2 = xp.sum(eta**2, axis=-1)
        cosh, s, _ = hyperbolic_series(xp, x2)
        s1, _ = hyperbolic_slopes(xp, x2)
        s2 = _third_slope(x2, s, s1)
        e = [eta[:, 0], eta[:, 1]]
        values = [cosh, s * e[0], s * e[1]]
        # By eta: dcosh = s eta, ds = s1 eta, ds1 = s2 eta; by ln r everything doubles.
        first = [[s * e[0], s * e[1]]]
        second = [[[s1 * e[j] * e[k] + _delta(j, k) * s for k in (0, 1)] for j in (0, 1)]]
        for i in (0, 1):
            first.append([s1 * e[i] * e[j] + _delta(i, j) * s for j in (0, 1)])
            second.append(
                [
                    [
                        s2 * e[i] * e[j] * e[k]
                        + s1 * (e[j] * _delta(i, k) + e[k] * _delta(i, j) + e[i] * _delta(j, k))
                        for k in (0, 1)
                    ]
                    for j in (0, 1)
                ]
            )
        rows = [[*first[m], 2.0 * values[m]] for m in range(3)]
        planes = [
            [
                *([*second[m][j], 2.0 * first[m][j]] for j in (0, 1)),
                [*(2.0 * part for part in first[m]), 4.0 * values[m]],
            ]
            for m in range(3)
        ]
        square = size**2
        return cls(
            values=xp.stack(values, axis=-1) * square[:, None],
            slopes=_matrix(rows) * square[:, None, None],
            curvatures=xp.stack([_matrix(plane) for plane in planes], axis=1)
            * square[:, None, None, None],
        )


def _matrix(rows: list[list[Array]]) -> Array:
    xp = array_namespace(first=rows[0][0])
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=1)


def _delta(i: int, j: int) -> float:
    return 1.0 if i == j else 0.0


def _third_slope(x2: Array, sinhc: Array, slope: Array) -> Array:
    """Return `(d/dx)/x` of the slope of sinhc: `(sinhc - 3 slope)/x²`, 1/15 at 0."""
    xp = array_namespace(x2=x2)
    small = x2 < 1.0
    # sum over n >= 2 of 2n (2n - 2) x^(2n-4)/(2n + 1)!.
    series = xp.zeros_like(x2)
    for n in range(9, 1, -1):
        series = series * x2 + 2 * n * (2 * n - 2) / math.factorial(2 * n + 1)
    safe = xp.where(small, xp.ones_like(x2), x2)
    return xp.where(small, series, (sinhc - 3.0 * slope) / safe)


def _sum(amplitudes: Array, parts: tuple[Array, ...]) -> Array:
    """Return `sum_a c_a part_a`, shape (n_gal, n_k)."""
    total = amplitudes[:, :1] * parts[0]
    for j, part in enumerate(parts[1:], start=1):
        total = total + amplitudes[:, j : j + 1] * part
    return total


def _moments(field: Array, monomials: list[Array]) -> list[Array]:
    """Return the sums over k of a field times each monomial, each of shape (n_gal,)."""
    xp = array_namespace(field=field)
    return [xp.sum(field * monomial, axis=-1) for monomial in monomials]
