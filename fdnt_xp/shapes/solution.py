"""From the root of the null tests to a row of the catalog: covariance, flux, S/N, flags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Protocol

from fdnt_xp.arrays import Array, array_namespace, device_of, has_any, joined
from fdnt_xp.flags import FAILED, Flag
from fdnt_xp.nulltests.dogleg import RootResult, Status
from fdnt_xp.nulltests.gradient import ellipticity_gradient
from fdnt_xp.nulltests.small_systems import inverse
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.nulltests.values import MatchedWidth, TestNoise, TestValues
from fdnt_xp.shapes.results import ShapeResult

_MOST_ELLIPTICAL: Final = 4.0
"""`|eta|` beyond which no root is believed: an axis ratio of 55, thinner than any k grid."""

_STATUS_FLAGS: Final = {
    Status.MAX_ITER: Flag.DID_NOT_CONVERGE,
    Status.STALLED: Flag.DID_NOT_CONVERGE,
    Status.RADIUS_TOO_SMALL: Flag.RADIUS_TOO_SMALL,
    Status.NON_FINITE: Flag.NON_FINITE_RESULT,
}


class SolvedTests(Protocol):
    """What is asked of the tests that were solved; see `NullTests`."""

    @property
    def length(self) -> float:
        """L, the unit of centroids."""

    @property
    def fixed_width(self) -> Array | None:
        """sigma² where it was given."""


@dataclass(frozen=True, kw_only=True)
class SolutionNoise:
    """The noise of the tests and of the flux at a solution, and what they are there.

    Parameters
    ----------
    tests : TestValues
    matched : MatchedWidth
    flux : array, shape (n_gal,)
    covariance : array, shape (n_gal, 4, 4)
        Of (t1, t2, tx, ty), the noise of the size of the weight included; NaN if unknown.
    flux_variance : array, shape (n_gal,)
    """

    tests: TestValues
    matched: MatchedWidth
    flux: Array
    covariance: Array
    flux_variance: Array

    @classmethod
    def of(cls, noise: TestNoise, covariance: Array) -> SolutionNoise:
        """Make it of the covariance of (t1, t2, tx, ty, flux), shape (n_gal, 5, 5)."""
        return cls(
            tests=noise.tests,
            matched=noise.matched,
            flux=noise.flux,
            covariance=covariance[:, :4, :4],
            flux_variance=covariance[:, 4, 4],
        )

    @classmethod
    def concat(cls, parts: Sequence[SolutionNoise]) -> SolutionNoise:
        """Join solutions, at least one, in the order given."""
        return joined(parts)


def white_noise(noise: TestNoise, noise_per_mode: Array) -> SolutionNoise:
    """Return the noise of the tests where that of the image is white.

    Even and odd tests then have none in common.

    Parameters
    ----------
    noise_per_mode : array, shape (n_gal,)
        `n N`: variance of a pixel times the number of pixels of the grid; NaN if unknown.
    """
    xp = array_namespace(even=noise.even)
    zero = xp.zeros_like(noise.even)
    rows = [xp.concat([noise.even, zero], axis=-1), xp.concat([zero, noise.odd], axis=-1)]
    return SolutionNoise(
        tests=noise.tests,
        matched=noise.matched,
        flux=noise.flux,
        covariance=xp.concat(rows, axis=-2) * noise_per_mode[:, None, None],
        flux_variance=noise.flux_variance * noise_per_mode,
    )


def describe(
    tests: NullTests,
    root: RootResult,
    *,
    inverse_power: Array,
    noise_per_mode: Array,
    stamp_shape: tuple[int, int],
    flags: Array,
) -> ShapeResult:
    """Return the shapes at the roots of the tests of images with white noise.

    Parameters
    ----------
    tests, root, stamp_shape, flags
        As `describe_with` has them.
    inverse_power : array, shape (n_gal or 1, n_k)
        `1/|T|²` inside the disc.
    noise_per_mode : array, shape (n_gal,)
        As `white_noise` has it.
    """
    eta, centroid = solution_of(tests, root)
    noise = white_noise(tests.noise(eta, centroid, inverse_power), noise_per_mode)
    return describe_with(tests, root, noise, stamp_shape=stamp_shape, flags=flags)


def solution_of(tests: SolvedTests, root: RootResult) -> tuple[Array, Array]:
    """Return eta and the centroid, pixels from the centre of the stamp, at the roots."""
    return root.x[:, :2], tests.length * root.x[:, 2:]


def describe_with(
    tests: NullTests,
    root: RootResult,
    noise: SolutionNoise,
    *,
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
    noise : SolutionNoise
        At the roots.
    stamp_shape : tuple of int
        (ny, nx).
    flags : array, shape (n_gal,), int32
        What is known of each galaxy so far.
    """
    xp = array_namespace(x=root.x)
    _, centroid = solution_of(tests, root)
    ny, nx = stamp_shape
    off_stamp = (xp.abs(centroid[:, 0]) > 0.5 * nx) | (xp.abs(centroid[:, 1]) > 0.5 * ny)
    result = describe_at_origin(tests, root, noise, off_stamp=off_stamp, flags=flags)
    middle = xp.asarray(
        [0.5 * (nx - 1), 0.5 * (ny - 1)], dtype=root.x.dtype, device=device_of(root.x)
    )
    return replace(result, centroid=result.centroid + middle)


def describe_at_origin(
    tests: SolvedTests, root: RootResult, noise: SolutionNoise, *, off_stamp: Array, flags: Array
) -> ShapeResult:
    """Return the same with centroids from the origin of the tests.

    Parameters
    ----------
    tests : SolvedTests
        Those that were solved: of stamps, or of sums over them.
    root, noise, flags
        As `describe_with` has them.
    off_stamp : array, shape (n_gal,), bool
        Where the centroid is not on the stamp.
    """
    xp = array_namespace(x=root.x)
    eta, centroid = solution_of(tests, root)
    eta_cov, regular = _eta_covariance(tests, root, noise)
    matched = noise.matched
    flux, variance = noise.flux, noise.flux_variance
    known = variance > 0
    snr = flux / xp.sqrt(xp.where(known, variance, xp.ones_like(variance)))
    snr = xp.where(known, snr, xp.full_like(snr, float("nan")))

    too_elliptical = eta[:, 0] ** 2 + eta[:, 1] ** 2 > _MOST_ELLIPTICAL**2
    reasons = [(flag, root.status == int(status)) for status, flag in _STATUS_FLAGS.items()]
    reasons += [
        (Flag.SINGULAR, root.success & ~regular),
        (Flag.CENTROID_OFF_STAMP, off_stamp),
        (Flag.TOO_ELLIPTICAL, root.success & too_elliptical),
        (Flag.NO_SIGNAL, root.success & ~(flux > 0)),
    ]
    clear = flags == xp.bitwise_and(flags, xp.full_like(flags, int(Flag.FINE_GRID | Flag.FILLED)))
    for flag, holds in reasons:
        flags = _raised(flags, flag, clear & holds)
    measured = ~has_any(flags, int(FAILED))
    information = Flag.SIZE_AT_BOUND if tests.fixed_width is None else Flag.SIZE_FIXED
    informed = matched.at_bound if tests.fixed_width is None else measured
    flags = _raised(flags, information, measured & informed)

    def where_measured(values: Array) -> Array:
        """Return the values, NaN where the galaxy has no shape."""
        mask = xp.reshape(measured, (-1,) + (1,) * (values.ndim - 1))
        return xp.where(mask, values, xp.full_like(values, float("nan")))

    return ShapeResult(
        eta=where_measured(eta),
        eg=where_measured(ellipticity_gradient(eta, noise.tests, matched, tests.length)),
        eta_cov=where_measured(eta_cov),
        centroid=where_measured(centroid),
        size=where_measured(xp.sqrt(matched.width)),
        flux=where_measured(flux),
        snr=where_measured(snr),
        flags=flags,
        n_iter=root.n_eval,
        status=root.status,
    )


def _eta_covariance(
    tests: SolvedTests, root: RootResult, noise: SolutionNoise
) -> tuple[Array, Array]:
    """Return `J⁻¹ Cov(f) J⁻ᵀ` of eta, and where J is regular.

    The scaled tests are `(t1, t2, tx/L, ty/L)/t0`, and t vanishes at the root: the noise of
    t0 does not matter.
    """
    xp = array_namespace(x=root.x)
    inverse_jac, regular = inverse(xp, root.jac)
    to_eta = inverse_jac[:, :2, :]
    scale = noise.tests.values[:, 4]
    safe = xp.where(scale > 0, scale, xp.ones_like(scale))[:, None, None]
    to_eta = xp.concat([to_eta[:, :, :2], to_eta[:, :, 2:] / tests.length], axis=-1) / safe
    return sandwich(to_eta, noise.covariance), regular & root.success


def sandwich(a: Array, c: Array) -> Array:
    """Return `A C Aᵀ` for stacks of small matrices, as sums of products."""
    xp = array_namespace(a=a)
    ac = xp.sum(a[:, :, :, None] * c[:, None, :, :], axis=2)
    return xp.sum(ac[:, :, None, :] * a[:, None, :, :], axis=-1)


def _raised(flags: Array, flag: Flag, where: Array) -> Array:
    """Return the flags with one more bit where asked for."""
    xp = array_namespace(flags=flags)
    return xp.where(where, xp.bitwise_or(flags, xp.full_like(flags, int(flag))), flags)
