"""The null tests of B10, their derivatives, and their noise, for a batch of galaxies.

With `k' = S_eta k`, the centroid moved to the origin, and the weight W of
`fdnt_xp.nulltests.weights` (B10 eq. 23)::

    t1 = sum W Re I~ (k'x² - k'y²)      tx = sum W Im I~ kx
    t2 = sum W Re I~  2 k'x k'y         ty = sum W Im I~ ky
    t0 = sum W Re I~ |k'|²

The first four vanish at the shape and centroid of the galaxy. The dipole is written in k,
not k': S_eta is invertible, so both vanish together. t0 only sets the scale: what is
solved is `(t1, t2, tx/L, ty/L)/t0`, which knows neither the flux nor the units, and which
stays of order one where an ever narrower weight would make all tests small.

Everything is a combination, with coefficients that depend on eta alone, of a few moments
of `W I~` and `(d𝒯/dq) I~` (docs, "Sheared moments are moments").
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from fdnt_xp.arrays import Array, array_namespace
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.fourier.transform import DeconvolvedStamps
from fdnt_xp.nulltests.forms import ShearedForms, contract, sheared_forms
from fdnt_xp.nulltests.weights import Weight


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
    tests, matched : TestValues, MatchedWidth
        The raw tests and the width of the weight.
    """

    __test__ = False

    even: Array
    odd: Array
    flux: Array
    flux_variance: Array
    tests: TestValues
    matched: MatchedWidth


@dataclass(frozen=True, kw_only=True)
class _View:
    """The galaxies as a trial shape and centroid sees them; fields are (n_gal, n_k)."""

    forms: ShearedForms
    shrink: Array
    square: Array
    re: Array
    im: Array
    psf_factor: Array
    psf_slope: Array


@dataclass(frozen=True, kw_only=True)
class NullTests:
    """The null tests of a batch of galaxies: a `RootProblem` in `(eta1, eta2, x0/L, y0/L)`.

    Shape and width are those in the frame of the weight, which may be the sky; centroid and
    dipole stay in pixels, for a regular map makes no dipole vanish that did not.

    Parameters
    ----------
    grid : KGrid
    galaxies : DeconvolvedStamps
    weight : Weight
    length : float
        L, pixels: the unit in which centroids are of order one.
    fixed_width : array, shape (n_gal,), optional
        sigma² given by the caller; the size equation is solved where absent.
    """

    grid: KGrid
    galaxies: DeconvolvedStamps
    weight: Weight
    length: float
    fixed_width: Array | None = None

    def take(self, rows: Array) -> NullTests:
        """Return the tests of the given galaxies (integer array)."""
        xp = array_namespace(rows=rows)
        fixed = self.fixed_width
        return replace(
            self,
            galaxies=self.galaxies.take(rows),
            weight=self.weight.take(rows),
            fixed_width=None if fixed is None else xp.take(fixed, rows, axis=0),
        )

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """Return the scaled tests, shape (n_gal, 4), and their Jacobian, (n_gal, 4, 4).

        The size equation is solved on the way, so these are derivatives along its
        solution: Newton's method in five unknowns with the fifth equation satisfied. NaN
        where t0 is not positive: there is no galaxy to null.
        """
        xp = array_namespace(x=x)
        eta = x[:, :2]
        tests, matched = self.at(eta, self.length * x[:, 2:])
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
        return self._scaled(tests.values, slopes)

    def at(self, eta: Array, centroid: Array) -> tuple[TestValues, MatchedWidth]:
        """Return the raw tests and the width of the weight.

        Parameters
        ----------
        eta : array, shape (n_gal, 2)
        centroid : array, shape (n_gal, 2)
            Pixels from the centre of the stamp.
        """
        view = self._view(eta, centroid)
        matched = self._matched_width(view)
        return self._tests(view, matched.width), matched

    def noise(self, eta: Array, centroid: Array, inverse_power: Array) -> TestNoise:
        """Return the noise of the raw tests, and the flux, at a solution.

        A test is linear in the image, and noise independent from mode to mode, so each
        covariance is one sum over k (docs, "Noise").

        Parameters
        ----------
        eta, centroid : array, shape (n_gal, 2)
            The solution.
        inverse_power : array, shape (n_gal or 1, n_k)
            `1/|T|²`: noise power of the deconvolved image for unit noise power per mode.
        """
        view = self._view(eta, centroid)
        matched = self._matched_width(view)
        gauss = _gauss(view.square, matched.width)
        weight = view.psf_factor * gauss
        tests = self._tests(view, matched.width)
        ww0, ww2, ww4 = self.grid.even_moments(weight * weight * inverse_power)
        even = self._with_width_noise(view, matched, tests.by_width, weight, inverse_power, ww4)
        sum_gauss = self.grid.even_moments(weight * gauss)[0][:, 0]
        return TestNoise(
            even=_symmetric(even),
            odd=_symmetric(ww2),
            flux=self.grid.even_moments(weight * view.re)[0][:, 0] / sum_gauss,
            flux_variance=ww0[:, 0] / sum_gauss**2,
            tests=tests,
            matched=matched,
        )

    def _with_width_noise(
        self,
        view: _View,
        matched: MatchedWidth,
        by_width: Array,
        weight: Array,
        inverse_power: Array,
        ww4: Array,
    ) -> Array:
        """Return Var t1, Cov(t1, t2), Var t2, with the noise that comes by the width.

        Noise moves the width by `by_ln_square` times `d ln<|k'|²>`, which is
        `sum 𝒯 dRe I~ (q/Q - 1/F)` with F and Q the `flux` and `square` of the match.
        """
        xp = array_namespace(weight=weight)
        f0, *quadrupoles = view.forms.forms
        _, wa2, wa4 = self.grid.even_moments(weight * view.psf_factor * inverse_power)
        aa0, aa2, aa4 = self.grid.even_moments(view.psf_factor**2 * inverse_power)
        inv_square, inv_flux = _inverse(matched.square)[:, None], _inverse(matched.flux)[:, None]
        ln_square_var = (
            contract(contract(aa4, f0), f0) * inv_square**2
            - 2.0 * contract(aa2, f0) * inv_square * inv_flux
            + aa0 * inv_flux**2
        )
        with_ln_square = [
            contract(contract(wa4, form), f0) * inv_square - contract(wa2, form) * inv_flux
            for form in quadrupoles
        ]
        response = [(by_width[:, i] * matched.by_ln_square)[:, None] for i in (0, 1)]
        covariances = [
            contract(contract(ww4, quadrupoles[i]), quadrupoles[j])
            + response[i] * with_ln_square[j]
            + response[j] * with_ln_square[i]
            + response[i] * response[j] * ln_square_var
            for i, j in ((0, 0), (0, 1), (1, 1))
        ]
        return xp.concat(covariances, axis=-1)

    def _view(self, eta: Array, centroid: Array) -> _View:
        xp = array_namespace(eta=eta)
        forms = sheared_forms(eta, self.weight.frame)
        shrink = xp.exp(0.5 * xp.sqrt(eta[:, 0] ** 2 + eta[:, 1] ** 2))
        # Rounding can make a tiny q negative; it is a square.
        square = xp.matmul(forms.forms[0], self.grid.squares)
        square = xp.maximum(square, xp.zeros_like(square))
        re, im = self.galaxies.shifted(self.grid, centroid)
        factor, slope = self.weight.psf_factor(square, shrink)
        return _View(
            forms=forms,
            shrink=shrink,
            square=square,
            re=re,
            im=im,
            psf_factor=factor,
            psf_slope=slope,
        )

    def _matched_width(self, view: _View) -> MatchedWidth:
        """Solve the size equation in a view."""
        xp = array_namespace(square=view.square)
        a0, a2, _ = self.grid.even_moments(view.psf_factor * view.re)
        f0 = view.forms.forms[0]
        flux, square = a0[:, 0], contract(a2, f0)[:, 0]
        if self.fixed_width is not None:
            zero = xp.zeros_like(flux)
            return MatchedWidth(
                width=self.fixed_width,
                by_parameter=xp.stack([zero] * 4, axis=-1),
                by_ln_shrink=zero,
                by_ln_square=zero,
                flux=flux,
                square=square,
                at_bound=zero > 0,
            )
        # A mean square that noise made negative or tiny asks for the widest weight.
        positive = (square > 0) & (flux > 0)
        safe = xp.where(positive, square, xp.ones_like(square))
        inverse = xp.where(positive, flux / safe, xp.full_like(flux, 1e30))
        width, slope, at_bound = self.weight.matched_width(inverse, view.shrink)
        by_ln_square = -slope * xp.where(positive, inverse, xp.zeros_like(inverse))
        by_parameter, by_ln_shrink = self._ln_mean_square_slopes(view, a2, flux, square)
        # At fixed <k'²> the width goes with s²: it is s² times a function of s² <k'²>.
        explicit = 2.0 * (width + by_ln_square)
        return MatchedWidth(
            width=width,
            by_parameter=by_ln_square[:, None] * by_parameter,
            by_ln_shrink=explicit + by_ln_square * by_ln_shrink,
            by_ln_square=by_ln_square,
            flux=flux,
            square=square,
            at_bound=at_bound,
        )

    def _ln_mean_square_slopes(
        self, view: _View, a2: Array, flux: Array, square: Array
    ) -> tuple[Array, Array]:
        """Return the derivatives of `ln<|k'|²>` by (eta1, eta2, x0, y0) and by ln s."""
        xp = array_namespace(flux=flux)
        f0 = view.forms.forms[0]
        _, b2, b4 = self.grid.even_moments(view.psf_slope * view.re)
        c1, c3 = self.grid.odd_moments(view.psf_factor * view.im)
        inv_flux, inv_square = _inverse(flux)[:, None], _inverse(square)[:, None]
        by_eta = []
        for slopes in view.forms.slopes:
            square_slope = contract(contract(b4, f0), slopes[0]) + contract(a2, slopes[0])
            by_eta.append(square_slope * inv_square - contract(b2, slopes[0]) * inv_flux)
        # d Re/dx0 = -kx Im.
        by_centroid = c1 * inv_flux - contract(c3, f0) * inv_square
        # d𝒯/dln s = 2 q d𝒯/dq.
        by_ln_shrink = 2.0 * (
            contract(contract(b4, f0), f0) * inv_square - contract(b2, f0) * inv_flux
        )
        return xp.concat([*by_eta, by_centroid], axis=-1), by_ln_shrink[:, 0]

    def _tests(self, view: _View, width: Array) -> TestValues:
        """Evaluate the tests and their partial derivatives in a view."""
        xp = array_namespace(width=width)
        gauss = _gauss(view.square, width)
        weight, slope = view.psf_factor * gauss, view.psf_slope * gauss
        _, w2, w4 = self.grid.even_moments(weight * view.re)
        _, _, b4 = self.grid.even_moments(slope * view.re)
        v1, v3 = self.grid.odd_moments(weight * view.im)
        _, c3 = self.grid.odd_moments(slope * view.im)
        # dW/dq = (d𝒯/dq - 𝒯 sigma²/2) exp(-q sigma²/2).
        half = 0.5 * width[:, None]
        by_square4, by_square3 = b4 - half * w4, c3 - half * v3
        f0, f1, f2 = view.forms.forms

        by_eta = []
        for d0, d1, d2 in view.forms.slopes:
            moved = contract(by_square4, d0)
            by_eta.append(
                xp.concat(
                    [
                        contract(moved, f1) + contract(w2, d1),
                        contract(moved, f2) + contract(w2, d2),
                        contract(by_square3, d0),
                        contract(moved, f0) + contract(w2, d0),
                    ],
                    axis=-1,
                )
            )
        # d Re/dx0 = -kx Im and d Im/dx0 = kx Re.
        quadrupoles = xp.stack([-contract(v3, f) for f in (f1, f2)], axis=1)
        dipole = _symmetric(w2)
        scale = -contract(v3, f0)[:, None, :]
        by_centroid = xp.concat([quadrupoles, dipole, scale], axis=1)
        weighted_square = contract(w4, f0)

        def all_five(even2: Array, odd1: Array) -> Array:
            """Return (t1, t2, tx, ty, t0) from second and first moments."""
            return xp.concat(
                [contract(even2, f1), contract(even2, f2), odd1, contract(even2, f0)], axis=-1
            )

        return TestValues(
            values=all_five(w2, v1),
            by_parameter=xp.concat([xp.stack(by_eta, axis=-1), by_centroid], axis=-1),
            by_ln_shrink=2.0 * all_five(contract(b4, f0), contract(c3, f0)),
            by_width=-0.5 * all_five(weighted_square, contract(v3, f0)),
        )

    def _scaled(self, values: Array, slopes: Array) -> tuple[Array, Array]:
        """Divide the tests by t0, and count centroids in units of L."""
        xp = array_namespace(values=values)
        scale = values[:, 4:]
        inverse = inverse_if_positive(scale)
        raw = values[:, :4] * inverse
        jac = (slopes[:, :4, :] - raw[:, :, None] * slopes[:, 4:, :]) * inverse[:, :, None]
        inv = 1.0 / self.length
        f = xp.concat([raw[:, :2], inv * raw[:, 2:]], axis=-1)
        jac = xp.concat([jac[:, :2, :], inv * jac[:, 2:, :]], axis=1)
        return f, xp.concat([jac[:, :, :2], self.length * jac[:, :, 2:]], axis=2)


def inverse_if_positive(scale: Array) -> Array:
    """Return 1/x where x > 0, elsewhere NaN: tests over such a scale have no value."""
    xp = array_namespace(scale=scale)
    safe = xp.where(scale > 0, scale, xp.ones_like(scale))
    return xp.where(scale > 0, 1.0 / safe, xp.full_like(scale, float("nan")))


def _gauss(square: Array, width: Array) -> Array:
    xp = array_namespace(square=square)
    return xp.exp(square * (-0.5 * width)[:, None])


def _inverse(denominator: Array) -> Array:
    """Return 1/x, and 1 where x is 0."""
    xp = array_namespace(denominator=denominator)
    return 1.0 / xp.where(denominator != 0, denominator, xp.ones_like(denominator))


def _symmetric(triple: Array) -> Array:
    """Return `[[a, b], [b, c]]` from (a, b, c), shape (n_gal, 2, 2)."""
    xp = array_namespace(triple=triple)
    a, b, c = triple[:, 0], triple[:, 1], triple[:, 2]
    return xp.stack([xp.stack([a, b], axis=-1), xp.stack([b, c], axis=-1)], axis=-2)
