"""From the root of the null tests to a row of the catalog: covariance, flux, S/N, flags."""

from __future__ import annotations

from typing import Final

from fdnt_xp.arrays import Array, array_namespace, device_of
from fdnt_xp.flags import FAILED, Flag
from fdnt_xp.nulltests.dogleg import RootResult, Status, newton_step
from fdnt_xp.nulltests.gradient import ellipticity_gradient
from fdnt_xp.nulltests.tests import NullTests, TestNoise
from fdnt_xp.shapes.results import ShapeResult

_MOST_ELLIPTICAL: Final = 4.0
"""`|eta|` beyond which no root is believed: an axis ratio of 55, thinner than any k grid."""

_STATUS_FLAGS: Final = {
    Status.MAX_ITER: Flag.DID_NOT_CONVERGE,
    Status.STALLED: Flag.DID_NOT_CONVERGE,
    Status.RADIUS_TOO_SMALL: Flag.RADIUS_TOO_SMALL,
    Status.NON_FINITE: Flag.NON_FINITE_RESULT,
}


def describe(
    tests: NullTests,
    root: RootResult,
    *,
    inverse_power: Array,
    noise_per_mode: Array,
    stamp_shape: tuple[int, int],
    flags: Array,
) -> ShapeResult:
    """Return the shapes at the roots of the tests.

    Parameters
    ----------
    tests : NullTests
        Those that were solved.
    root : RootResult
        In `(eta1, eta2, x0/L, y0/L)`.
    inverse_power : array, shape (n_gal or 1, n_k)
        `1/|T|²` inside the disc.
    noise_per_mode : array, shape (n_gal,)
        `n N`: variance of a pixel times the number of pixels of the grid; NaN if unknown.
    stamp_shape : tuple of int
        (ny, nx).
    flags : array, shape (n_gal,), int32
        What is known of each galaxy so far.
    """
    xp = array_namespace(x=root.x)
    eta, centroid = root.x[:, :2], tests.length * root.x[:, 2:]
    noise = tests.noise(eta, centroid, inverse_power)
    eta_cov, regular = _eta_covariance(tests, root, noise)
    flux, variance = noise.flux, noise.flux_variance * noise_per_mode
    known = variance > 0
    snr = flux / xp.sqrt(xp.where(known, variance, xp.ones_like(variance)))
    snr = xp.where(known, snr, xp.full_like(snr, float("nan")))

    ny, nx = stamp_shape
    off_x = xp.abs(centroid[:, 0]) > 0.5 * nx
    off_y = xp.abs(centroid[:, 1]) > 0.5 * ny
    too_elliptical = eta[:, 0] ** 2 + eta[:, 1] ** 2 > _MOST_ELLIPTICAL**2
    reasons = [(flag, root.status == int(status)) for status, flag in _STATUS_FLAGS.items()]
    reasons += [
        (Flag.SINGULAR, root.success & ~regular),
        (Flag.CENTROID_OFF_STAMP, off_x | off_y),
        (Flag.TOO_ELLIPTICAL, root.success & too_elliptical),
        (Flag.NO_SIGNAL, root.success & ~(flux > 0)),
    ]
    clear = flags == xp.bitwise_and(flags, xp.full_like(flags, int(Flag.FINE_GRID)))
    for flag, holds in reasons:
        flags = _raised(flags, flag, clear & holds)
    measured = xp.bitwise_and(flags, xp.full_like(flags, int(FAILED))) == 0
    information = Flag.SIZE_AT_BOUND if tests.fixed_width is None else Flag.SIZE_FIXED
    informed = noise.matched.at_bound if tests.fixed_width is None else measured
    flags = _raised(flags, information, measured & informed)
    middle = (xp.full_like(flux, 0.5 * (nx - 1)), xp.full_like(flux, 0.5 * (ny - 1)))

    def where_measured(values: Array) -> Array:
        """Return the values, NaN where the galaxy has no shape."""
        mask = xp.reshape(measured, (-1,) + (1,) * (values.ndim - 1))
        return xp.where(mask, values, xp.full_like(values, float("nan")))

    return ShapeResult(
        eta=where_measured(eta),
        eg=where_measured(ellipticity_gradient(eta, noise.tests, noise.matched, tests.length)),
        eta_cov=where_measured(eta_cov * noise_per_mode[:, None, None]),
        centroid=where_measured(centroid + xp.stack(middle, axis=-1)),
        size=where_measured(xp.sqrt(noise.matched.width)),
        flux=where_measured(flux),
        snr=where_measured(snr),
        flags=flags,
        n_iter=root.n_eval,
        status=root.status,
    )


def _eta_covariance(tests: NullTests, root: RootResult, noise: TestNoise) -> tuple[Array, Array]:
    """Return `J⁻¹ Cov(f) J⁻ᵀ` of eta for unit noise per mode, and where J is regular.

    The scaled tests are `(t1, t2, tx/L, ty/L)/t0`, and t vanishes at the root: the noise of
    t0 does not matter. Even and odd tests have no common noise.
    """
    xp = array_namespace(x=root.x)
    inverse, regular = [], root.success
    units = xp.eye(4, dtype=root.f.dtype, device=device_of(root.f))
    for j in range(4):
        unit = xp.broadcast_to(units[j, :], root.f.shape)
        solution, solved = newton_step(xp, -unit, root.jac)  # of J p = unit
        inverse.append(solution)
        regular = regular & solved
    # Rows 0 and 1 of J⁻¹, column by column.
    to_eta = xp.stack(inverse, axis=-1)[:, :2, :]
    scale = noise.tests.values[:, 4]
    safe = xp.where(scale > 0, scale, xp.ones_like(scale))[:, None, None]
    even = to_eta[:, :, :2] / safe
    odd = to_eta[:, :, 2:] / (safe * tests.length)
    return _sandwich(even, noise.even) + _sandwich(odd, noise.odd), regular


def _sandwich(a: Array, c: Array) -> Array:
    """Return `A C Aᵀ` for stacks of 2 by 2 matrices, as sums of products."""
    xp = array_namespace(a=a)
    ac = xp.sum(a[:, :, :, None] * c[:, None, :, :], axis=2)
    return xp.sum(ac[:, :, None, :] * a[:, None, :, :], axis=-1)


def _raised(flags: Array, flag: Flag, where: Array) -> Array:
    """Return the flags with one more bit where asked for."""
    xp = array_namespace(flags=flags)
    return xp.where(where, xp.bitwise_or(flags, xp.full_like(flags, int(flag))), flags)
