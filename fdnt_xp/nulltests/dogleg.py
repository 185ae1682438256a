"""Powell's dogleg for many small systems of equations at once; it knows no galaxy.

Every row of a batch is a system `f(x) = 0` of d equations with its own trust region, status
and counters: it gives the same bits alone and in any batch, whatever becomes of its mates.
The merit is `|f|²/2`. A row whose Jacobian is singular follows the gradient of the merit. A
trial point where `f` or its Jacobian is not finite is a rejected step. Data never raise.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import IntEnum
from types import ModuleType
from typing import Final, Protocol, Self

from fdnt_xp.arrays import (
    Array,
    DType,
    array_namespace,
    as_floating,
    compiles_every_shape,
    device_of,
    require_dtype,
    works_in_blocks,
)
from fdnt_xp.errors import FdntValueError, RangeError, ShapeMismatchError
from fdnt_xp.nulltests.small_systems import (
    add_up,
    all_of,
    largest,
    newton_step,
    nonzero,
    norm,
    scale_of,
)

# Nocedal & Wright 2006, algorithm 4.1, for the ratio of the real to the promised reduction
# of the merit; they leave _ACCEPT free in [0, 1/4).
_ACCEPT: Final = 1e-4
_SHRINK_BELOW, _SHRINK = 0.25, 0.25
_GROW_ABOVE, _GROW = 0.75, 2.0
_AT_BOUNDARY: Final = 0.99  # of the radius: such a step was held back by it
_SHRINK_OUTSIDE: Final = 0.1  # outside the domain there is no ratio, and the model is no guide
_SLOW: Final = 0.01  # of |f|²: a step that takes off less wears out the patience
_FLAT: Final = 4.0  # eps: a smaller promised part of the merit is its rounding
_ROUNDING: Final = 100.0  # ftol: |f| at which a row that cannot move is taken for a root
_MAX_UNKNOWNS: Final = 6  # the small algebra is written out, which does not pay for more


class RootProblem(Protocol):
    """A batch of systems of equations, one per row."""

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """Return `f(x)`, shape (n, d), and its Jacobian `df_i/dx_j`, shape (n, d, d).

        `x` has shape (n, d), n the rows of this problem. NaN says that x is outside the
        domain. One `ftol` must suit all f_i, one radius all x_j: scale them.
        """
        ...

    def take(self, rows: Array) -> RootProblem:
        """Return the problem of these rows (integer array) of this one, in that order."""
        ...


class Status(IntEnum):
    """How the search for a root ended. CONVERGED is the only success."""

    RUNNING = -1
    CONVERGED = 0
    MAX_ITER = 1
    RADIUS_TOO_SMALL = 2
    STALLED = 3
    NON_FINITE = 4


def status_text(code: int) -> str:
    """Return the sentence that explains a status code."""
    return {
        Status.RUNNING: "still running",
        Status.CONVERGED: "converged",
        Status.MAX_ITER: "iteration limit reached",
        Status.RADIUS_TOO_SMALL: "trust region shrank to nothing",
        Status.STALLED: "no step reduces |f| any further",
        Status.NON_FINITE: "not finite at the starting point",
    }[Status(code)]


@dataclass(frozen=True, kw_only=True)
class DoglegOptions:
    """How to search.

    Parameters
    ----------
    ftol : float, optional
        A row has converged when `max_i |f_i| <= ftol`. Default: 1e-11, in float32 1e-5.
    max_iter : int
        Largest number of trial steps of a row.
    initial_radius, max_radius : float
        Radius of the trust region at the start, and the most it may become; units of x.
    min_radius : float, optional
        A rejected step that leaves no more ends the search. Default: 10 eps initial_radius.
    check_every : int
        Steps between two looks at how many rows still run; each look waits for the device.
    compact_below : float, optional
        Finished rows leave the batch when no more than this fraction of it runs. It changes
        the speed, as does `check_every`, never the result. Default: 0.75, and 0 (never)
        where each new length of a batch is compiled anew.
    patience : int, optional
        A row is stalled after so many steps in a row that took less than 1 % off `|f|²`.
        Default: never.
    """

    ftol: float | None = None
    max_iter: int = 50
    initial_radius: float = 1.0
    max_radius: float = 100.0
    min_radius: float | None = None
    check_every: int = 1
    compact_below: float | None = None
    patience: int | None = None

    def __post_init__(self) -> None:
        """Refuse numbers that mean nothing."""
        infinity = float("inf")
        for name, low, high in (
            ("ftol", 0, infinity),
            ("max_iter", 0, infinity),
            ("initial_radius", 0, infinity),
            ("max_radius", self.initial_radius, infinity),
            ("min_radius", 0, self.initial_radius),
            ("check_every", 1, infinity),
            ("compact_below", 0, 1),
            ("patience", 1, infinity),
        ):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:  # which NaN is not
                raise RangeError(name, value, low, None if high == infinity else high)
            whole = name in ("max_iter", "check_every", "patience") and value is not None
            if whole and not isinstance(value, int):
                raise FdntValueError(f"{name} must be an integer, not {value!r}")
        if self.initial_radius == 0 or self.max_radius == infinity:
            raise FdntValueError("initial_radius must be positive and max_radius finite")


@dataclass(frozen=True, kw_only=True)
class RootResult:
    """Roots of a batch of systems, in the order of the starting points.

    All arrays share the library and device of `x0`, those of floats its dtype. A row that
    failed holds the best point it reached; what becomes of it is the caller's choice.

    Parameters
    ----------
    x : array, shape (n, d)
        The last point accepted; for NON_FINITE the starting point.
    f, jac : array, shapes (n, d) and (n, d, d)
        The equations and their Jacobian there.
    radius : array, shape (n,)
        Radius of the trust region at the end.
    status : array, shape (n,), int32
        A `Status`.
    n_iter, n_eval : array, shape (n,), int32
        Trial steps, accepted or not; evaluations, that of the starting point included.
    """

    x: Array
    f: Array
    jac: Array
    radius: Array
    status: Array
    n_iter: Array
    n_eval: Array

    @property
    def success(self) -> Array:
        """True where a root was found, shape (n,), bool."""
        return self.status == int(Status.CONVERGED)

    def take(self, rows: Array) -> Self:
        """Return the given rows (integer array), in that order."""
        xp = array_namespace(x=self.x, rows=rows)
        columns = {g.name: xp.take(getattr(self, g.name), rows, axis=0) for g in fields(self)}
        return type(self)(**columns)


@dataclass(frozen=True, kw_only=True)
class _State(RootResult):
    index: Array  # the place of the row in the batch of the caller
    n_slow: Array  # steps since one that took something off |f|²


_DEFAULTS: Final = DoglegOptions()


def find_root(problem: RootProblem, x0: Array, *, options: DoglegOptions = _DEFAULTS) -> RootResult:
    """Find a root of each row's equations by Powell's dogleg.

    The Newton step is taken where it fits the trust region, else a step along the path
    from the minimum of the linear model on the gradient (the Cauchy step) to Newton's.

    Parameters
    ----------
    problem : RootProblem
        The equations. It is asked to `take` ever fewer of its rows as others finish.
    x0 : array, shape (n, d), real floating
        Starting points, `1 <= d <= 6`; n may be 0.
    options : DoglegOptions
        Tolerances, radii, limits.

    Returns
    -------
    RootResult
        Row i belongs to row i of `x0`.

    Raises
    ------
    RangeError, ShapeMismatchError, NamespaceError
        If `x0` has not the shape above, or `evaluate` changes shape, library, dtype, device.

    Notes
    -----
    The status of a row is the first of these that holds:

    1. NON_FINITE: `f` or the Jacobian is not finite at the starting point.
    2. CONVERGED: `max_i |f_i| <= ftol`; or 3 or 4 holds and `max_i |f_i| <= 100 ftol`,
       the row being as near to the root as the rounding of its `f` allows.
    3. RADIUS_TOO_SMALL: a step was rejected and left a radius `<= min_radius`.
    4. STALLED: the step is `|p_i| <= eps |x_i|` for all i, or promises to reduce `|f|²` by
       no more than `4 eps |f|²`, as in a local minimum, or `patience` is at an end.
    5. MAX_ITER: `max_iter` steps were tried.

    `|f|` never grows from one accepted point to the next. A step costs one evaluation; the
    host looks at the device once in `check_every` steps.

    References
    ----------
    .. [1] Nocedal and Wright 2006, Numerical Optimization, 2nd ed., chapters 4 and 11.
    """
    x0 = as_floating(xp := array_namespace(x0=x0), x0, "x0")
    eps, ftol, least = float(xp.finfo(x0.dtype).eps), options.ftol, options.min_radius
    ftol = default_ftol(xp, x0.dtype) if ftol is None else ftol
    least = 10.0 * eps * options.initial_radius if least is None else least
    compact_below = options.compact_below
    if compact_below is None:
        compact_below = 0.0 if compiles_every_shape(xp) else 0.75
    state = _start(xp, problem, x0, options.initial_radius, ftol)
    finished: list[_State] = []
    limits = (ftol, least, options.max_radius)
    for i in range(options.max_iter):
        if i % options.check_every == 0:
            done = xp.astype(state.status != int(Status.RUNNING), xp.int32)
            n = done.shape[0]
            n_running = n - int(xp.sum(done))
            if n_running == 0:
                break
            if n_running < n and n_running <= compact_below * n:
                order = xp.argsort(done, stable=True)
                finished.append(state.take(order[n_running:]))
                state, problem = state.take(order[:n_running]), problem.take(order[:n_running])
        state = _step(xp, problem, state, limits, options.patience)
    return _collect(xp, [*finished, state])


def default_ftol(xp: ModuleType, dtype: DType) -> float:
    """Return the `ftol` of a floating dtype, where none is asked for."""
    return 1e-11 if float(xp.finfo(dtype).eps) < 1e-12 else 1e-5


def _start(xp: ModuleType, problem: RootProblem, x: Array, radius: float, ftol: float) -> _State:
    if x.ndim != 2:
        raise ShapeMismatchError(f"x0 must have shape (n, d), not {tuple(x.shape)}")
    if not 1 <= x.shape[1] <= _MAX_UNKNOWNS:
        raise RangeError("number of unknowns", x.shape[1], 1, _MAX_UNKNOWNS)
    f, jac, finite = _evaluate(xp, problem, x)
    radii = xp.full_like(x[:, 0], radius)
    none = xp.zeros_like(radii, dtype=xp.int32)
    index = xp.arange(x.shape[0], dtype=xp.int64, device=device_of(x))
    status = xp.full_like(none, int(Status.RUNNING))
    status = _mark(xp, status, largest(xp, f) <= ftol, Status.CONVERGED)
    status = _mark(xp, status, ~finite, Status.NON_FINITE)
    counts = {"n_iter": none, "n_eval": none + 1, "n_slow": none}
    return _State(x=x, f=f, jac=jac, radius=radii, status=status, index=index, **counts)


def _step(
    xp: ModuleType,
    problem: RootProblem,
    state: _State,
    limits: tuple[float, float, float],
    patience: int | None,
) -> _State:
    """Try one step of every running row; leave the others as they are."""
    (ftol, min_radius, max_radius), eps = limits, float(xp.finfo(state.x.dtype).eps)
    running = state.status == int(Status.RUNNING)
    # Rows at rest solve 1 p = 0: harmless arithmetic, and p = 0.
    f = xp.where(running[:, None], state.f, xp.zeros_like(state.f))
    unit = xp.eye(f.shape[1], dtype=f.dtype, device=device_of(f))[None, :, :]
    jac = xp.where(running[:, None, None], state.jac, unit)
    radius = xp.where(running, state.radius, xp.ones_like(state.radius))
    step = _dogleg_step(xp, f, jac, radius)
    f_trial, jac_trial, inside = _evaluate(xp, problem, state.x + step)

    size_f = norm(xp, f)
    promised = _reduction(xp, size_f, f + add_up(xp, jac * step[:, None, :]))
    real = _reduction(xp, size_f, xp.where(inside[:, None], f_trial, f))
    # Written without a division: the promise may be 0.
    accept = running & inside & (promised > 0.0) & (real >= _ACCEPT * promised)
    f = xp.where(accept[:, None], f_trial, state.f)
    length = norm(xp, step)
    grows = (real > _GROW_ABOVE * promised) & (length >= _AT_BOUNDARY * radius)
    grown = xp.minimum(_GROW * radius, xp.full_like(radius, max_radius))
    radius = xp.where(grows, grown, radius)
    radius = xp.where(real < _SHRINK_BELOW * promised, _SHRINK * length, radius)
    radius = xp.where(inside, radius, _SHRINK_OUTSIDE * length)
    still = all_of(xp, xp.abs(step) <= eps * xp.abs(state.x))
    stalled = inside & (still | (promised <= _FLAT * eps))
    slow = ~(accept & (real >= _SLOW))
    n_slow = xp.where(slow, state.n_slow + 1, xp.zeros_like(state.n_slow))
    if patience is not None:
        stalled = stalled | (n_slow >= patience)
    too_small = ~accept & (radius <= min_radius)
    size = largest(xp, f)
    rounding = (stalled | too_small) & (size <= _ROUNDING * ftol)
    # The later mark decides over the earlier.
    status = _mark(xp, state.status, stalled, Status.STALLED)
    status = _mark(xp, status, too_small, Status.RADIUS_TOO_SMALL)
    status = _mark(xp, status, rounding | (size <= ftol), Status.CONVERGED)
    return _State(
        x=xp.where(accept[:, None], state.x + step, state.x),
        f=f,
        jac=xp.where(accept[:, None, None], jac_trial, state.jac),
        radius=xp.where(running, radius, state.radius),
        status=xp.where(running, status, state.status),
        n_iter=state.n_iter + xp.astype(running, xp.int32),
        n_eval=state.n_eval + xp.astype(running, xp.int32),
        index=state.index,
        n_slow=n_slow,
    )


def _dogleg_step(xp: ModuleType, f: Array, jac: Array, radius: Array) -> Array:
    """Return the step of length `<= radius` along the path 0 - Cauchy - Newton."""
    newton, solved = newton_step(xp, f, jac)
    fits = solved & (norm(xp, newton) <= radius)
    # A host read, where that waits for nothing: near a root all steps are Newton's.
    if works_in_blocks(f) and bool(xp.all(fits)):
        return newton
    cauchy = _cauchy_step(xp, f, jac, radius)
    # |cauchy + s u| = radius, u the direction from Cauchy to Newton; in units of the radius.
    distance = norm(xp, newton - cauchy)
    unit = (newton - cauchy) / nonzero(xp, distance)[:, None]
    start = cauchy / radius[:, None]
    along = add_up(xp, start * unit)
    gap = xp.abs(1.0 - add_up(xp, start * start))  # never below 0 but by rounding
    root = xp.sqrt(along * along + gap)
    # The form of the positive root that does not cancel; along < 0 is rounding.
    s = xp.minimum(gap / nonzero(xp, xp.abs(along) + root) * radius, distance)
    bent = xp.where(solved[:, None], cauchy + s[:, None] * unit, cauchy)
    return xp.where(fits[:, None], newton, bent)


def _cauchy_step(xp: ModuleType, f: Array, jac: Array, radius: Array) -> Array:
    """Return the minimum of `|f + J p|` along `-Jᵀ f`, cut at the radius."""
    # p = -(|g|/|J u|²) u, g = Jᵀ f, u = g/|g|; f and J scaled, lest squares over- or underflow.
    size_f = nonzero(xp, largest(xp, f))
    size_j = scale_of(xp, largest(xp, largest(xp, jac)), size_f)
    jac = jac / size_j[:, None, None]
    gradient = add_up(xp, jac * (f / size_f[:, None])[:, :, None], axis=1)
    slope = norm(xp, gradient)
    unit = gradient / nonzero(xp, slope)[:, None]
    rate = nonzero(xp, norm(xp, add_up(xp, jac * unit[:, None, :])))
    length = xp.minimum(slope / rate / rate * (size_f / size_j), radius)
    return -length[:, None] * unit


def _collect(xp: ModuleType, parts: list[_State]) -> RootResult:
    """Join the rows that finished at different times, in the order of the caller."""
    order = xp.argsort(xp.concat([part.index for part in parts], axis=0))
    names = [field.name for field in fields(RootResult)]
    columns = {g: xp.concat([getattr(part, g) for part in parts], axis=0) for g in names}
    result = RootResult(**columns).take(order)
    running = result.status == int(Status.RUNNING)
    return replace(result, status=_mark(xp, result.status, running, Status.MAX_ITER))


def _evaluate(xp: ModuleType, problem: RootProblem, x: Array) -> tuple[Array, Array, Array]:
    """Return f, its Jacobian, and where both are finite; hold the problem to its contract."""
    f, jac = problem.evaluate(x)
    array_namespace(x0=x, f=f, jac=jac)
    require_dtype(x.dtype, f=f, jac=jac)
    n, d = x.shape
    shapes, expected = (tuple(f.shape), tuple(jac.shape)), ((n, d), (n, d, d))
    if shapes != expected:
        raise ShapeMismatchError(f"problem.evaluate returned {shapes}, expected {expected}")
    finite = xp.isfinite(largest(xp, f)) & xp.isfinite(largest(xp, largest(xp, jac)))
    return f, jac, finite


def _reduction(xp: ModuleType, size: Array, new: Array) -> Array:
    """Return `1 - |new|²/size²`, cut at -3, where the ratio is still far from overflow."""
    ratio = xp.minimum(norm(xp, new), 2.0 * size) / nonzero(xp, size)
    return 1.0 - ratio * ratio


def _mark(xp: ModuleType, status: Array, rows: Array, code: Status) -> Array:
    return xp.where(rows, xp.full_like(status, int(code)), status)
