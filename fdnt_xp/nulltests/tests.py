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

from fdnt_xp.arrays import Array, Rows, array_namespace, blocks_in_cache, joined, rows_of
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.fourier.transform import DeconvolvedStamps
from fdnt_xp.nulltests.forms import ShearedForms, contract, sheared_forms
from fdnt_xp.nulltests.scaled import scaled_tests
from fdnt_xp.nulltests.values import MatchedWidth, TestNoise, TestValues, inverse_mean_square
from fdnt_xp.nulltests.weights import Weight


@dataclass(frozen=True, kw_only=True)
class _Frame:
    """Where a trial shape is round: what depends on eta alone."""

    forms: ShearedForms
    shrink: Array


@dataclass(frozen=True, kw_only=True)
class _View:
    """The galaxies as a trial shape and centroid sees them; fields are (n_gal, n_k)."""

    square: Array
    re: Array
    im: Array
    psf_factor: Array
    psf_slope: Array


@dataclass(frozen=True, kw_only=True)
class _Width:
    """The size equation solved: sigma², its slope by `1/<|k'|²>`, and if it is at a bound."""

    width: Array
    slope: Array
    at_bound: Array


@dataclass(frozen=True, kw_only=True)
class _SizeMoments:
    """What the size equation and its slopes need of the fields; (n_gal, number of moments).

    `𝒯' = d𝒯/dq`; the moments are those of the degrees named.
    """

    t_re: Array  # 𝒯 Re: 0, 2
    t_im: Array  # 𝒯 Im: 1, 3
    dt_re: Array  # 𝒯' Re: 2, 4


@dataclass(frozen=True, kw_only=True)
class _Moments(_SizeMoments):
    """And what the tests and their slopes need; W = 𝒯 G, G the Gaussian part of the weight."""

    w_re: Array  # W Re: 0, 2, 4
    w_im: Array  # W Im: 1, 3
    dw_re: Array  # 𝒯' G Re: 4
    dw_im: Array  # 𝒯' G Im: 3


@dataclass(frozen=True, kw_only=True)
class _PowerMoments:
    """Moments of what noise needs: products of weights, all but the last times `1/|T|²`."""

    ww: Array  # W²: 0, 2, 4
    wt: Array  # W 𝒯: 0, 2, 4
    tt: Array  # 𝒯²: 0, 2, 4
    wg: Array  # W G: 0


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

    def take(self, rows: Rows) -> NullTests:
        """Return the tests of the given galaxies."""
        fixed = self.fixed_width
        return replace(
            self,
            galaxies=self.galaxies.take(rows),
            weight=self.weight.take(rows),
            fixed_width=None if fixed is None else rows_of(fixed, rows),
        )

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """Return the scaled tests, shape (n_gal, 4), and their Jacobian, (n_gal, 4, 4).

        The size equation is solved on the way, so these are derivatives along its
        solution: Newton's method in five unknowns with the fifth equation satisfied. NaN
        where t0 is not positive: there is no galaxy to null.
        """
        eta = x[:, :2]
        return self.scaled(eta, *self.at(eta, self.length * x[:, 2:]))

    def scaled(self, eta: Array, tests: TestValues, matched: MatchedWidth) -> tuple[Array, Array]:
        """Return what `evaluate` does, from the raw tests and the width at `eta`."""
        return scaled_tests(eta, tests, matched, self.length)

    def at(self, eta: Array, centroid: Array) -> tuple[TestValues, MatchedWidth]:
        """Return the raw tests and the width of the weight.

        Parameters
        ----------
        eta : array, shape (n_gal, 2)
        centroid : array, shape (n_gal, 2)
            Pixels from the centre of the stamp.
        """
        frame = _Frame(forms=sheared_forms(eta, self.weight.frame), shrink=shrink_factor(eta))
        moments, width, _ = self._moments(frame, centroid)
        matched = self._matched_width(frame, moments, width)
        return self._tests(frame, moments, width.width), matched

    def widths(self, eta: Array, centroid: Array) -> MatchedWidth:
        """Return the width of the weight as `at` does, without the tests."""
        frame = _Frame(forms=sheared_forms(eta, self.weight.frame), shrink=shrink_factor(eta))
        moments, widths = [], []
        for rows in blocks_in_cache(self.galaxies.re):
            block = self.take(rows)
            f0, shrink = frame.forms.forms[0][rows, :], frame.shrink[rows]
            view = block._view(f0, shrink, centroid[rows, :])
            moments.append(self._size_moments(view))
            widths.append(block._width(moments[-1].t_re, f0, shrink))
        return self._matched_width(frame, joined(moments), joined(widths))

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
        frame = _Frame(forms=sheared_forms(eta, self.weight.frame), shrink=shrink_factor(eta))
        moments, width, power = self._moments(frame, centroid, inverse_power)
        assert power is not None  # as inverse_power was given
        matched = self._matched_width(frame, moments, width)
        tests = self._tests(frame, moments, width.width)
        even = self._with_width_noise(frame, matched, tests.by_width, power)
        sum_gauss, f0 = power.wg[:, 0], frame.forms.forms[0]
        return TestNoise(
            even=_symmetric(even),
            odd=_symmetric(power.ww[:, 1:4]),
            flux=moments.w_re[:, 0] / sum_gauss,
            flux_variance=power.ww[:, 0] / sum_gauss**2,
            scale_variance=contract(contract(power.ww[:, 4:], f0), f0)[:, 0],
            tests=tests,
            matched=matched,
        )

    def _with_width_noise(
        self, frame: _Frame, matched: MatchedWidth, by_width: Array, power: _PowerMoments
    ) -> Array:
        """Return Var t1, Cov(t1, t2), Var t2, with the noise that comes by the width.

        Noise moves the width by `by_ln_square` times `d ln<|k'|²>`, which is
        `sum 𝒯 dRe I~ (q/Q - 1/F)` with F and Q the `flux` and `square` of the match.
        """
        xp = array_namespace(by_width=by_width)
        f0, *quadrupoles = frame.forms.forms
        ww4, wa2, wa4 = power.ww[:, 4:], power.wt[:, 1:4], power.wt[:, 4:]
        aa0, aa2, aa4 = power.tt[:, :1], power.tt[:, 1:4], power.tt[:, 4:]
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

    def _moments(
        self, frame: _Frame, centroid: Array, inverse_power: Array | None = None
    ) -> tuple[_Moments, _Width, _PowerMoments | None]:
        """Sum over k, a few galaxies at a time: the fields then never leave the cache."""
        moments, widths, powers = [], [], []
        for rows in blocks_in_cache(self.galaxies.re):
            block = self.take(rows)
            f0, shrink = frame.forms.forms[0][rows, :], frame.shrink[rows]
            view = block._view(f0, shrink, centroid[rows, :])
            size = self._size_moments(view)
            width = block._width(size.t_re, f0, shrink)
            gauss = _gauss(view.square, width.width)
            weight = view.psf_factor * gauss
            moments.append(self._field_moments(view, size, gauss, weight))
            widths.append(width)
            if inverse_power is not None:
                shared = int(inverse_power.shape[0]) == 1
                inverse = inverse_power if shared else inverse_power[rows, :]
                powers.append(self._power_moments(view.psf_factor, gauss, weight, inverse))
        return joined(moments), joined(widths), joined(powers) if powers else None

    def _view(self, f0: Array, shrink: Array, centroid: Array) -> _View:
        square = array_namespace(f0=f0).matmul(f0, self.grid.squares)
        re, im = self.galaxies.shifted(self.grid, centroid)
        factor, slope = self.weight.psf_factor(square, shrink)
        return _View(square=square, re=re, im=im, psf_factor=factor, psf_slope=slope)

    def _size_moments(self, view: _View) -> _SizeMoments:
        moments = self.grid.moments
        return _SizeMoments(
            t_re=moments(view.psf_factor * view.re, 0, 2),
            t_im=moments(view.psf_factor * view.im, 1, 3),
            dt_re=moments(view.psf_slope * view.re, 2, 4),
        )

    def _field_moments(
        self, view: _View, size: _SizeMoments, gauss: Array, weight: Array
    ) -> _Moments:
        moments, slope = self.grid.moments, view.psf_slope * gauss
        return _Moments(
            t_re=size.t_re,
            t_im=size.t_im,
            dt_re=size.dt_re,
            w_re=moments(weight * view.re, 0, 2, 4),
            w_im=moments(weight * view.im, 1, 3),
            dw_re=moments(slope * view.re, 4),
            dw_im=moments(slope * view.im, 3),
        )

    def _power_moments(
        self, psf_factor: Array, gauss: Array, weight: Array, inverse_power: Array
    ) -> _PowerMoments:
        moments = self.grid.moments
        colour = weight * inverse_power
        return _PowerMoments(
            ww=moments(weight * colour, 0, 2, 4),
            wt=moments(psf_factor * colour, 0, 2, 4),
            tt=moments(psf_factor**2 * inverse_power, 0, 2, 4),
            wg=moments(weight * gauss, 0),
        )

    def _width(self, t_re: Array, f0: Array, shrink: Array) -> _Width:
        """Solve the size equation from the moments of 𝒯 Re I~."""
        xp = array_namespace(t_re=t_re)
        flux, square = t_re[:, 0], contract(t_re[:, 1:], f0)[:, 0]
        if self.fixed_width is not None:
            zero = xp.zeros_like(flux)
            return _Width(width=self.fixed_width, slope=zero, at_bound=zero > 0)
        inverse, positive = inverse_mean_square(flux, square)
        width, slope, at_bound = self.weight.matched_width(inverse, shrink)
        # Of a size that knows nothing of the galaxy there is no slope either.
        slope = xp.where(positive, slope, xp.zeros_like(slope))
        return _Width(width=width, slope=slope, at_bound=at_bound)

    def _matched_width(self, frame: _Frame, moments: _SizeMoments, width: _Width) -> MatchedWidth:
        """Return the width with its derivatives."""
        flux, a2 = moments.t_re[:, 0], moments.t_re[:, 1:]
        square = contract(a2, frame.forms.forms[0])[:, 0]
        if self.fixed_width is not None:
            return MatchedWidth.held(self.fixed_width, flux, square)
        by_ln_square = -width.slope * (flux * _inverse(square))
        by_parameter, by_ln_shrink = self._ln_mean_square_slopes(frame, moments, flux, square)
        # At fixed <k'²> the width goes with s²: it is s² times a function of s² <k'²>.
        explicit = 2.0 * (width.width + by_ln_square)
        return MatchedWidth(
            width=width.width,
            by_parameter=by_ln_square[:, None] * by_parameter,
            by_ln_shrink=explicit + by_ln_square * by_ln_shrink,
            by_ln_square=by_ln_square,
            flux=flux,
            square=square,
            at_bound=width.at_bound,
        )

    def _ln_mean_square_slopes(
        self, frame: _Frame, moments: _SizeMoments, flux: Array, square: Array
    ) -> tuple[Array, Array]:
        """Return the derivatives of `ln<|k'|²>` by (eta1, eta2, x0, y0) and by ln s."""
        xp = array_namespace(flux=flux)
        f0 = frame.forms.forms[0]
        a2, b2, b4 = moments.t_re[:, 1:], moments.dt_re[:, :3], moments.dt_re[:, 3:]
        c1, c3 = moments.t_im[:, :2], moments.t_im[:, 2:]
        inv_flux, inv_square = _inverse(flux)[:, None], _inverse(square)[:, None]
        by_eta = []
        for slopes in frame.forms.slopes:
            square_slope = contract(contract(b4, f0), slopes[0]) + contract(a2, slopes[0])
            by_eta.append(square_slope * inv_square - contract(b2, slopes[0]) * inv_flux)
        # d Re/dx0 = -kx Im.
        by_centroid = c1 * inv_flux - contract(c3, f0) * inv_square
        # d𝒯/dln s = 2 q d𝒯/dq.
        by_ln_shrink = 2.0 * (
            contract(contract(b4, f0), f0) * inv_square - contract(b2, f0) * inv_flux
        )
        return xp.concat([*by_eta, by_centroid], axis=-1), by_ln_shrink[:, 0]

    def _tests(self, frame: _Frame, moments: _Moments, width: Array) -> TestValues:
        """Return the tests and their partial derivatives."""
        xp = array_namespace(width=width)
        w2, w4, b4 = moments.w_re[:, 1:4], moments.w_re[:, 4:], moments.dw_re
        v1, v3, c3 = moments.w_im[:, :2], moments.w_im[:, 2:], moments.dw_im
        # dW/dq = (d𝒯/dq - 𝒯 sigma²/2) exp(-q sigma²/2).
        half = 0.5 * width[:, None]
        by_square4, by_square3 = b4 - half * w4, c3 - half * v3
        f0, f1, f2 = frame.forms.forms

        by_eta = []
        for d0, d1, d2 in frame.forms.slopes:
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


def shrink_factor(eta: Array) -> Array:
    """Return `s = exp(|eta|/2)`, shape (n_gal,)."""
    xp = array_namespace(eta=eta)
    return xp.exp(0.5 * xp.sqrt(eta[:, 0] ** 2 + eta[:, 1] ** 2))


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
