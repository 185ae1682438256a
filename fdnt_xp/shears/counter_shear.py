"""Statistics of galaxies seen through a trial counter-shear, for the population null.

For a trial shear gamma everything is evaluated at `kappa = S_gamma k`: exactly the galaxies
with gamma taken off. A statistic is a spin-2 quantity of each galaxy in that frame, two
numbers that turn with the image. If gamma is the shear that was applied, the galaxies are
isotropic there and its mean is zero, whatever the PSF and the morphology.

The weight ends at `kmax/reach`, so that its disc, sheared by any `|gamma|` <= 2 ln(reach),
stays where the PSF has left information.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Protocol

from fdnt_xp.arrays import Array, array_namespace, blocks_in_cache, device_of, joined
from fdnt_xp.fourier.grid import KGrid
from fdnt_xp.fourier.sky_grid import SkyGrid
from fdnt_xp.fourier.transform import DeconvolvedStamps
from fdnt_xp.nulltests.dogleg import DoglegOptions, find_root
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.nulltests.weights import Weight
from fdnt_xp.shapes.centroid import DipoleTests
from fdnt_xp.shapes.search import one_step_off, search, stepped
from fdnt_xp.shears.cuts import FrameQuantities
from fdnt_xp.shears.weights import ShapeWeight

_MAX_ITER: Final = 30
_CENTROID_OPTIONS: Final = DoglegOptions(
    ftol=1e-4, max_iter=_MAX_ITER, initial_radius=1.0, max_radius=3.0
)
"""A last step of Newton's, taken on the moments alone, squares what ftol leaves."""


@dataclass(frozen=True, kw_only=True)
class FrameNoise:
    """Noise of the deconvolved images in one frame.

    Parameters
    ----------
    power : array, shape (n_gal or 1, n_k)
        For pixels of variance 1, synthetic noise included.
    variance : array, shape (n_gal,)
        Of the pixels.
    """

    power: Array
    variance: Array


@dataclass(frozen=True, kw_only=True)
class FrameValues:
    """A statistic of each galaxy in one counter-sheared frame.

    Parameters
    ----------
    v : array, shape (n_gal, 2)
        The statistic, of such a sign that it falls as gamma takes shear off; 0 where it
        failed.
    found : array, shape (n_gal,), bool
        Where it did not fail.
    solution : array, shape (n_gal, d)
        Unknowns that were solved, the start of the next frame.
    quantities : FrameQuantities
        What cuts may be made on; NaN where the statistic failed.
    v_variance : array, shape (n_gal, 2), optional
        Of v by the noise of the pixels, the synthetic noise included; 0 where it failed.
        Absent where the noise is unknown or not followed so far.
    """

    v: Array
    found: Array
    solution: Array
    quantities: FrameQuantities
    v_variance: Array | None = None


class Statistic(Protocol):
    """A spin-2 quantity of each galaxy in a counter-sheared frame."""

    @property
    def n_unknown(self) -> int:
        """Unknowns that are solved for each galaxy; the last two are the centroid."""
        ...

    def evaluate(
        self,
        grid: KGrid,
        galaxies: DeconvolvedStamps,
        weight: Weight,
        start: Array,
        noise: FrameNoise | None,
    ) -> FrameValues:
        """Return the statistic on a counter-sheared grid.

        Parameters
        ----------
        grid : KGrid
            `KGrid.sheared(gamma)`.
        galaxies : DeconvolvedStamps
        weight : Weight
            Shrunk by the reach.
        start : array, shape (n_gal, n_unknown)
            A solution in another frame, or a first guess; the centroid in units of `length`.
        noise : FrameNoise, optional
            Of the galaxies in this frame.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class FrozenQuadrupole:
    """The quadrupole of each galaxy under one fixed round weight, over its monopole.

    In the counter-sheared frame, at the centroid where the dipole vanishes::

        v = -(q1, q2) / sqrt(q0² + c² n² + b² (q1² + q2²)),

        q0 = sum W Re I~ |kappa|²,  q1 = sum W Re I~ (kx² - ky²),  q2 = sum W Re I~ 2 kx ky,

    with n the noise of q0, and 0 where the noise is unknown. No shape is solved: eta stays
    0. A galaxy elongated along x is narrow in kx, hence the sign.

    Parameters
    ----------
    size : float
        sigma of the Gaussian part of the weight, pixels: one for the whole sample.
    length : float
        Unit of centroids, pixels.
    softening : float
        c. The larger it is, the less a faint galaxy counts.
    bound : float
        b. The larger it is, the less an elongated galaxy counts: `|v| < 1/b`.
    farthest : float
        Largest distance of a centroid from the middle of the stamp, pixels.
    """

    size: float
    length: float
    softening: float
    bound: float
    farthest: float

    @property
    def n_unknown(self) -> int:
        """The centroid."""
        return 2

    def evaluate(
        self,
        grid: KGrid,
        galaxies: DeconvolvedStamps,
        weight: Weight,
        start: Array,
        noise: FrameNoise | None,
    ) -> FrameValues:
        """Return the statistic on a counter-sheared grid: see `Statistic`."""
        xp = array_namespace(start=start)
        window = weight.round_window(grid, self.size)
        dipole = DipoleTests(grid=grid, galaxies=galaxies, weight=window, length=self.length)
        root = find_root(dipole, start, options=_CENTROID_OPTIONS)
        moments = moments_at(grid, galaxies, window, self.length * root.x)
        distance = self.length * xp.sqrt(xp.sum(root.x**2, axis=-1))
        found = root.success & (moments.monopole > 0) & (distance <= self.farthest)
        square, variance = moments.monopole**2, None
        if noise is not None:
            covariance = moment_covariance(grid.moments(window**2 * noise.power, 4))
            covariance = noise.variance[:, None, None] * covariance
            square = square + self.softening**2 * covariance[:, 2, 2]
        square = square + self.bound**2 * xp.sum(moments.quadrupole**2, axis=-1)
        # Where squares leave the range of numbers, ratios of them mean nothing.
        least = float(xp.finfo(square.dtype).smallest_normal)
        found = found & xp.isfinite(square) & (square > least)
        safe = xp.sqrt(xp.where(found, square, xp.ones_like(square)))
        v = -moments.quadrupole / safe[:, None]
        if noise is not None:
            ratio = moments.monopole / safe
            variance = _or_zero(ratio_variance(covariance, v, ratio, safe, self.bound), found)
        return FrameValues(
            v=_or_zero(v, found),
            found=found,
            solution=xp.where(found[:, None], root.x + moments.step / self.length, start),
            quantities=frame_quantities(grid, window, moments, found, noise),
            v_variance=variance,
        )


@dataclass(frozen=True, kw_only=True)
class FrameMoments:
    """Moments of the galaxies under a fixed window, at the centroid where the dipole vanishes.

    Parameters
    ----------
    flux, monopole : array, shape (n_gal,)
        `sum W Re I~` and `sum W Re I~ |kappa|²`.
    quadrupole : array, shape (n_gal, 2)
        `sum W Re I~ (kx² - ky², 2 kx ky)`.
    step : array, shape (n_gal, 2)
        From where the moments were taken to the centroid, pixels: a step of Newton's, which
        is taken into account to first order.
    """

    flux: Array
    monopole: Array
    quadrupole: Array
    step: Array


def moments_at(
    grid: KGrid, galaxies: DeconvolvedStamps, window: Array, centroid: Array
) -> FrameMoments:
    """Return the moments at the root of the dipole that is next to `centroid` (pixels)."""
    shared = int(window.shape[0]) == 1
    parts = [
        _moments_near(
            grid.take(rows),
            galaxies.take(rows),
            window if shared else window[rows, :],
            centroid[rows, :],
        )
        for rows in blocks_in_cache(galaxies.re)
    ]
    return joined(parts)


def _moments_near(
    grid: KGrid, galaxies: DeconvolvedStamps, window: Array, centroid: Array
) -> FrameMoments:
    """Return the moments of few galaxies."""
    xp = array_namespace(centroid=centroid)
    re, im = galaxies.shifted(grid, centroid)
    flux, xx, xy, yy = _split(grid.moments(window * re, 0, 2))
    (x, y), (xxx, xxy, xyy, yyy) = (_split(m) for m in grid.odd_moments(window * im))
    # d Im/dx0 = kx Re: the Jacobian of the dipole is the matrix of second moments.
    det = xx * yy - xy * xy
    regular = det > 0
    det = xp.where(regular, det, xp.ones_like(det))
    step_x = xp.where(regular, (xy * y - yy * x) / det, xp.zeros_like(det))
    step_y = xp.where(regular, (xy * x - xx * y) / det, xp.zeros_like(det))
    # d Re/dx0 = -kx Im.
    q1 = xx - yy - step_x * (xxx - xyy) - step_y * (xxy - yyy)
    q2 = 2.0 * (xy - step_x * xxy - step_y * xyy)
    q0 = xx + yy - step_x * (xxx + xyy) - step_y * (xxy + yyy)
    return FrameMoments(
        flux=flux,
        monopole=q0,
        quadrupole=xp.stack([q1, q2], axis=-1),
        step=xp.stack([step_x, step_y], axis=-1),
    )


def moment_covariance(quartic: Array) -> Array:
    """Return the covariance of `(q1, q2, q0)` by noise, shape (n, 3, 3); see `FrozenQuadrupole`.

    Parameters
    ----------
    quartic : array, shape (n, 5)
        Moments of degree 4 of `W² V`, with V the noise power: the covariance of two moments
        is the moment of the product of their monomials.
    """
    xp = array_namespace(quartic=quartic)
    xxxx, xxxy, xxyy, xyyy, yyyy = _split(quartic)
    both, first, second = 2.0 * (xxxy - xyyy), xxxx - yyyy, 2.0 * (xxxy + xyyy)
    rows = (
        (xxxx - 2.0 * xxyy + yyyy, both, first),
        (both, 4.0 * xxyy, second),
        (first, second, xxxx + 2.0 * xxyy + yyyy),
    )
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def ratio_variance(covariance: Array, v: Array, ratio: Array, norm: Array, bound: float) -> Array:
    """Return the variance of `v = -q/D`, shape (n_gal, 2); see `FrozenQuadrupole`.

    To first order `D dv = -(dq - b² v (v.dq) + v (q0/D) dq0)`. What the centroid brings in is
    of second order for galaxies that look the same upside down, and left out for all.

    Parameters
    ----------
    covariance : array, shape (n_gal, 3, 3)
        Of (q1, q2, q0).
    v : array, shape (n_gal, 2)
    ratio, norm : array, shape (n_gal,)
        q0/D and D.
    bound : float
        b.
    """
    xp = array_namespace(v=v)
    unit = xp.eye(2, dtype=v.dtype, device=device_of(v))
    by_quadrupole = unit - bound**2 * v[:, :, None] * v[:, None, :]
    by_moment = xp.concat([by_quadrupole, (v * ratio[:, None])[:, :, None]], axis=-1)
    spread = xp.sum(xp.matmul(by_moment, covariance) * by_moment, axis=-1)
    return spread / norm[:, None] ** 2


def frame_quantities(
    grid: KGrid, window: Array, moments: FrameMoments, found: Array, noise: FrameNoise | None
) -> FrameQuantities:
    """Return what cuts may be made on: see `FrameQuantities`."""
    xp = array_namespace(found=found)
    nan = xp.full_like(moments.flux, float("nan"))
    point, xx, _, yy = _split(grid.moments(window, 0, 2))
    if noise is None:
        snr = nan
    else:
        # Half of V is in the real part, and each mode of the half plane counts twice.
        variance = noise.variance * grid.moments(window**2 * noise.power, 0)[:, 0]
        snr = moments.flux / xp.sqrt(variance)
    # A Gaussian of size s under a Gaussian window of size w has <k²> = 2/(s² + w²).
    has_size = found & (moments.flux > 0)
    safe = xp.where(has_size, moments.monopole, xp.ones_like(nan))
    square = 2.0 * (moments.flux / safe - point / (xx + yy))
    size = xp.sqrt(xp.maximum(square, xp.zeros_like(square)))
    return FrameQuantities(
        flux=xp.where(found, moments.flux / point, nan),
        snr=xp.where(found, snr, nan),
        size=xp.where(has_size, size, nan),
    )


@dataclass(frozen=True, kw_only=True)
class SolvedEta:
    """The shape of each galaxy in the counter-sheared frame, `w(|eta|) eta`.

    The five null tests are solved anew in every frame, at `k' = S_eta S_gamma k` with the
    shrink factor `exp(|eta|/2)` that the unlensed galaxy has.

    Parameters
    ----------
    weight : ShapeWeight
        w.
    length : float
        Unit of centroids, pixels.
    size : float, optional
        Fixes sigma of the Gaussian part of the weight, pixels.
    window_size : float
        The same of the fixed round weight under which the quantities of cuts are measured.
    """

    weight: ShapeWeight
    length: float
    size: float | None
    window_size: float

    @property
    def n_unknown(self) -> int:
        """Shape and centroid."""
        return 4

    def evaluate(
        self,
        grid: KGrid,
        galaxies: DeconvolvedStamps,
        weight: Weight,
        start: Array,
        noise: FrameNoise | None,
    ) -> FrameValues:
        """Return the statistic on a counter-sheared grid: see `Statistic`."""
        xp = array_namespace(start=start)
        column = start[:, 0]
        # Through Jacobians it is the weight that knows the frame: centroids on the stamp then.
        plain = grid.plain if isinstance(grid, SkyGrid) else grid
        start = in_new_frame(start, grid, plain) if plain is not grid else start
        tests = NullTests(
            grid=plain,
            galaxies=galaxies,
            weight=weight,
            length=self.length,
            fixed_width=None if self.size is None else xp.full_like(column, self.size**2),
        )
        near = one_step_off(start)
        root = stepped(search(tests, start, max_iter=_MAX_ITER, near=near))
        if plain is not grid:
            root = replace(root, x=in_new_frame(root.x, plain, grid))
            start = in_new_frame(start, plain, grid)
        found = root.success
        eta = _or_zero(root.x[:, :2], found)
        abs_eta = xp.sqrt(eta[:, 0] ** 2 + eta[:, 1] ** 2)
        v = self.weight(abs_eta)[:, None] * eta
        window = weight.round_window(grid, self.window_size)
        moments = moments_at(grid, galaxies, window, self.length * root.x[:, 2:])
        return FrameValues(
            v=_or_zero(v, found),
            found=found,
            solution=xp.where(found[:, None], root.x, start),
            quantities=frame_quantities(grid, window, moments, found, noise),
        )


def in_new_frame(solution: Array, old: KGrid, new: KGrid) -> Array:
    """Return solutions with their centroids carried from one frame to another."""
    xp = array_namespace(solution=solution)
    centroid = new.from_stamp(old.on_stamp(solution[:, -2:]))
    return xp.concat([solution[:, :-2], centroid], axis=-1)


def _or_zero(v: Array, found: Array) -> Array:
    xp = array_namespace(v=v)
    return xp.where(found[:, None], v, xp.zeros_like(v))


def _split(moments: Array) -> tuple[Array, ...]:
    return tuple(moments[:, j] for j in range(int(moments.shape[1])))
