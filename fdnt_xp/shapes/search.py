"""The search for the root of the null tests: where it starts, how long it may take, its end.

It starts from the root under a rougher weight, on few of the modes. And it ends early: the
noise of the tests evaluates them at the solution anyhow, so that one Newton step is taken
without an evaluation of its own, and another from there.
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
from fdnt_xp.nulltests.small_systems import largest, newton_step
from fdnt_xp.nulltests.tests import NullTests
from fdnt_xp.shapes.centroid import starting_centroid, wide_weight
from fdnt_xp.shapes.job import Job
from fdnt_xp.shear import eta_from_matrix, shear_matrix

FINE_ABOVE: Final = 1.5
"""`|eta|` beyond which the weight, squeezed by `exp(-|eta|/2)`, covers few cells of the k grid."""
COARSE_STEPS: Final = 20
"""Steps of the root finder on the coarse grid: who converges there needs seldom more than 8."""

_ROUGH_STEPS: Final = 6
"""Steps of the first search, under a weight that ends early."""
_ROUGH_TESTS: Final = 0.01
"""What the tests may be at its end, and the longest step that is taken from there."""
_LONGEST_ROUGH: Final = 0.1
TWO_STEPS_OFF: Final = 3e-4
"""Tests from which two Newton steps make them vanish."""
_PATIENCE: Final = 6
"""Steps without progress, as in a local minimum, after which a galaxy has no shape."""
_NEAR: Final = 0.3
"""Of the root of ftol: a Newton step from there, whose error is a square, meets ftol."""
_LONGEST: Final = 0.01
"""Such a step, in units of eta and of L: a longer one is due to a Jacobian that is no guide."""
_LAST_STEP: Final = 1e-4
"""Longest second step, whose error is about its square; in float32 what its ftol asks for."""
_ROUNDING: Final = 10.0
"""Times ftol: tests that vanish, where a Jacobian is too small for a short step."""


def first_guess(job: Job, tests: NullTests, side: int) -> Array:
    """Return the unknowns of round galaxies at their first centroids; `side` is of the stamps."""
    wide = wide_weight(job.weight, tests.grid, side)
    centre = starting_centroid(tests.grid, tests.galaxies, wide, job.length, reach=0.5 * side)
    return round_start(centre, job.length)


def rough_root(job: Job, tests: NullTests, side: int) -> Array:
    """Return the root under a weight that ends early, or the first guess; shape (n_gal, 4).

    It is cheap to find on few of the modes, and next to that which is wanted.
    """
    if job.rough is None:
        return first_guess(job, tests, side)
    n_k = tests.grid.n_inside(job.rough_kmax)
    rough = replace(
        tests, grid=tests.grid.inner(n_k), galaxies=tests.galaxies.inner(n_k), weight=job.rough
    )
    guess = first_guess(replace(job, weight=job.rough), rough, side)
    few = min(job.max_iter, _ROUGH_STEPS)
    root = stepped(search(rough, guess, max_iter=few, near=_ROUGH_TESTS), _LONGEST_ROUGH)
    xp = array_namespace(guess=guess)
    return xp.where(root.success[:, None], root.x, guess)


def round_start(centroid: Array, length: float) -> Array:
    """Return the unknowns of round galaxies at the given centroids (pixels), shape (n_gal, 4)."""
    xp = array_namespace(centroid=centroid)
    return xp.concat([xp.zeros_like(centroid), centroid / length], axis=-1)


def search(
    tests: RootProblem, start: Array, *, max_iter: int, near: float | None = None
) -> RootResult:
    """Find the root of null tests in `(eta1, eta2, x0/L, y0/L)`.

    Parameters
    ----------
    tests : RootProblem
    start : array, shape (n_gal, 4)
    max_iter : int
        Steps.
    near : float, optional
        What the tests may be at the end of the search; by default they vanish.
    """
    options = DoglegOptions(
        ftol=near, max_iter=max_iter, initial_radius=1.0, max_radius=3.0, patience=_PATIENCE
    )
    return find_root(tests, start, options=options)


def one_step_off(like: Array) -> float:
    """Return the tests from which one Newton step makes them vanish, in the precision of `like`."""
    return _NEAR * math.sqrt(default_ftol(array_namespace(like=like), like.dtype))


def stepped(root: RootResult, longest: float = _LONGEST) -> RootResult:
    """Return roots one Newton step further on, where that is short; the tests are not looked at."""
    xp = array_namespace(x=root.x)
    step, _ = newton_step(xp, root.f, root.jac)
    short = root.success & (largest(xp, step) <= longest)
    return replace(root, x=xp.where(short[:, None], root.x + step, root.x))


def looked_at(root: RootResult, f: Array, jac: Array) -> RootResult:
    """Return the roots one more step on, from tests and Jacobian evaluated there.

    What the step leaves is about the square of what it takes off. Where that is much, and the
    tests do not vanish as they are, there is no success.
    """
    xp = array_namespace(x=root.x)
    ftol = default_ftol(xp, root.x.dtype)
    step, _ = newton_step(xp, f, jac)
    off, length = largest(xp, f), largest(xp, step)
    short = xp.maximum(off, length) <= max(_LAST_STEP, 3.0 * math.sqrt(ftol))
    # Not `>`: the tests may be NaN.
    missed = root.success & ~(short | (off <= _ROUNDING * ftol))
    return replace(
        root,
        x=xp.where((root.success & short)[:, None], root.x + step, root.x),
        f=f,
        jac=jac,
        status=xp.where(missed, xp.full_like(root.status, int(Status.MAX_ITER)), root.status),
    )


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
