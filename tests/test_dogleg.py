"""The batched dogleg: known systems, MINPACK's hybrj, and what a batch must not do."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise

import numpy as np
import pytest
from array_api_extra.testing import assert_close, assert_equal
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import root

from fdnt_xp.arrays import Array, array_namespace, device_of
from fdnt_xp.errors import (
    FdntTypeError,
    FdntValueError,
    NamespaceError,
    RangeError,
    ShapeMismatchError,
)
from fdnt_xp.nulltests.dogleg import DoglegOptions, RootResult, Status, find_root, status_text
from tolerances import tolerance

FIELDS = [f.name for f in fields(RootResult)]


# --- systems of equations ------------------------------------------------------------
# Each takes the unknowns, arrays of shape (n,), and returns the rows of f and of df/dx.


def rosenbrock(a, b):
    zero = 0.0 * a
    return [10.0 * (b - a * a), 1.0 - a], [[-20.0 * a, zero + 10.0], [zero - 1.0, zero]]


def freudenstein_roth(a, b):
    one = 0.0 * a + 1.0
    f = [a - 13.0 + ((5.0 - b) * b - 2.0) * b, a - 29.0 + ((b + 1.0) * b - 14.0) * b]
    return f, [[one, 10.0 * b - 3.0 * b * b - 2.0], [one, 3.0 * b * b + 2.0 * b - 14.0]]


def powell_badly_scaled(a, b):
    xp = array_namespace(a=a)
    ea, eb = xp.exp(-a), xp.exp(-b)
    return [1e4 * a * b - 1.0, ea + eb - 1.0001], [[1e4 * b, 1e4 * a], [-ea, -eb]]


def powell_hybrid(a, b):
    # Powell 1970: Newton with a line search stops short of the root, at a singular Jacobian.
    near = a + 0.1
    f = [a, 10.0 * a / near + 2.0 * b * b]
    return f, [[0.0 * a + 1.0, 0.0 * a], [1.0 / (near * near), 4.0 * b]]


def powell_singular(a, b, c, d):
    zero = 0.0 * a
    p, q, r = math.sqrt(5.0), b - 2.0 * c, math.sqrt(10.0)
    f = [a + 10.0 * b, p * (c - d), q * q, r * (a - d) ** 2]
    first = [zero + 1.0, zero + 10.0, zero, zero]
    second = [zero, zero, zero + p, zero - p]
    third = [zero, 2.0 * q, -4.0 * q, zero]
    return f, [first, second, third, [2.0 * r * (a - d), zero, zero, -2.0 * r * (a - d)]]


def helical_valley(a, b, c):
    xp = array_namespace(a=a)
    zero, square = 0.0 * a, a * a + b * b
    radius, turn = xp.sqrt(square), xp.atan2(b, a) / (2.0 * math.pi)
    per = 100.0 / (2.0 * math.pi) / square
    f = [10.0 * (c - 10.0 * turn), 10.0 * (radius - 1.0), c]
    second = [10.0 * a / radius, 10.0 * b / radius, zero]
    return f, [[per * b, -per * a, zero + 10.0], second, [zero, zero, zero + 1.0]]


def broyden_tridiagonal(*x):
    zero, d = 0.0 * x[0], len(x)
    padded = [zero, *x, zero]
    f = [(3.0 - 2.0 * x[i]) * x[i] - padded[i] - 2.0 * padded[i + 2] + 1.0 for i in range(d)]
    jac = [[zero] * d for _ in range(d)]
    for i in range(d):
        jac[i][i] = 3.0 - 4.0 * x[i]
        if i > 0:
            jac[i][i - 1] = zero - 1.0
        if i < d - 1:
            jac[i][i + 1] = zero - 2.0
    return f, jac


def brown_almost_linear(*x):
    d, zero = len(x), 0.0 * x[0]
    others = [math.prod(x[:i] + x[i + 1 :]) for i in range(d)]
    f = [x[i] + sum(x) - (d + 1.0) for i in range(d - 1)] + [math.prod(x) - 1.0]
    return f, [[zero + 1.0 + (i == j) for j in range(d)] for i in range(d - 1)] + [others]


def products(a, b):
    # The Jacobian is singular where a = 0; the root is (2, 1).
    return [a * a - 4.0, a * b - 2.0], [[2.0 * a, 0.0 * a], [b, a]]


def logarithm(a):
    xp = array_namespace(a=a)
    inside = a > 0.0
    safe = xp.where(inside, a, xp.ones_like(a))
    return [xp.where(inside, xp.log(safe), math.nan * xp.ones_like(a))], [[1.0 / safe]]


@dataclass
class Equations:
    """`scale * (system(x) - data)`; `sizes` records the batch length of each evaluation."""

    system: Callable
    data: Array
    scale: float = 1.0
    sizes: list[int] = field(default_factory=list)

    def evaluate(self, x):
        xp = array_namespace(x=x)
        assert x.shape == self.data.shape, "x and the rows of the problem go apart"
        self.sizes.append(x.shape[0])
        f, jac = self.system(*(x[:, j] for j in range(x.shape[1])))
        jac = xp.stack([xp.stack(row, axis=-1) for row in jac], axis=-2)
        return self.scale * (xp.stack(f, axis=-1) - self.data), self.scale * jac

    def take(self, rows):
        xp = array_namespace(rows=rows)
        return replace(self, data=xp.take(self.data, rows, axis=0))


def search(problem, x0, **options):
    return find_root(problem, x0, options=DoglegOptions(**options))


def solve(system, x0, data=None, scale=1.0, **options):
    data = 0.0 * x0 if data is None else data
    return search(Equations(system, data, scale), x0, **options)


def assert_same(actual, expected, to_np, names=FIELDS):
    """Compare to the bit, NaN equal to NaN."""
    for name in names:
        pair = to_np(getattr(actual, name)), to_np(getattr(expected, name))
        np.testing.assert_array_equal(*pair, err_msg=name)


ROWS = 12
"""Starts of `batch`: from near the root to far away, so that rows end at many times."""


def batch(to_xp, dtype, system=rosenbrock):
    rng = np.random.default_rng(5)
    x0 = rng.normal(size=(ROWS, 2)) * np.linspace(0.1, 3.0, ROWS)[:, None]
    data = rng.normal(size=(ROWS, 2))
    return Equations(system, to_xp(data, dtype)), to_xp(x0, dtype)


# --- one batch with every status -----------------------------------------------------

ZOO = {
    # x0, data, and how it must end
    "cube root": (1.0, 2.0, Status.CONVERGED, None),
    "root at the start": (0.0, 0.0, Status.CONVERGED, 0),
    "triple root far away": (50.0, 0.0, Status.MAX_ITER, 12),
    "wall": (0.0, -1.0, Status.RADIUS_TOO_SMALL, 3),
    "flat bottom": (0.0, -1.0, Status.STALLED, 1),
    "NaN at the start": (math.nan, 1.0, Status.NON_FINITE, 0),
    "infinite at the start": (1.0, math.inf, Status.NON_FINITE, 0),
}
ZOO_OPTIONS = {"max_iter": 12, "min_radius": 2e-3}


@dataclass
class Zoo:
    kind: Array
    data: Array

    def evaluate(self, x):
        xp = array_namespace(x=x)
        cube, slope = x * x * x, 3.0 * x * x
        wall, bottom = self.kind == 1.0, self.kind == 2.0
        beyond = math.nan * xp.ones_like(x)
        f = xp.where(bottom, x * x, xp.where(wall, xp.where(x < 0.0, beyond, x), cube))
        jac = xp.where(bottom, 2.0 * x, xp.where(wall, xp.ones_like(x), slope))
        return f - self.data, jac[..., None]

    def take(self, rows):
        xp = array_namespace(rows=rows)
        return Zoo(xp.take(self.kind, rows, axis=0), xp.take(self.data, rows, axis=0))


@pytest.fixture
def zoo(to_xp, dtype):
    kinds = [[{"wall": 1.0, "flat bottom": 2.0}.get(name, 0.0)] for name in ZOO]
    problem = Zoo(to_xp(kinds, dtype), to_xp([[row[1]] for row in ZOO.values()], dtype))
    return problem, to_xp([[row[0]] for row in ZOO.values()], dtype)


def test_every_status_in_one_batch(zoo, xp, dtype, to_np):
    result = search(*zoo, **ZOO_OPTIONS)
    expected = [row[2] for row in ZOO.values()]
    assert [Status(int(code)) for code in to_np(result.status)] == expected
    assert {*expected, Status.RUNNING} == set(Status)
    assert to_np(result.success).tolist() == [status == Status.CONVERGED for status in expected]
    for n_iter, row in zip(to_np(result.n_iter).tolist(), ZOO.values(), strict=True):
        assert row[3] is None or n_iter == row[3]
    np.testing.assert_array_equal(to_np(result.n_eval), to_np(result.n_iter) + 1)
    expected = xp.full_like(result.x[0, :], 2.0 ** (1.0 / 3.0))
    assert_close(result.x[0, :], expected, **tolerance("default", dtype), xp=xp)


def test_every_field_lives_where_x0_does(zoo, xp, dtype, device):
    result = search(*zoo, **ZOO_OPTIONS)
    for name in FIELDS:
        value = getattr(result, name)
        assert array_namespace(value=value) is array_namespace(x0=zoo[1])
        assert device_of(value) == device
        assert value.dtype == (xp.int32 if name[0] in "sn" else dtype), name
    n = len(ZOO)
    shapes = [getattr(result, name).shape for name in FIELDS]
    assert shapes == [(n, 1), (n, 1), (n, 1, 1), (n,), (n,), (n,), (n,)]
    assert result.success.dtype == xp.bool


def test_a_failed_row_holds_its_best_point(zoo, to_np):
    problem, x0 = zoo
    result = search(problem, x0, **ZOO_OPTIONS)
    f, jac = problem.evaluate(result.x)
    np.testing.assert_array_equal(to_np(result.f), to_np(f))
    np.testing.assert_array_equal(to_np(result.jac), to_np(jac))
    fixed = [i for i, name in enumerate(ZOO) if name not in ("cube root", "triple root far away")]
    np.testing.assert_array_equal(to_np(result.x)[fixed], to_np(x0)[fixed])
    far = list(ZOO).index("triple root far away")
    assert 0.0 < to_np(result.x)[far, 0] < 50.0


def test_status_text():
    texts = [status_text(status) for status in Status]
    assert len(set(texts)) == len(Status)
    assert status_text(int(Status.RADIUS_TOO_SMALL)) == "trust region shrank to nothing"
    with pytest.raises(ValueError, match="99"):
        status_text(99)


# --- against MINPACK -----------------------------------------------------------------

HARD = {
    # system: standard start, spread of the others, most trial steps from the standard start,
    # tolerance of a root (loose where the Jacobian vanishes there)
    rosenbrock: ([-1.2, 1.0], 3.0, 16, 1e-9),
    freudenstein_roth: ([6.0, 5.0], 1.0, 6, 1e-9),
    powell_badly_scaled: ([0.0, 1.0], 0.5, 45, 1e-6),
    powell_hybrid: ([3.0, 1.0], 0.3, 25, 1e-4),
    powell_singular: ([3.0, -1.0, 0.0, 1.0], 1.0, 25, 1e-5),
    helical_valley: ([-1.0, 0.0, 0.0], 0.5, 12, 1e-9),
    broyden_tridiagonal: ([-1.0] * 5, 0.5, 6, 1e-9),
    brown_almost_linear: ([0.5] * 5, 0.1, 8, 1e-9),
}


def hybrj(system, start):
    """Return the root that MINPACK finds, and whether |f| is small there."""

    def equations(x):
        f, jac = Equations(system, np.zeros((1, len(x)))).evaluate(x[None])
        return f[0], jac[0]

    # `success` also asks for a relative error of x, which a root at 0 does not grant.
    solution = root(equations, start, jac=True, method="hybr", tol=1e-13)
    return solution.x, np.max(np.abs(solution.fun)) < 1e-10


@pytest.mark.parametrize("system", HARD, ids=lambda s: s.__name__)
def test_hybrj_finds_the_same_roots(system):
    start, spread, n_iter, atol = HARD[system]
    rng = np.random.default_rng(11)
    x0 = np.array(start) + spread * rng.normal(size=(25, len(start)))
    x0[0] = start
    ours = solve(system, x0, max_iter=200)
    assert np.all(ours.success)
    assert np.all(np.abs(ours.f) <= 1e-11)
    assert ours.n_iter[0] <= n_iter
    theirs = [x for x, found in (hybrj(system, row) for row in x0) if found]
    assert len(theirs) > 20
    # Some systems have two roots, and the two methods may differ in the one they reach.
    distance = np.max(np.abs(ours.x[:, None, :] - np.array(theirs)), axis=-1)
    assert np.max(np.min(distance, axis=1)) < atol
    assert np.max(np.min(distance, axis=0)) < atol


def test_a_local_minimum_is_no_root():
    # Freudenstein & Roth: from the standard start of minimisers |f|² sticks at 48.98.
    result = solve(freudenstein_roth, np.array([[0.5, -2.0]]), max_iter=200)
    assert Status(int(result.status[0])) is Status.STALLED
    np.testing.assert_allclose(result.x, [[11.4128, -0.8968]], atol=1e-4)
    assert np.sum(result.f**2) == pytest.approx(48.9843, abs=1e-4)


def test_patience_ends_a_crawl_and_nothing_else():
    start = np.array([[0.5, -2.0], [5.5, 4.5]])  # of the local minimum, and of the root
    plain = solve(freudenstein_roth, start, max_iter=200)
    patient = solve(freudenstein_roth, start, max_iter=200, patience=3)
    assert [Status(int(code)) for code in patient.status] == [Status.STALLED, Status.CONVERGED]
    np.testing.assert_allclose(np.sum(patient.f[0] ** 2), 48.9843, rtol=0.02)
    assert patient.n_iter[0] < plain.n_iter[0]
    assert_same(patient.take(np.array([1])), plain.take(np.array([1])), np.asarray)


@pytest.mark.parametrize("system", [freudenstein_roth, broyden_tridiagonal])
def test_on_every_library(system, xp, dtype, to_xp, to_np):
    start, _, n_iter, _ = HARD[system]
    result = solve(system, to_xp([start], dtype))
    assert to_np(result.success).tolist() == [True]
    assert int(result.n_iter[0]) <= n_iter
    expected = to_xp(hybrj(system, np.array(start))[0][None], dtype)
    assert_close(result.x, expected, **tolerance("default", dtype), xp=xp)


def test_convergence_is_quadratic():
    # The digits double. (A linear rate of 0.1 would miss the bound below a = 0.02.)
    x0, errors = np.array([[5.02, 4.02]]), []
    for n in range(6):
        result = solve(freudenstein_roth, x0, max_iter=n, ftol=0.0)
        errors.append(float(np.max(np.abs(result.x - [5.0, 4.0]))))
    pairs = [(a, b) for a, b in pairwise(errors) if b > 1e-14]
    assert len(pairs) >= 2
    assert all(b < 4.0 * a * a for a, b in pairs)
    assert errors[-1] < 1e-14


# --- steps ---------------------------------------------------------------------------


@pytest.mark.parametrize("d", [1, 2, 6])
def test_linear_systems_take_one_step(d, xp, dtype, to_xp, to_np):
    rng = np.random.default_rng(d)
    matrix, b = rng.normal(size=(d, d)) + np.eye(d) * 3.0, rng.normal(size=(1, d))
    matrix = matrix[::-1] * np.logspace(0, 3, d)[:, None]  # pivots off the diagonal, odd scales

    def linear(*x):
        zero = 0.0 * x[0]
        f = [sum(float(m) * column for m, column in zip(row, x, strict=True)) for row in matrix]
        return f, [[zero + float(m) for m in row] for row in matrix]

    x0 = to_xp(rng.normal(size=(1, d)), dtype)
    ftol = 1e3 * (2e-14 if dtype == xp.float64 else 1e-5)
    result = solve(linear, x0, to_xp(b, dtype), initial_radius=50.0, ftol=ftol)
    assert to_np(result.n_iter).tolist() == [1]
    assert to_np(result.radius).tolist() == [50.0]  # which held nothing back
    expected = to_xp(np.linalg.solve(matrix, b.T).T, dtype)
    assert_close(result.x, expected, rtol=0, atol=1e-12 if dtype == xp.float64 else 1e-4, xp=xp)


def test_a_singular_start_takes_the_cauchy_step(xp, dtype, to_xp):
    # At (0, 1): f = (-4, -2), J = [[0, 0], [1, 0]]; the Cauchy step (2, 0) lands on the root.
    x0 = to_xp([[0.0, 1.0]], dtype)
    whole = solve(products, x0, max_iter=1, initial_radius=10.0)
    assert_equal(whole.x, to_xp([[2.0, 1.0]], dtype), xp=xp)
    assert bool(whole.success[0])
    clipped = solve(products, x0, max_iter=1, initial_radius=0.5)
    assert_equal(clipped.x, to_xp([[0.5, 1.0]], dtype), xp=xp)
    assert int(clipped.status[0]) == Status.MAX_ITER
    assert bool(solve(products, x0, initial_radius=0.5).success[0])


def test_no_slope_at_all_is_stalled(xp, dtype, to_xp):
    # Both equations even in both unknowns: at 0 there is no direction to go.
    def even(a, b):
        f = [a * a + b * b + 1.0, a * a - b * b + 2.0]
        return f, [[2.0 * a, 2.0 * b], [2.0 * a, -2.0 * b]]

    result = solve(even, to_xp([[0.0, 0.0]], dtype))
    assert int(result.status[0]) == Status.STALLED
    assert int(result.n_iter[0]) == 1


def test_dogleg_step_is_the_textbook_one():
    # f = J x, start (1, 1), J = diag(1, 3): Newton (-1, -1), g = (1, 9), and between Cauchy
    # and Newton the point of the segment on the circle, found here by bisection.
    def diagonal(a, b):
        zero = 0.0 * a
        return [a, 3.0 * b], [[zero + 1.0, zero], [zero, zero + 3.0]]

    newton, g = np.array([-1.0, -1.0]), np.array([1.0, 9.0])
    cauchy = -g * (g @ g) / (g[0] ** 2 + (3.0 * g[1]) ** 2)
    for radius in (0.3, 0.9 * np.linalg.norm(cauchy), 1.2, 1.3, 1.41, 1.42):
        if radius <= np.linalg.norm(cauchy):
            expected = cauchy * radius / np.linalg.norm(cauchy)
        elif radius >= np.linalg.norm(newton):
            expected = newton
        else:
            low, high = 0.0, 1.0
            for _ in range(60):
                middle = 0.5 * (low + high)
                outside = np.linalg.norm(cauchy + middle * (newton - cauchy)) > radius
                low, high = (low, middle) if outside else (middle, high)
            expected = cauchy + low * (newton - cauchy)
        result = solve(diagonal, np.ones((1, 2)), max_iter=1, initial_radius=radius)
        np.testing.assert_allclose(result.x[0] - 1.0, expected, atol=1e-14)


@settings(max_examples=25)
@given(
    st.lists(st.tuples(*[st.floats(-20.0, 20.0)] * 2), min_size=6, max_size=6),
    st.sampled_from([rosenbrock, freudenstein_roth, powell_badly_scaled, products]),
)
def test_the_merit_never_grows_and_steps_keep_to_the_radius(starts, system):
    x0 = np.array(starts)
    path = [solve(system, x0, max_iter=n, initial_radius=0.7) for n in range(9)]
    for before, after in pairwise(path):
        moved = np.any(before.x != after.x, axis=-1)
        merits = [np.sum(result.f**2, axis=-1) for result in (before, after)]
        assert np.all(merits[1][moved] < merits[0][moved])
        np.testing.assert_array_equal(before.f[~moved], after.f[~moved])
        length = np.linalg.norm(after.x - before.x, axis=-1)
        # 1e-13: x itself is rounded.
        assert np.all(length <= before.radius * (1.0 + 1e-12) + 1e-13)
        rejected = (after.status == Status.MAX_ITER) & ~moved
        assert np.all(after.radius[rejected] < before.radius[rejected])


def test_the_radius_has_its_limits():
    far = solve(logarithm, np.array([[1.0]]), np.array([[3.0]]), initial_radius=0.5, max_radius=2.0)
    assert far.success[0]
    assert far.radius[0] == 2.0
    roomy = solve(logarithm, np.array([[1.0]]), np.array([[3.0]]), initial_radius=0.5)
    assert roomy.radius[0] > 2.0
    assert roomy.n_iter[0] < far.n_iter[0]


@pytest.mark.skip_backend("jax", reason="compiles each operation, for seconds")
@pytest.mark.parametrize("power", [-1, 1])
def test_the_scale_of_f_does_not_matter(power, dtype, xp, to_xp, to_np):
    # Powers of two change no mantissa: squares of f over- or underflow, norms must not.
    scale = 2.0 ** (power * (600 if dtype == xp.float64 else 75))
    problem, x0 = batch(to_xp, dtype)
    plain = solve(rosenbrock, x0, problem.data, ftol=2.0**-16)
    scaled = solve(rosenbrock, x0, problem.data, scale, ftol=2.0**-16 * scale)
    assert_same(scaled, plain, to_np, ["x", "radius", "status", "n_iter"])
    assert np.all(to_np(plain.success))


# --- outside the domain --------------------------------------------------------------


def nan_jacobian(a):
    xp = array_namespace(a=a)
    inside = a > 0.0
    slope = xp.where(inside, xp.ones_like(a), math.nan * xp.ones_like(a))
    f, jac = logarithm(xp.where(inside, a, xp.ones_like(a)))
    return f, [[jac[0][0] * slope]]


@pytest.mark.parametrize("system", [logarithm, nan_jacobian])
def test_a_trial_outside_the_domain_is_a_rejected_step(system, xp, dtype, to_xp):
    # From 10 Newton's step to ln x = 1 lands at 10 - 10 (ln 10 - 1) = -3.03.
    x0, data = to_xp([[10.0]], dtype), to_xp([[1.0]], dtype)
    first = solve(system, x0, data, max_iter=1, initial_radius=50.0)
    assert_equal(first.x, x0, xp=xp)
    length = 10.0 * (math.log(10.0) - 1.0)
    tol = tolerance("algebra", dtype)
    assert_close(first.radius, to_xp([0.1 * length], dtype), **tol, xp=xp)
    result = solve(system, x0, data, initial_radius=50.0)
    assert bool(result.success[0])
    expected = to_xp([[math.e]], dtype)
    assert_close(result.x, expected, **tolerance("default", dtype), xp=xp)


# --- where rounding stops a row ------------------------------------------------------


def gap(a):
    """`a` with a hole: `|f| >= 1` everywhere, 1 at a = 0."""
    xp = array_namespace(a=a)
    one = xp.ones_like(a)
    return [xp.where(a >= 0.0, a + one, a - one)], [[one]]


@pytest.mark.parametrize(("ratio", "expected"), [(99.0, "CONVERGED"), (101.0, "RADIUS_TOO_SMALL")])
def test_a_row_that_cannot_move_near_the_root_has_converged(ratio, expected, dtype, to_xp):
    result = solve(gap, to_xp([[0.0]], dtype), ftol=1.0 / ratio)
    assert Status(int(result.status[0])).name == expected
    assert int(result.n_iter[0]) > 1


@pytest.mark.parametrize(("ratio", "expected"), [(99.0, "CONVERGED"), (101.0, "STALLED")])
def test_a_step_below_rounding_is_stalled(ratio, expected, dtype, to_xp):
    # Newton's step, 1e-12, does not change x = 2**40 in either dtype; f is 1 there.
    x0 = 2.0**40

    def steep(a):
        return [1e12 * (a - x0) + 1.0], [[0.0 * a + 1e12]]

    result = solve(steep, to_xp([[x0]], dtype), ftol=1.0 / ratio, min_radius=0.0)
    assert Status(int(result.status[0])).name == expected
    assert int(result.n_iter[0]) == 1


def line(a):
    return [2.0 * a], [[0.0 * a + 2.0]]


def test_ftol_is_obeyed(dtype, to_xp, to_np):
    x0, data = to_xp([[0.2], [1.0], [4.0]], dtype), to_xp([[1.0], [1.5], [0.5]], dtype)
    totals = []
    for ftol in (0.3, 1e-2, 1e-5):
        result = solve(logarithm, x0, data, ftol=ftol)
        assert np.all(to_np(result.success))
        assert np.all(np.abs(to_np(result.f)) <= ftol)
        totals.append(int(np.sum(to_np(result.n_iter))))
    assert totals[0] < totals[1] < totals[2]


def test_ftol_has_a_default_for_each_dtype(xp, dtype, to_xp, to_np):
    ftol = 1e-11 if dtype == xp.float64 else 1e-5
    x0 = [[0.5 * factor * ftol] for factor in (0.99, 1.01, -1.01)]
    result = solve(line, to_xp(x0, dtype))
    assert to_np(result.n_iter).tolist() == [0, 1, 1]
    assert np.all(to_np(result.success))


def test_max_iter_zero_only_looks(zoo, to_np):
    problem, x0 = zoo
    result = search(problem, x0, max_iter=0)
    np.testing.assert_array_equal(to_np(result.x), to_np(x0))
    np.testing.assert_array_equal(to_np(result.n_iter), 0)
    np.testing.assert_array_equal(to_np(result.n_eval), 1)
    begun = {0: Status.CONVERGED, None: Status.MAX_ITER}
    expected = [Status.MAX_ITER, begun[0], *[begun[None]] * 3, *[Status.NON_FINITE] * 2]
    assert [Status(int(code)) for code in to_np(result.status)] == expected


# --- batches -------------------------------------------------------------------------


def test_a_batch_is_its_rows(xp, dtype, to_xp, to_np):
    problem, x0 = batch(to_xp, dtype)
    together = search(problem, x0)
    for i in range(0, ROWS, 3):
        row = xp.asarray([i], dtype=xp.int64, device=device_of(x0))
        alone = search(problem.take(row), xp.take(x0, row, axis=0))
        assert_same(together.take(row), alone, to_np)
    assert len(set(to_np(together.n_iter).tolist())) > 3


def test_order_does_not_matter(dtype, to_xp, to_np):
    problem, x0 = batch(to_xp, dtype)
    order = to_xp(np.random.default_rng(2).permutation(ROWS))
    xp = array_namespace(x0=x0)
    shuffled = search(problem.take(order), xp.take(x0, order, axis=0))
    assert_same(shuffled, search(problem, x0).take(order), to_np)


def test_poisoned_mates_change_nothing(dtype, to_xp, to_np):
    problem, x0 = batch(to_xp, dtype)
    data, start = to_np(problem.data), to_np(x0)
    bad = np.arange(2, ROWS, 3)
    good = np.setdiff1d(np.arange(ROWS), bad)
    start[bad] = [[math.nan, 0.0], [1e15, -1e15], [0.0, math.nan], [0.0, 0.0]]
    data[bad] = [[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [math.inf, 0.0]]
    mixed = solve(rosenbrock, to_xp(start, dtype), to_xp(data, dtype))
    assert_same(mixed.take(to_xp(good)), search(problem, x0).take(to_xp(good)), to_np)
    assert to_np(mixed.status)[bad[[0, 2, 3]]].tolist() == [Status.NON_FINITE] * 3


def test_an_empty_batch(xp, dtype, to_xp):
    empty = to_xp(np.empty((0, 3)), dtype)
    result = solve(helical_valley, empty)
    assert result.x.shape == result.f.shape == (0, 3)
    assert result.jac.shape == (0, 3, 3)
    assert result.status.shape == result.n_iter.shape == result.radius.shape == (0,)
    assert result.x.dtype == dtype
    assert result.success.shape == (0,)


@pytest.mark.skip_backend("jax", reason="compiles anew for every batch length")
@pytest.mark.parametrize(
    "options",
    [{"compact_below": 0.0}, {"compact_below": 1.0}, {"check_every": 5}, {"check_every": 1000}],
    ids=str,
)
def test_compaction_and_checks_change_nothing(options, dtype, to_xp, to_np):
    (problem, x0), (other, _) = batch(to_xp, dtype), batch(to_xp, dtype)
    default = find_root(problem, x0)
    assert_same(find_root(other, x0, options=DoglegOptions(**options)), default, to_np)
    n_steps = int(np.max(to_np(default.n_iter)))
    match options:
        case {"compact_below": 0.0}:
            assert other.sizes == [ROWS] * (1 + n_steps)
        case {"compact_below": 1.0}:
            # Every row leaves at once: no evaluation is in vain.
            assert sum(other.sizes) == np.sum(to_np(default.n_eval))
        case {"check_every": 1000}:
            assert other.sizes == [ROWS] * (1 + DoglegOptions().max_iter)
    assert sum(problem.sizes) < ROWS * len(problem.sizes)


def test_the_problem_is_compacted_with_its_rows(dtype, to_xp, to_np):
    problem = Equations(line, to_xp([[1.0], [3.0], [2.0]], dtype))
    x0 = to_xp([[0.5], [1.0], [1.0]], dtype)
    result = find_root(problem, x0)
    assert problem.sizes == [3, 1]
    assert to_np(result.x).tolist() == [[0.5], [1.5], [1.0]]
    assert to_np(result.n_iter).tolist() == [0, 1, 0]


def test_layout_does_not_matter():
    # The same numbers in another order of memory, as a problem may well return them.
    class Transposed(Equations):
        def evaluate(self, x):
            f, jac = super().evaluate(x)
            turned = np.ascontiguousarray(jac.transpose(2, 1, 0)).transpose(2, 1, 0)
            return np.asfortranarray(f), turned

    rng = np.random.default_rng(8)
    x0, data = rng.normal(size=(9, 6)) * 0.5 - 1.0, 0.1 * rng.normal(size=(9, 6))
    results = [find_root(cls(broyden_tridiagonal, data), x0) for cls in (Equations, Transposed)]
    assert_same(*results, np.asarray)
    assert np.all(results[0].success)


def test_take_gives_rows_in_order(to_xp, dtype, to_np):
    result = search(*batch(to_xp, dtype), max_iter=5)
    rows = [7, 0, 7]
    taken = result.take(to_xp(rows))
    for name in FIELDS:
        expected = to_np(getattr(result, name))[rows]
        np.testing.assert_array_equal(to_np(getattr(taken, name)), expected)


def test_nothing_given_is_written_to(dtype, to_xp, to_np):
    problem, x0 = batch(to_xp, dtype)
    before = to_np(x0), to_np(problem.data)
    search(problem, x0, max_iter=5)
    np.testing.assert_array_equal(to_np(x0), before[0])
    np.testing.assert_array_equal(to_np(problem.data), before[1])


# --- calls that mean nothing ---------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"ftol": -1e-3}, RangeError, r"ftol = -0.001 is outside the allowed range \[0, inf\]"),
        ({"ftol": math.nan}, RangeError, "ftol = nan"),
        ({"max_iter": -1}, RangeError, "max_iter = -1"),
        ({"max_iter": 2.5}, FdntValueError, "max_iter must be an integer, not 2.5"),
        ({"initial_radius": -1.0}, RangeError, "initial_radius = -1"),
        ({"initial_radius": 0.0}, FdntValueError, "initial_radius must be positive"),
        ({"initial_radius": 2.0, "max_radius": 1.0}, RangeError, r"max_radius = 1 .* \[2, inf\]"),
        ({"max_radius": math.inf}, FdntValueError, "max_radius finite"),
        ({"min_radius": -1.0}, RangeError, "min_radius = -1"),
        ({"min_radius": 3.0}, RangeError, r"min_radius = 3 .* \[0, 1\]"),
        ({"check_every": 0}, RangeError, "check_every = 0"),
        ({"check_every": 1.5}, FdntValueError, "check_every must be an integer, not 1.5"),
        ({"compact_below": 1.5}, RangeError, r"compact_below = 1.5 .* \[0, 1\]"),
        ({"compact_below": math.nan}, RangeError, "compact_below = nan"),
        ({"patience": 0}, RangeError, "patience = 0"),
        ({"patience": 1.5}, FdntValueError, "patience must be an integer, not 1.5"),
    ],
    ids=str,
)
def test_options_are_checked(options, error, message):
    with pytest.raises(error, match=message):
        DoglegOptions(**options)


@pytest.mark.parametrize(
    ("shape", "error", "message"),
    [
        ((3,), ShapeMismatchError, r"x0 must have shape \(n, d\), not \(3,\)"),
        ((2, 3, 1), ShapeMismatchError, r"x0 must have shape"),
        ((4, 0), RangeError, "number of unknowns = 0"),
        ((4, 7), RangeError, r"number of unknowns = 7 .* \[1, 6\]"),
    ],
    ids=str,
)
def test_the_shape_of_x0_is_checked(shape, error, message, to_xp):
    with pytest.raises(error, match=message):
        solve(broyden_tridiagonal, to_xp(np.zeros(shape)))


class Broken(Equations):
    """Returns what `spoil` makes of f and the Jacobian."""

    spoil: Callable

    def evaluate(self, x):
        return self.spoil(*super().evaluate(x))


@pytest.mark.parametrize(
    ("spoil", "error", "message"),
    [
        (lambda f, jac: (f[:1, :], jac), ShapeMismatchError, r"\(1, 2\).*expected \(\(12, 2\)"),
        (lambda f, jac: (f, jac[:, :1, :]), ShapeMismatchError, r"\(12, 1, 2\)"),
        (lambda f, jac: (f.tolist(), jac), FdntTypeError, "f must be an array"),
    ],
    ids=["f", "jac", "list"],
)
def test_the_problem_is_held_to_its_contract(spoil, error, message):
    problem, x0 = batch(np.array, float)
    broken = Broken(problem.system, problem.data)
    broken.spoil = spoil
    with pytest.raises(error, match=message):
        find_root(broken, x0)


def test_the_problem_keeps_the_dtype(xp, to_xp):
    problem, _ = batch(to_xp, xp.float64)
    broken = Broken(problem.system, problem.data)
    broken.spoil = lambda f, jac: (f, xp.astype(jac, xp.float32))
    with pytest.raises(NamespaceError, match=r"jac has dtype .*float32"):
        find_root(broken, to_xp(np.zeros((ROWS, 2))))


def test_x0_is_real_floating(xp, to_xp, to_np):
    with pytest.raises(FdntTypeError, match="x0 must be real"):
        solve(products, to_xp(np.ones((1, 2), dtype=complex)))
    with pytest.raises(FdntTypeError, match="x0 must be an array"):
        find_root(Equations(products, None), [[1.0, 1.0]])
    data = to_xp(np.zeros((1, 2)))
    result = solve(products, to_xp(np.array([[1, 1]])), data)
    assert result.x.dtype == xp.float64
    np.testing.assert_allclose(to_np(result.x), [[2.0, 1.0]], atol=1e-10)
