"""A mean over its mean response to shear: the value, and two kinds of error."""

from __future__ import annotations

import itertools
from typing import Final

from fdnt_xp.arrays import Array, array_namespace, device_of

_JACKKNIFE_GROUPS: Final = 50


def over_response(response: Array, v: Array) -> Array:
    """Return `R⁻¹ v` for stacks of matrices, shape (n, 2, 2), and vectors, (n, 2).

    Infinite or NaN where a matrix is singular.
    """
    xp = array_namespace(v=v)
    a, b = response[:, 0, 0], response[:, 0, 1]
    c, d = response[:, 1, 0], response[:, 1, 1]
    v1, v2 = v[:, 0], v[:, 1]
    return xp.stack([d * v1 - b * v2, a * v2 - c * v1], axis=-1) / (a * d - b * c)[:, None]


def ratio_errors(v: Array, response: Array) -> tuple[Array, Array]:
    """Return the standard errors of `<R>⁻¹ <v>`, by influence and by jackknife, (2,) each.

    The influence of a galaxy is `<R>⁻¹ (v - R g)`, with g the ratio. A jackknife sample, that
    leaves out one of 50 groups of neighbouring rows, has its own response; so the two
    differ by terms of order 1/n_gal.

    Parameters
    ----------
    v : array, shape (n_gal, 2)
    response : array, shape (n_gal, 2, 2)
        `dv_i/dg_j`.
    """
    xp = array_namespace(v=v)
    n_gal = int(v.shape[0])
    mean_response = xp.mean(response, axis=0)[None, :, :]
    g = over_response(mean_response, xp.mean(v, axis=0)[None, :])
    left = v - xp.sum(response * g[:, None, :], axis=-1)
    influence = over_response(mean_response, left)
    by_influence = xp.sqrt(xp.sum(influence**2, axis=0) / (n_gal * (n_gal - 1.0)))

    n_group = min(_JACKKNIFE_GROUPS, n_gal)
    edges = [round(j * n_gal / n_group) for j in range(n_group + 1)]
    total_v, total_r = xp.sum(v, axis=0), xp.sum(response, axis=0)
    left_v, left_r = [], []
    for lo, hi in itertools.pairwise(edges):
        left_v.append(total_v - xp.sum(v[lo:hi, :], axis=0))
        left_r.append(total_r - xp.sum(response[lo:hi, :, :], axis=0))
    estimates = over_response(xp.stack(left_r), xp.stack(left_v))
    scatter = estimates - xp.mean(estimates, axis=0)
    return by_influence, xp.sqrt(xp.sum(scatter**2, axis=0) * ((n_group - 1.0) / n_group))


def errors_by_noise(variance: Array, response: Array) -> Array:
    """Return the standard errors of `<R>⁻¹ <v>` from the variances of each v, (2,).

    Parameters
    ----------
    variance : array, shape (n_gal, 2)
        Of v1 and v2, which are taken as independent.
    response : array, shape (n_gal, 2, 2)
    """
    xp = array_namespace(variance=variance)
    n_gal = int(variance.shape[0])
    error = xp.sqrt(xp.sum(variance, axis=0)) / n_gal
    mean_response = xp.mean(response, axis=0)[None, :, :]
    one_by_one = error[None, :] * xp.eye(2, dtype=error.dtype, device=device_of(error))
    moved = over_response(mean_response, one_by_one)
    return xp.sqrt(xp.sum(moved**2, axis=0))
