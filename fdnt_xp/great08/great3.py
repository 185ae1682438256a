"""The biases of answers along and across the PSF, and Q_c, as the GREAT3 challenge has them.

The definitions are those of its public evaluation code (the repository great3-public:
`q_constant` of `metrics/evaluate.py` and `metricQZ1_const_shear` of `metrics/g3metrics.py`):
the frame, the line without weights, the targets, the damping and the normalisation. Written
anew here. What is not certain, or not the same:

- the normalisation was tuned on simulations of 200 subfields of 10 000 galaxies each, and the
  damping stands for the noise of those. A Q_c of fewer sets, or of less noise, is no GREAT3
  score: with a dozen sets the noise of m and c dominates it;
- branches of several exposures took the mean shape of their PSFs, those of a variable PSF one
  shear per field: both are left to whoever makes the truth table;
- the errors of m and c are not those of that code, which divides the sum of the squared
  residuals by the number of sets, where here it is the degrees of freedom.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.errors import FdntValueError, ShapeMismatchError
from fdnt_xp.great08.answers import Answers, set_names
from fdnt_xp.great08.lines import LineFit, fit_line

M_TARGET: Final = 2e-3
C_TARGET: Final = 2e-4
NORMALISATION: Final = 1.232
DAMPING: Final = {"ground": 4.0, "space": 1.0}
"""sigma²_min by the kind of branch."""


@dataclass(frozen=True, kw_only=True)
class Great3Score:
    """Biases in the frame of the PSF.

    Parameters
    ----------
    plus, cross : LineFit
        Along the PSF, and at 45 degrees to it; without weights, so that its errors are
        those from the scatter.
    q_c : float
        With the damping of ground-based branches 1232 for no bias at all, 871 for all four
        at their targets. NaN if a line could not be fitted.
    damping : float
        sigma²_min.
    """

    plus: LineFit
    cross: LineFit
    q_c: float
    damping: float

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain Python."""
        return asdict(self)


def great3_score(
    answers: Answers,
    psf_angle: float | NDArray[np.float64] | None = None,
    *,
    damping: float = DAMPING["ground"],
    normalisation: float = NORMALISATION,
    m_target: float = M_TARGET,
    c_target: float = C_TARGET,
) -> Great3Score:
    """Return m and c in the frame of the PSF, and Q_c.

    Parameters
    ----------
    answers : Answers
        From `match_answers` or `pooled`.
    psf_angle : float or array, shape (n_sets,), optional
        Direction of the major axis of the PSF, radians from +x; by default that of
        `answers.psf_e`.
    damping : float
        `sigma²_min` of GREAT3: 4 for its ground-based branches, 1 for those from space.
    normalisation, m_target, c_target : float
        GREAT3's, unless others are wanted.

    Raises
    ------
    FdntValueError
        If there is no angle, or a PSF is round and so has none.
    ShapeMismatchError
        If there are not as many angles as sets.

    Notes
    -----
    ``Q_c = 2000 N / sqrt(sigma²_min + sum of (m/m_target)² and (c/c_target)²)`` over the
    components + and ×, with the normalisation N = 1.232.
    """
    angle = _angles(answers, psf_angle)
    truth, residual = (_turn(v, angle) for v in (answers.truth, answers.residual))
    plus, cross = (fit_line(truth[:, i], residual[:, i], None) for i in (0, 1))
    squares = sum((f.m / m_target) ** 2 + (f.c / c_target) ** 2 for f in (plus, cross))
    q_c = 2000.0 * normalisation / math.sqrt(squares + damping)
    return Great3Score(plus=plus, cross=cross, q_c=q_c, damping=damping)


def _angles(answers: Answers, given: float | NDArray[np.float64] | None) -> NDArray[np.float64]:
    if given is None:
        if answers.psf_e is None:
            raise FdntValueError(
                "the angle of the PSF is not known: the truth has no columns psf_e1, psf_e2"
            )
        round_ = ~(np.hypot(*answers.psf_e.T) > 0)  # NaN too
        if np.any(round_):
            names = set_names(answers.number[round_])
            raise FdntValueError(f"the PSF is round, so it has no angle, in {names}")
        return 0.5 * np.arctan2(answers.psf_e[:, 1], answers.psf_e[:, 0])
    angle = np.asarray(given, dtype=np.float64)
    if angle.shape not in ((), (answers.n_sets,)):
        raise ShapeMismatchError(
            f"psf_angle must be one number or one for each of the {answers.n_sets} sets, "
            f"not of shape {angle.shape}"
        )
    return np.broadcast_to(angle, (answers.n_sets,))


def _turn(g: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the components along and at 45 degrees to the angles, (n, 2)."""
    turned = (g[:, 0] + 1j * g[:, 1]) * np.exp(-2j * angle)
    return np.stack([turned.real, turned.imag], axis=-1)
