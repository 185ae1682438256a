"""Levenberg and Marquardt's least squares for many galaxies at once.

Every row of a batch is a fit of its own, with its own damping, status and counters. The
damping follows Nielsen (1999): it shrinks the more, the better the quadratic model foretold
the step, and grows ever faster while steps fail. The quadratic model has the curvature of
chi² itself, not that of a model that fits: a de Vaucouleurs galaxy is no Gaussian, and
`Jᵀ J` alone then overshoots in size eightfold. Data never raise.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from types import ModuleType
from typing import Final, Protocol, Self

from fdnt_xp.arrays import Array, array_namespace, compiles_every_shape, device_of
from fdnt_xp.nulltests.dogleg import Status

_RIDGE: Final = 10.0
"""In eps times the dimension: more than rounding can take off an eigenvalue."""
_FIRST_DAMPING: Final = 1e-2
_LARGEST_STEP: Final = 1.5
_ACCEPT: Final = 1e-4
_NO_WORSE: Final = 4.0  # eps |r|: chi² is not known better, r being data of length 1 minus model
_COMPACT_BELOW: Final = 0.75


class LeastSquaresProblem(Protocol):
    """A batch of fits, one per row, whose data without a model have chi² = 1."""

    def evaluate(self, x: Array) -> tuple[Array, Array, Array, Array]:
        """Return chi², g, H and scale, of shapes (n,), (n, d), (n, d, d) and (n, d).

        `-2 g` is the gradient of chi² and `2 H` its second derivative; scale is the sum of the
        squares of the slopes of the model, `diag Jᵀ J`. NaN where x is out of the domain.
        """
        ...

    def take(self, rows: Array) -> LeastSquaresProblem:
        """Return the problem of these rows (integer array) of this one, in that order."""
        ...


@dataclass(frozen=True, kw_only=True)
class Minimum:
    """Minima of a batch of fits, in the order of the starting points.

    Parameters
    ----------
    x : array, shape (n, d)
        The last point accepted.
    status : array, shape (n,), int32
        A `fdnt_xp.nulltests.dogleg.Status`.
    n_eval : array, shape (n,), int32
        Evaluations, that of the starting point included.
    """

    x: Array
    status: Array
    n_eval: Array


@dataclass(frozen=True, kw_only=True)
class _State:
    """Where each row is; `index` is its row in the batch of the caller."""

    index: Array
    x: Array
    chi2: Array
    g: Array
    h: Array
    scale: Array
    damping: Array
    growth: Array
    status: Array
    n_eval: Array

    def take(self, rows: Array) -> Self:
        xp = array_namespace(x=self.x, rows=rows)
        columns = {f.name: xp.take(getattr(self, f.name), rows, axis=0) for f in fields(self)}
        return type(self)(**columns)


def find_minimum(problem: LeastSquaresProblem, x0: Array, *, max_iter: int = 100) -> Minimum:
    """Minimise chi² of every row from its starting point.

    Parameters
    ----------
    problem : LeastSquaresProblem
    x0 : array, shape (n, d)
        Scaled so that steps of order one are large.
    max_iter : int
        Trial steps of a row.

    Notes
    -----
    A row has converged when the cosine between data and slopes that is left,
    `max_j |g_j|/sqrt(scale_j)`, is 1e-10 or less (float32: 1e-5). The host looks at the device
    once a step.
    """
    xp = array_namespace(x0=x0)
    gtol = 1e-10 if float(xp.finfo(x0.dtype).eps) < 1e-12 else 1e-5
    state = _start(xp, problem, x0, gtol)
    finished: list[_State] = []
    compact_below = 0.0 if compiles_every_shape(xp) else _COMPACT_BELOW
    for _ in range(max_iter):
        done = xp.astype(state.status != int(Status.RUNNING), xp.int32)
        n = int(done.shape[0])
        n_running = n - int(xp.sum(done))
        if n_running == 0:
            break
        if n_running <= compact_below * n:
            order = xp.argsort(done, stable=True)
            finished.append(state.take(order[n_running:]))
            state, problem = state.take(order[:n_running]), problem.take(order[:n_running])
        state = _step(xp, problem, state, gtol)
    parts = [*finished, state]
    order = xp.argsort(xp.concat([part.index for part in parts]))
    columns = {
        name: xp.take(xp.concat([getattr(p, name) for p in parts], axis=0), order, axis=0)
        for name in ("x", "status", "n_eval")
    }
    minimum = Minimum(**columns)
    running = minimum.status == int(Status.RUNNING)
    return replace(minimum, status=_mark(xp, minimum.status, running, Status.MAX_ITER))


def inverse_of_normal(matrix: Array) -> tuple[Array, Array]:
    """Return the inverse of each symmetric non-negative matrix, and where it is regular.

    Scaled to a unit diagonal, with a ridge above its rounding: Cholesky's factorisation
    cannot fail, for one that does would fail the batch. Elsewhere the inverse is 0.
    """
    xp = array_namespace(matrix=matrix)
    n, eps = int(matrix.shape[-1]), float(xp.finfo(matrix.dtype).eps)
    diagonal = xp.linalg.diagonal(matrix)
    tiny = float(xp.finfo(matrix.dtype).smallest_normal) ** 0.5
    fair = xp.all(diagonal > tiny, axis=-1)
    fair = fair & xp.all(xp.all(xp.isfinite(matrix), axis=-1), axis=-1)
    norm = 1.0 / xp.sqrt(xp.where(fair[:, None], diagonal, xp.ones_like(diagonal)))
    both = norm[:, :, None] * norm[:, None, :]
    eye = xp.eye(n, dtype=matrix.dtype, device=device_of(matrix))[None, :, :]
    scaled = xp.where(fair[:, None, None], matrix * both, eye) + _RIDGE * n * eps * eye
    root = xp.linalg.inv(xp.linalg.cholesky(scaled))
    inverse = xp.matmul(xp.matrix_transpose(root), root) * both
    return xp.where(fair[:, None, None], inverse, xp.zeros_like(inverse)), fair


def _start(xp: ModuleType, problem: LeastSquaresProblem, x: Array, gtol: float) -> _State:
    chi2, g, h, scale, inside = _evaluated(xp, problem, x)
    none = xp.zeros_like(chi2, dtype=xp.int32)
    status = xp.full_like(none, int(Status.RUNNING))
    status = _mark(xp, status, _angle(xp, g, scale) <= gtol, Status.CONVERGED)
    return _State(
        index=xp.arange(int(x.shape[0]), dtype=xp.int64, device=device_of(x)),
        x=x,
        chi2=chi2,
        g=g,
        h=h,
        scale=scale,
        damping=xp.full_like(chi2, _FIRST_DAMPING),
        growth=xp.full_like(chi2, 2.0),
        status=_mark(xp, status, ~inside, Status.NON_FINITE),
        n_eval=none + 1,
    )


def _step(xp: ModuleType, problem: LeastSquaresProblem, state: _State, gtol: float) -> _State:
    """Try one step of every running row; leave the others as they are."""
    eps = float(xp.finfo(state.x.dtype).eps)
    running = state.status == int(Status.RUNNING)
    step, promised = _damped_step(xp, state)
    step = xp.where(running[:, None], step, xp.zeros_like(step))
    chi2, g, h, scale, inside = _evaluated(xp, problem, state.x + step)
    real = state.chi2 - chi2
    rounding = _NO_WORSE * eps * xp.sqrt(state.chi2)
    accept = running & inside & (real >= _ACCEPT * promised - rounding)

    # Nielsen's rule; the ratio means nothing where chi² cannot resolve what was promised.
    resolved = promised > rounding
    ratio = xp.where(resolved, real / _safe(xp, promised), xp.ones_like(real))
    ratio = xp.minimum(xp.maximum(ratio, xp.zeros_like(ratio)), xp.full_like(ratio, 2.0))
    shrink = xp.maximum(1.0 - (2.0 * ratio - 1.0) ** 3, xp.full_like(ratio, 0.1))
    damping = state.damping * xp.where(accept, shrink, state.growth)
    growth = xp.where(accept, xp.full_like(damping, 2.0), 2.0 * state.growth)
    chosen = accept[:, None]
    x = xp.where(chosen, state.x + step, state.x)
    g = xp.where(chosen, g, state.g)
    h = xp.where(chosen[:, :, None], h, state.h)
    scale = xp.where(chosen, scale, state.scale)
    angle = _angle(xp, g, scale)
    stuck = damping > 1.0 / eps
    status = _mark(xp, state.status, stuck, Status.RADIUS_TOO_SMALL)
    near = (angle <= gtol) | (stuck & (angle <= 100.0 * gtol))
    status = _mark(xp, status, near, Status.CONVERGED)
    return _State(
        index=state.index,
        x=x,
        chi2=xp.where(accept, chi2, state.chi2),
        g=g,
        h=h,
        scale=scale,
        damping=xp.where(running, damping, state.damping),
        growth=xp.where(running, growth, state.growth),
        status=xp.where(running, status, state.status),
        n_eval=state.n_eval + xp.astype(running, xp.int32),
    )


def _damped_step(xp: ModuleType, state: _State) -> tuple[Array, Array]:
    """Return the step `(|H| + damping scale)^-1 g`, no longer than 1.5, and what it promises.

    |H| has the moduli of the eigenvalues of the scaled H: away from saddle points.
    """
    unit = 1.0 / xp.sqrt(_safe(xp, state.scale))
    values, vectors = xp.linalg.eigh(state.h * unit[:, :, None] * unit[:, None, :])
    along = xp.sum(vectors * (unit * state.g)[:, :, None], axis=1)
    curvature = xp.abs(values) + xp.maximum(
        state.damping[:, None], xp.full_like(values, float(xp.finfo(values.dtype).eps))
    )
    step = unit * xp.sum(vectors * (along / curvature)[:, None, :], axis=-1)
    length = xp.sqrt(xp.sum(step * step, axis=-1))
    cut = _LARGEST_STEP / xp.maximum(length, xp.full_like(length, _LARGEST_STEP))
    step = cut[:, None] * step
    curved = xp.sum(step * xp.sum(state.h * step[:, None, :], axis=-1), axis=-1)
    return step, 2.0 * xp.sum(step * state.g, axis=-1) - curved


def _evaluated(
    xp: ModuleType, problem: LeastSquaresProblem, x: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Return chi², g, H and scale, harmless where not finite, and where they are."""
    chi2, g, h, scale = problem.evaluate(x)
    inside = xp.isfinite(chi2) & xp.all(xp.isfinite(g) & xp.isfinite(scale), axis=-1)
    inside = inside & xp.all(xp.all(xp.isfinite(h), axis=-1), axis=-1)
    chi2 = xp.where(inside, chi2, xp.zeros_like(chi2))
    g = xp.where(inside[:, None], g, xp.zeros_like(g))
    scale = xp.where(inside[:, None], scale, xp.ones_like(scale))
    h = xp.where(inside[:, None, None], h, xp.zeros_like(h))
    return chi2, g, h, scale, inside


def _angle(xp: ModuleType, g: Array, scale: Array) -> Array:
    """Return `max_j |g_j|/sqrt(scale_j)`; infinite where nothing responds."""
    seen = scale > 0
    ratio = xp.abs(g) / xp.sqrt(xp.where(seen, scale, xp.ones_like(scale)))
    return xp.max(xp.where(seen, ratio, xp.full_like(ratio, float("inf"))), axis=-1)


def _mark(xp: ModuleType, status: Array, rows: Array, code: Status) -> Array:
    return xp.where(rows, xp.full_like(status, int(code)), status)


def _safe(xp: ModuleType, value: Array) -> Array:
    return xp.where(value > 0, value, xp.ones_like(value))
