"""The population null: the shear is the counter-shear under which the mean shape vanishes.

No responsivity enters, no ellipticity gradient, no calibration. Counter-shearing is exact
in Fourier space; at the true shear the galaxies are isotropic again, and any spin-2
quantity of them has zero mean (docs, "The population null").
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Final, Literal

from fdnt_xp.arrays import Array, array_namespace, device_of
from fdnt_xp.errors import FdntValueError, RangeError
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.fourier.transform import deconvolve
from fdnt_xp.shapes.centroid import starting_centroid, wide_weight
from fdnt_xp.shapes.job import (
    Job,
    check_options,
    check_stamps,
    galaxies_at_once,
    prepare,
    screen,
)
from fdnt_xp.shear import reduced_shear_from_eta
from fdnt_xp.shears.counter_shear import (
    FrozenQuadrupole,
    SolvedEta,
    Statistic,
    in_new_frame,
)
from fdnt_xp.shears.estimate import ShearEstimate
from fdnt_xp.shears.weights import ShapeWeight

_STEP: Final = 0.02
"""Step in gamma of the numerical response: far above the solver's noise, and its error,
of second order in the step, changes the speed of the search, not its root."""
_MAX_STEPS: Final = 12
_TOLERANCE: Final = 1e-9
_TOLERANCE_FLOAT32: Final = 2e-5
"""Smallest step in gamma worth taking: above the rounding of each galaxy's solution."""
_LARGEST_SHEAR: Final = 0.3
"""`|g|` beyond which the weight's disc would have to shrink to less than three quarters."""
_FROZEN_SIZE: Final = 1.5
"""Default size of the frozen weight in lengths of about the size of the PSF."""
_JACKKNIFE_GROUPS: Final = 50


def population_null(
    stamps: Array,
    psf: Psf,
    *,
    statistic: Literal["frozen", "eta"] = "frozen",
    weight: ShapeWeight | None = None,
    size: float | None = None,
    max_shear: float = 0.1,
    padding: int = 1,
    chunk_size: int | None = None,
) -> ShearEstimate:
    """Estimate the shear of a population by the counter-shear that nulls its mean shape.

    Parameters
    ----------
    stamps : array, shape (n_gal, ny, nx)
        Images of one galaxy each, as for `measure_shapes`.
    psf : Psf
        One for all stamps, or one for each.
    statistic : {"frozen", "eta"}
        "frozen": the normalised quadrupole of each galaxy under one fixed round weight in
        the counter-sheared frame; only the centroid is solved. "eta": the shape of each
        galaxy, solved anew in every frame.
    weight : ShapeWeight, optional
        `w(|eta|)` that bounds the influence of elongated galaxies; for "eta" alone. Uniform
        by default.
    size : float, optional
        sigma of the Gaussian part of the weight, pixels. Of the "frozen" weight by default
        about 1.5 times the size of the PSF, one for the whole sample; for "eta" by default
        matched to each galaxy.
    max_shear : float
        Largest `|g|` in reach. The weight's disc is smaller than the PSF's by
        `sqrt((1 + max_shear)/(1 - max_shear))`, which costs resolution.
    padding, chunk_size : int
        As for `measure_shapes`.

    Returns
    -------
    ShearEstimate
        With `g_err` from the influence function and `g_err_jackknife` from leaving out 50
        groups of neighbouring rows in turn. Galaxies for which the statistic fails count
        as zero, which is a spin-2 quantity too, and are reported in `n_excluded`.

    Raises
    ------
    FdntValueError
        If fewer than two galaxies can be used, or no null lies within `max_shear`.
    RangeError
        If a number is out of range; `max_shear` may be at most 0.3.
    FdntTypeError, NamespaceError, ShapeMismatchError
        As for `measure_shapes`.

    Notes
    -----
    Newton's method in the two components, with a response by differences at the start that
    each step improves (Broyden). The sample is evaluated six to eight times. Exact for
    noise-free images; noise is not isotropic in the counter-sheared frame and biases the
    result by about `4/(S/N)²` (relative).
    """
    xp, stamps = check_stamps(stamps, psf)
    check_options(size=size, padding=padding, chunk_size=chunk_size)
    if not 0.0 < max_shear <= _LARGEST_SHEAR:
        raise RangeError("max_shear", max_shear, 0.0, _LARGEST_SHEAR)
    if statistic not in ("frozen", "eta"):
        raise FdntValueError(f'statistic must be "frozen" or "eta", not {statistic!r}')
    if weight is not None and statistic == "frozen":
        raise FdntValueError('weight goes with statistic="eta"; "frozen" is bounded by itself')
    if int(stamps.shape[0]) < 2:
        raise FdntValueError(f"stamps holds {stamps.shape[0]} galaxies; a null needs two")
    job = prepare(xp, stamps, psf, padding, size, 0)
    chosen: Statistic
    if statistic == "frozen":
        fixed = _FROZEN_SIZE * job.length if size is None else size
        chosen = FrozenQuadrupole(size=fixed, length=job.length)
    else:
        uniform = weight or ShapeWeight.uniform()
        chosen = SolvedEta(weight=uniform, length=job.length, size=size)
    sample = _Sample(
        stamps=stamps,
        job=job,
        statistic=chosen,
        reach=math.sqrt((1.0 + max_shear) / (1.0 - max_shear)),
        chunk_size=chunk_size or galaxies_at_once(job.coarse, stamps),
    )
    return _estimate(xp, sample, max_shear, f"population null, {statistic}")


@dataclass(kw_only=True)
class _Sample:
    """The statistic of a sample in any frame, chunk by chunk; remembers the last solutions.

    `solutions` and their `frame` are the only state: the starting point of the next frame.
    """

    stamps: Array
    job: Job
    statistic: Statistic
    reach: float
    chunk_size: int
    solutions: list[Array] | None = None
    frame: Array | None = None

    def evaluate(self, gamma: Array) -> tuple[Array, Array]:
        """Return the statistic of each galaxy, (n_gal, 2), and where it was found, at gamma."""
        xp = array_namespace(gamma=gamma)
        data_grid = self.job.coarse
        grid = data_grid.sheared(gamma)
        old = data_grid if self.frame is None else data_grid.sheared(self.frame)
        values, found, solutions = [], [], []
        n_gal = int(self.stamps.shape[0])
        for i, first in enumerate(range(0, n_gal, self.chunk_size)):
            rows = slice(first, min(first + self.chunk_size, n_gal))
            job = self.job.rows(rows)
            stamps, flags = screen(self.stamps[rows, :, :], job.psf)
            galaxies = deconvolve(stamps, job.psf.inverse_transfer(data_grid), data_grid)
            if self.solutions is None:
                wide = wide_weight(job.weight, data_grid, min(self.stamps.shape[1:]))
                centre = starting_centroid(
                    data_grid, galaxies, wide, job.length, reach=0.5 * min(stamps.shape[1:])
                )
                zeros = [xp.zeros_like(centre)] * (self.statistic.n_unknown // 2 - 1)
                start = xp.concat([*zeros, centre / job.length], axis=-1)
            else:
                start = self.solutions[i]
            start = in_new_frame(start, old, grid)
            result = self.statistic.evaluate(grid, galaxies, job.weight.shrunk(self.reach), start)
            usable = result.found & (flags == 0)
            values.append(xp.where(usable[:, None], result.v, xp.zeros_like(result.v)))
            found.append(usable)
            solutions.append(result.solution)
        self.solutions, self.frame = solutions, gamma
        return xp.concat(values, axis=0), xp.concat(found, axis=0)


def _estimate(xp: ModuleType, sample: _Sample, max_shear: float, method: str) -> ShearEstimate:
    """Find the null and its errors."""
    like = {"dtype": sample.stamps.dtype, "device": device_of(sample.stamps)}
    origin = xp.zeros((2,), **like)
    v, found = sample.evaluate(origin)
    n_used = int(xp.sum(xp.astype(found, xp.int64)))
    if n_used < 2:
        raise FdntValueError(
            f"only {n_used} of {int(found.shape[0])} galaxies can be used; a null needs two"
        )
    steps = xp.eye(2, **like) * _STEP
    responses = [(sample.evaluate(steps[j, :])[0] - v) / _STEP for j in (0, 1)]
    response = xp.stack(responses, axis=-1)  # (n_gal, 2, 2), by gamma in the last axis

    def mean(gamma: tuple[float, float]) -> tuple[float, float]:
        nonlocal v, found
        v, found = sample.evaluate(xp.asarray(gamma, **like))
        return _pair(xp.mean(v, axis=0))

    slope = xp.mean(response, axis=0)
    jac = [_pair(slope[0, :]), _pair(slope[1, :])]
    gamma = find_null(
        mean,
        _pair(xp.mean(v, axis=0)),
        jac,
        largest=2.0 * math.atanh(max_shear),
        tolerance=_TOLERANCE if sample.stamps.dtype == xp.float64 else _TOLERANCE_FLOAT32,
    )
    conformal = xp.asarray(gamma, **like)
    errors = _errors(xp, v, response)
    # dg/dgamma = 1/2 to first order; the exact factor along gamma differs by |g|² at most.
    g = reduced_shear_from_eta(conformal)
    n_used = int(xp.sum(xp.astype(found, xp.int64)))
    return ShearEstimate(
        g=g,
        g_err=0.5 * errors[0],
        n_used=n_used,
        method=method,
        n_excluded=int(found.shape[0]) - n_used,
        g_err_jackknife=0.5 * errors[1],
    )


def find_null(
    mean: Callable[[tuple[float, float]], tuple[float, float]],
    at_zero: tuple[float, float],
    jac: list[tuple[float, float]],
    *,
    largest: float,
    tolerance: float,
) -> tuple[float, float]:
    """Find the gamma at which a mean of two components vanishes, from gamma = 0.

    Parameters
    ----------
    mean : callable
        From gamma to the mean.
    at_zero : tuple of float
        Its value at 0.
    jac : list of 2 tuples
        Its derivative at 0, rows by component of the mean.
    largest : float
        Largest `|gamma|` that may be asked for.
    tolerance : float
        A step smaller than this ends the search.

    Raises
    ------
    FdntValueError
        If the response is singular, the search leaves the range, or does not end.
    """
    (a, b), (c, d) = jac
    x, y = 0.0, 0.0
    f1, f2 = at_zero
    for _ in range(_MAX_STEPS):
        det = a * d - b * c
        if not (math.isfinite(det) and abs(det) > 1e-12 * (a * a + b * b + c * c + d * d)):
            raise FdntValueError("the sample's mean shape does not respond to shear")
        sx, sy = -(d * f1 - b * f2) / det, -(a * f2 - c * f1) / det
        if math.hypot(sx, sy) < tolerance:
            return x + sx, y + sy
        x, y = x + sx, y + sy
        if not math.hypot(x, y) <= largest:
            raise FdntValueError(
                f"no null within max_shear: the search went to |g| = "
                f"{math.tanh(0.5 * math.hypot(x, y)):.3g}, allowed is "
                f"{math.tanh(0.5 * largest):.3g}; raise max_shear if so large a shear is meant"
            )
        f1, f2 = mean((x, y))
        # Broyden: the least change of the response that explains the value just seen. What
        # the linear model left over is f itself, since the step was Newton's.
        size = sx * sx + sy * sy
        a, b = a + f1 * sx / size, b + f1 * sy / size
        c, d = c + f2 * sx / size, d + f2 * sy / size
    raise FdntValueError(f"no null found in {_MAX_STEPS} steps")


def _errors(xp: ModuleType, v: Array, response: Array) -> tuple[Array, Array]:
    """Return the standard errors of gamma: by influence, and by jackknife over groups.

    The influence of a galaxy is `-R⁻¹ v`, R the mean response. A jackknife sample has its
    own response, so the two differ by terms of order 1/n_gal.
    """
    n_gal = int(v.shape[0])
    influence = _solve_pair(xp, xp.mean(response, axis=0)[None, :, :], v)
    scatter = influence - xp.mean(influence, axis=0)
    by_influence = xp.sqrt(xp.sum(scatter**2, axis=0) / (n_gal * (n_gal - 1.0)))

    n_group = min(_JACKKNIFE_GROUPS, n_gal)
    edges = [round(j * n_gal / n_group) for j in range(n_group + 1)]
    total_v, total_r = xp.sum(v, axis=0), xp.sum(response, axis=0)
    left_v, left_r = [], []
    for lo, hi in itertools.pairwise(edges):
        left_v.append(total_v - xp.sum(v[lo:hi, :], axis=0))
        left_r.append(total_r - xp.sum(response[lo:hi, :, :], axis=0))
    estimates = _solve_pair(xp, xp.stack(left_r), xp.stack(left_v))
    scatter = estimates - xp.mean(estimates, axis=0)
    return by_influence, xp.sqrt(xp.sum(scatter**2, axis=0) * ((n_group - 1.0) / n_group))


def _solve_pair(xp: ModuleType, matrix: Array, vector: Array) -> Array:
    """Return `-M⁻¹ v` for stacks of 2 by 2 matrices; shape (n, 2)."""
    a, b = matrix[:, 0, 0], matrix[:, 0, 1]
    c, d = matrix[:, 1, 0], matrix[:, 1, 1]
    v1, v2 = vector[:, 0], vector[:, 1]
    return xp.stack([b * v2 - d * v1, c * v1 - a * v2], axis=-1) / (a * d - b * c)[:, None]


def _pair(vector: Array) -> tuple[float, float]:
    return float(vector[0]), float(vector[1])
