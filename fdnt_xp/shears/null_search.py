"""The search for the shear at which a mean of two components vanishes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from fdnt_xp.errors import FdntValueError
from fdnt_xp.shears.frames import Gamma

_MAX_STEPS: Final = 12
_PATIENT_STEPS: Final = 6
"""After so many, `_RELAXED` times the tolerance will do: galaxies that are lost in one frame
and found in the next make the mean of noisy galaxies a function with steps."""
_RELAXED: Final = 10.0


class OutOfReachError(FdntValueError):
    """The null, if there is one, lies beyond the shears that may be asked for."""


def find_null(
    mean: Callable[[Gamma], Gamma],
    at_start: Gamma,
    jac: list[Gamma],
    *,
    start: Gamma = (0.0, 0.0),
    largest: float,
    tolerance: float,
    least_secant: float = 0.0,
) -> Gamma:
    """Find the gamma at which a mean of two components vanishes.

    Parameters
    ----------
    mean : callable
        From gamma to the mean.
    at_start : tuple of float
        Its value at the start.
    jac : list of 2 tuples
        Its derivative there, rows by component of the mean.
    start : tuple of float
        Where to begin.
    largest : float
        Largest `|gamma|` that may be asked for.
    tolerance : float
        A step smaller than this ends the search.
    least_secant : float
        The derivative learns nothing from steps shorter than this.

    Raises
    ------
    FdntValueError
        If the response is singular, or the search does not end.
    OutOfReachError
        If it leaves the range.
    """
    (a, b), (c, d) = jac
    x, y = start
    f1, f2 = at_start
    for step in range(_MAX_STEPS):
        det = a * d - b * c
        if not (math.isfinite(det) and abs(det) > 1e-12 * (a * a + b * b + c * c + d * d)):
            raise FdntValueError("the sample's mean shape does not respond to shear")
        sx, sy = -(d * f1 - b * f2) / det, -(a * f2 - c * f1) / det
        if math.hypot(sx, sy) < tolerance * (1.0 if step < _PATIENT_STEPS else _RELAXED):
            return x + sx, y + sy
        x, y = x + sx, y + sy
        if not math.hypot(x, y) <= largest:
            raise OutOfReachError(
                f"no null within max_shear: the search went to |g| = "
                f"{math.tanh(0.5 * math.hypot(x, y)):.3g}, allowed is "
                f"{math.tanh(0.5 * largest):.3g}; raise max_shear if so large a shear is meant"
            )
        f1, f2 = mean((x, y))
        # Broyden: the least change of the response that explains the value just seen. What
        # the linear model left over is f itself, since the step was Newton's.
        size = sx * sx + sy * sy
        if size < least_secant**2:
            continue
        a, b = a + f1 * sx / size, b + f1 * sy / size
        c, d = c + f2 * sx / size, d + f2 * sy / size
    raise FdntValueError(f"no null found in {_MAX_STEPS} steps")
