"""Straight lines through the residuals of sets: the multiplicative and the additive bias."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.errors import ShapeMismatchError

SAME_SHEAR: Final = 1e-9
"""Shears that are closer than this are one; they come from files, with rounding."""


@dataclass(frozen=True, kw_only=True)
class LineFit:
    """The line `residual = m truth + c` through the sets, for one component.

    Parameters
    ----------
    m, c : float
        Multiplicative and additive bias. NaN where all sets have one true shear, for which
        only `m truth + c` can be told; if that shear is zero, `c` is known.
    m_err, c_err : float
        Standard errors that follow from the errors of the sets; NaN without those.
    m_scatter, c_scatter : float
        Standard errors from the scatter of the sets about the line: the above times
        `sqrt(chi2/dof)`. NaN with fewer than three sets.
    correlation : float
        Of m and c.
    mean, mean_err : float
        Weighted mean of the residuals and its standard error from the errors of the sets.
    chi2 : float
        Sum of the squared distances from the line in units of the errors; NaN without those.
    dof : int
        Its degrees of freedom.
    """

    m: float
    c: float
    m_err: float
    c_err: float
    m_scatter: float
    c_scatter: float
    correlation: float
    mean: float
    mean_err: float
    chi2: float
    dof: int


def fit_line(
    truth: NDArray[np.float64], residual: NDArray[np.float64], err: NDArray[np.float64] | None
) -> LineFit:
    """Fit `residual = m truth + c`, weighted by the inverse squares of the errors.

    Parameters
    ----------
    truth, residual : array, shape (n,)
        One component.
    err : array, shape (n,), or None
        Positive standard errors; None weights all alike.

    Raises
    ------
    ShapeMismatchError
        If the arrays are not of one length, or empty.
    """
    if truth.ndim != 1 or truth.shape != residual.shape or not len(truth):
        raise ShapeMismatchError(
            f"truth and residual must be of one length, not {truth.shape} and {residual.shape}"
        )
    weight = np.ones_like(truth) if err is None else err**-2.0
    total = float(np.sum(weight))
    x_mean = float(np.sum(weight * truth)) / total
    mean = float(np.sum(weight * residual)) / total
    x = truth - x_mean
    sloped = float(np.ptp(truth)) > SAME_SHEAR
    sxx = float(np.sum(weight * x**2)) if sloped else math.nan
    m = float(np.sum(weight * x * residual)) / sxx
    c, var_c = mean - m * x_mean, 1.0 / total + x_mean**2 / sxx
    if not sloped and abs(x_mean) < SAME_SHEAR:
        c, var_c = mean, 1.0 / total
    distance = residual - (mean + m * x if sloped else mean)
    chi2 = float(np.sum(weight * distance**2))
    dof = len(truth) - (2 if sloped else 1)
    sigma_m, sigma_c = math.sqrt(1.0 / sxx), math.sqrt(var_c)
    scatter = math.sqrt(chi2 / dof) if dof > 0 else math.nan
    known = math.nan if err is None else 1.0
    return LineFit(
        m=m,
        c=c,
        m_err=known * sigma_m,
        c_err=known * sigma_c,
        m_scatter=scatter * sigma_m,
        c_scatter=scatter * sigma_c,
        correlation=-x_mean / sxx / (sigma_m * sigma_c),
        mean=mean,
        mean_err=known / math.sqrt(total),
        chi2=known * chi2,
        dof=dof,
    )
