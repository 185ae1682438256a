"""The search for the root of the null tests: where it starts, how long it may take, its end.

The noise of the tests evaluates them at the solution anyhow. So the last Newton step may be
taken without an evaluation of its own, and looked at afterwards.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

from fdnt_xp.arrays import Array, array_namespace
from fdnt_xp.nulltests.dogleg import (
    DoglegOptions,
    RootProblem,
    RootResult,
    Status,
    default_ftol,
    find_root,
)
from fdnt_xp.nulltests.small_systems import newton_step
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.shapes.centroid import starting_centroid, wide_weight
from fdnt_xp.shapes.job import Job
from fdnt_xp.shear import eta_from_matrix, shear_matrix

FINE_ABOVE: Final = 1.5
"""`|eta|` beyond which the weight, squeezed by `exp(-|eta|/2)`, covers few cells of the k grid."""
COARSE_STEPS: Final = 12
"""Steps of the root finder on the coarse grid: who converges there needs seldom more than 8."""

_PATIENCE: Final = 6
"""Steps without progress, as in a local minimum, after which a galaxy has no shape."""
_NEAR: Final = 0.3
"""Of the root of ftol: a Newton step from there, whose error is a square, meets ftol."""
_LONGEST: Final = 0.01
"""Such a step, in units of eta and of L: a longer one is due to a Jacobian that is no guide."""
_ROUNDING: Final = 10.0
"""Times ftol: largest test after such a step."""


def solve(
    job: Job,
    tests: NullTests,
    side: int,
    known: RootResult | None = None,
    *,
    last_step_free: bool = False,
) -> RootResult:
    """Find the root of the null tests, from one nearby or a round galaxy at its first centroid."""
    centre = starting_centroid(
        tests.grid,
        tests.galaxies,
        wide_weight(job.weight, tests.grid, side),
        job.length,
        reach=0.5 * side,
    )
    start = round_start(centre, job.length)
    return search(tests, start, known, max_iter=job.max_iter, last_step_free=last_step_free)


def round_start(centroid: Array, length: float) -> Array:
    """Return the unknowns of round galaxies at the given centroids (pixels), shape (n_gal, 4)."""
    xp = array_namespace(centroid=centroid)
    return xp.concat([xp.zeros_like(centroid), centroid / length], axis=-1)


def search(
    tests: RootProblem,
    start: Array,
    known: RootResult | None = None,
    *,
    max_iter: int,
    last_step_free: bool = False,
) -> RootResult:
    """Find the root of null tests in `(eta1, eta2, x0/L, y0/L)`.

    Parameters
    ----------
    tests : RootProblem
    start : array, shape (n_gal, 4)
    known : RootResult, optional
        Roots of a coarser grid: where they are, the search starts there.
    max_iter : int
        Steps.
    last_step_free : bool
        Takes the last Newton step without an evaluation; see `looked_at`.
    """
    xp = array_namespace(start=start)
    if known is not None:
        start = xp.where(known.success[:, None], known.x, start)
    ftol = default_ftol(xp, start.dtype)
    if last_step_free:
        ftol = _NEAR * math.sqrt(ftol)
    options = DoglegOptions(
        ftol=ftol, max_iter=max_iter, initial_radius=1.0, max_radius=3.0, patience=_PATIENCE
    )
    root = find_root(tests, start, options=options)
    if not last_step_free:
        return root
    step, _ = newton_step(xp, root.f, root.jac)
    short = root.success & (xp.max(xp.abs(step), axis=-1) <= _LONGEST)
    return replace(root, x=xp.where(short[:, None], root.x + step, root.x))


def looked_at(root: RootResult, f: Array, jac: Array) -> RootResult:
    """Return the roots with the tests evaluated there; those where they do not vanish failed."""
    xp = array_namespace(x=root.x)
    ftol = _ROUNDING * default_ftol(xp, root.x.dtype)
    # Not `>`: the tests may be NaN.
    missed = root.success & ~(xp.max(xp.abs(f), axis=-1) <= ftol)
    status = xp.where(missed, xp.full_like(root.status, int(Status.MAX_ITER)), root.status)
    return replace(root, f=f, jac=jac, status=status)


def squeezed(eta: Array, frame: Array | None) -> Array:
    """Return how much narrower than its disc the weight is on the k grid: ln of the ratio.

    `|eta|` on the pixels' own frame: half by the shrink factor, half by the shear.
    """
    xp = array_namespace(eta=eta)
    norm = xp.sqrt(eta[:, 0] ** 2 + eta[:, 1] ** 2)
    if frame is None:
        return norm
    on_grid = eta_from_matrix(xp.matmul(shear_matrix(eta), frame))
    return 0.5 * (norm + xp.sqrt(on_grid[:, 0] ** 2 + on_grid[:, 1] ** 2))
