"""The quality Q of answers, their biases m and c, and what perfect answers would get."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fdnt_xp.errors import FdntValueError
from fdnt_xp.great08.answers import Answers
from fdnt_xp.great08.lines import SAME_SHEAR, LineFit, fit_line

Grouping: TypeAlias = Literal["shear", "psf,shear", "set"]
"""Of which sets residuals are averaged before they are squared, always within one run."""
GROUPINGS: Final[tuple[str, ...]] = get_args(Grouping)

Noise: TypeAlias = Literal["errors", "within groups", "about lines"]
"""Of a floor: the errors of the submission; the scatter of the sets within their groups; or,
where every group is one set, their scatter about the lines of m and c."""

_UNIT: Final = 1e-4
"""Q is this over the mean square residual."""
_LOW, _HIGH = 0.16, 0.84
_RARE: Final = 1e-3


@dataclass(frozen=True, kw_only=True)
class Floor:
    """What noise alone does to the score.

    Parameters
    ----------
    noise : str
        Where the noise was taken from, see `Noise`.
    rms : float
        Square root of the mean square residual that perfect answers are expected to have.
    q : float
        `1e-4/rms²`.
    q_range : tuple of float
        16th and 84th percentile of the Q of perfect answers.
    ratio : float
        RMS residual of these answers over `rms`; 1 for perfect ones but for chance.
    ratio_range : tuple of float
        16th and 84th percentile of the ratio of perfect answers.
    probability : float
        That perfect answers have a ratio as large as this.
    dof : float
        Degrees of freedom of the mean square residual.
    noise_dof : float
        Degrees of freedom of the noise itself: infinite if the errors are taken as exact.
    """

    noise: Noise
    rms: float
    q: float
    q_range: tuple[float, float]
    ratio: float
    ratio_range: tuple[float, float]
    probability: float
    dof: float
    noise_dof: float


@dataclass(frozen=True, kw_only=True)
class Group:
    """The sets whose residuals are averaged before they are squared.

    Parameters
    ----------
    run : int
        Of which run, from 0.
    name : str
        What the sets share: "shear 3", "psf_fiducial, shear 3", "set 17".
    n_sets : int
        How many they are.
    truth, residual : tuple of float
        Mean true shear (g1, g2), and mean residual.
    residual_err : tuple of float
        Standard error of the mean residual, from the errors of the sets; NaN without those.
    """

    run: int
    name: str
    n_sets: int
    truth: tuple[float, float]
    residual: tuple[float, float]
    residual_err: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Score:
    """How good the answers of an estimator are.

    Parameters
    ----------
    estimator : str
        Whose answers.
    group_by : str
        Grouping of the sets for Q.
    n_sets, n_groups, n_runs : int
        Sets with an answer; groups; independent runs that were pooled.
    q : float
        `1e-4/rms²`.
    rms : float
        Root mean square over groups and components of the mean residual of a group.
    floor : Floor, or None
        From the errors of the submission; None without those.
    scatter_floor : Floor, or None
        From the scatter of the residuals, which errors that are too large or too small do not
        touch; None if there are too few sets.
    errors_too_large : bool
        Whether the errors are larger than the scatter about the lines can be by chance, once
        in 1000 times. Then `floor` is too easy.
    fits : tuple of LineFit
        Biases of the two components.
    groups : tuple of Group
        What Q was made of.
    failed, unmatched : tuple of str
        Sets that were left out; see `Answers`.
    """

    estimator: str
    group_by: str
    n_sets: int
    n_groups: int
    n_runs: int
    q: float
    rms: float
    floor: Floor | None
    scatter_floor: Floor | None
    errors_too_large: bool
    fits: tuple[LineFit, LineFit]
    groups: tuple[Group, ...]
    failed: tuple[str, ...]
    unmatched: tuple[str, ...]

    @property
    def best_floor(self) -> Floor | None:
        """The floor by the errors, or that by the scatter if those are none or too large."""
        return self.scatter_floor if self.floor is None or self.errors_too_large else self.floor

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain Python."""
        return asdict(self)


def score_answers(answers: Answers, group_by: Grouping = "shear") -> Score:
    """Return Q, its noise floor, and the biases m and c.

    Parameters
    ----------
    answers : Answers
        From `match_answers`, or several runs in one from `pooled`.
    group_by : str
        What the sets share whose residuals are averaged before they are squared: "shear",
        their root shear; "psf,shear", their PSF as well; "set": nothing is averaged.

    Returns
    -------
    Score

    Raises
    ------
    FdntValueError
        If the grouping is unknown, or needs the names of PSFs that the truth does not hold,
        or sets with one root shear have different true shears.

    Notes
    -----
    ``Q = 1e-4 / <(<g - g_true>)²>``: the inner mean, without weights, is over the sets of a
    group, the outer over groups and both components. A perfect answer with error `s` has
    the mean square `s²`, of a group of n sets `s²/n`; so the more sets a group has the higher
    is Q, and two values of it can be compared only for equal groups and equal numbers of
    galaxies. That is what the floor is for.

    The mean square of perfect answers is a sum of chi-squares with the variances of the
    groups as weights. The percentiles are those of a chi-square of the same mean and variance
    (exact for equal errors), and with the noise from the scatter those of an F distribution.
    Residuals of different sets, and of the two components, are taken as independent; for the
    scatter also all sets as equally noisy. The scatter about the lines holds whatever is
    not a line, so that the floor by it sees no bias but m and c.

    An estimator that knows nothing of pairs of galaxies at 90 degrees gives errors with the
    shape noise that the pairs have taken away, which can be many times too large.

    The biases are from straight lines through all sets, weighted by the inverse squares of
    the errors, not from the groups.

    References
    ----------
    .. [1] Bridle et al. 2009, Annals of Applied Statistics 3, 6 (GREAT08 handbook).
    .. [2] Bernstein 2010, MNRAS 406, 2793, section on GREAT08.
    """
    if group_by not in GROUPINGS:
        raise FdntValueError(f"no grouping {group_by!r}; known are {' | '.join(GROUPINGS)}")
    names, index = _group(answers, group_by)
    count = np.bincount(index)
    truth, residual = (_group_means(v, index) for v in (answers.truth, answers.residual))
    if group_by != "set":
        _require_one_shear(answers.truth, truth, index, names)
    variance = None
    if answers.g_err is not None:
        variance = _group_means(answers.g_err**2, index) / count[:, None]
    mean_square = float(np.mean(residual**2))
    err = np.full_like(residual, np.nan) if variance is None else np.sqrt(variance)
    fits = (_fit(answers, 0), _fit(answers, 1))
    floor = None if variance is None else noise_floor(mean_square, variance)
    if len(count) < answers.n_sets:
        scatter = _floor_within(answers.residual, residual, index, count)
    else:
        scatter = _floor_about_lines(answers)
    return Score(
        estimator=answers.estimator,
        group_by=group_by,
        n_sets=answers.n_sets,
        n_groups=len(count),
        n_runs=answers.n_runs,
        q=quality(mean_square),
        rms=math.sqrt(mean_square),
        floor=floor,
        scatter_floor=scatter,
        errors_too_large=_errors_too_large(fits),
        fits=fits,
        groups=tuple(
            Group(
                run=run,
                name=name,
                n_sets=int(count[k]),
                truth=_two(truth[k]),
                residual=_two(residual[k]),
                residual_err=_two(err[k]),
            )
            for k, (run, name) in enumerate(names)
        ),
        failed=answers.failed,
        unmatched=answers.unmatched,
    )


def quality(mean_square: float) -> float:
    """Return `Q = 1e-4/mean_square`.

    Examples
    --------
    >>> round(quality(1e-3**2))
    100
    """
    return _UNIT / mean_square if mean_square > 0 else math.inf


def noise_floor(
    mean_square: float, variance: NDArray[np.float64], noise_dof: float = math.inf
) -> Floor:
    """Compare a mean square residual with that of perfect answers.

    Parameters
    ----------
    mean_square : float
        Mean over groups and components of the squared residual.
    variance : array
        Variance of each residual that enters it.
    noise_dof : float
        Degrees of freedom with which the scale of the variances was measured, from what does
        not enter the mean square; infinite if it is known.
    """
    expected = float(np.mean(variance))
    dof = float(np.sum(variance) ** 2 / np.sum(variance**2))
    relative = mean_square / expected
    if math.isinf(noise_dof):
        low, high = (float(special.chdtri(dof, 1.0 - p)) / dof for p in (_LOW, _HIGH))
        probability = float(special.chdtrc(dof, dof * relative))
    else:
        low, high = (float(special.fdtri(dof, noise_dof, p)) for p in (_LOW, _HIGH))
        probability = float(special.fdtrc(dof, noise_dof, relative))
    return _floor(
        "errors" if math.isinf(noise_dof) else "within groups",
        expected,
        relative,
        (low, high),
        probability=probability,
        dof=dof,
        noise_dof=noise_dof,
    )


def _fit(answers: Answers, i: int) -> LineFit:
    err = None if answers.g_err is None else answers.g_err[:, i]
    return fit_line(answers.truth[:, i], answers.residual[:, i], err)


def _group(answers: Answers, group_by: Grouping) -> tuple[list[tuple[int, str]], NDArray[np.int64]]:
    """Return (run, name) of each group, and to which of them each set belongs."""
    if group_by == "set":
        names = [f"set {number}" for number in answers.number]
    else:
        names = [f"shear {number}" for number in answers.shear]
    if group_by == "psf,shear":
        if answers.psf is None:
            raise FdntValueError(
                f"sets cannot be grouped by {group_by!r}: the truth has no column psf"
            )
        names = [f"{psf}, {name}" for psf, name in zip(answers.psf, names, strict=True)]
    keys = [(int(run), name) for run, name in zip(answers.run, names, strict=True)]
    groups = list(dict.fromkeys(keys))
    place = {key: k for k, key in enumerate(groups)}
    return groups, np.array([place[key] for key in keys])


def _group_means(values: NDArray[np.float64], index: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the mean of each group, (n_groups, 2)."""
    sums = [np.bincount(index, weights=values[:, i]) for i in (0, 1)]
    return np.stack(sums, axis=-1) / np.bincount(index)[:, None]


def _require_one_shear(
    truth: NDArray[np.float64],
    means: NDArray[np.float64],
    index: NDArray[np.int64],
    names: list[tuple[int, str]],
) -> None:
    differs = np.any(np.abs(truth - means[index]) > SAME_SHEAR, axis=1)
    if np.any(differs):
        name = names[int(index[np.argmax(differs)])][1]
        raise FdntValueError(
            f"the sets of {name} have different true shears, so they cannot be averaged; "
            "group by 'set'"
        )


def _floor_within(
    residual: NDArray[np.float64],
    means: NDArray[np.float64],
    index: NDArray[np.int64],
    count: NDArray[np.int64],
) -> Floor | None:
    """Take the noise of a set from the scatter about the mean of its group."""
    dof = 2 * int(np.sum(count - 1))
    squares = float(np.sum((residual - means[index]) ** 2))
    if squares == 0.0:
        return None
    variance = squares / dof / np.repeat(count[:, None], 2, axis=1)
    return noise_floor(float(np.mean(means**2)), variance, float(dof))


def _floor_about_lines(answers: Answers) -> Floor | None:
    """Take the noise of a set from the scatter about the lines, where no groups average.

    The squares split in two independent parts, those of the lines with p degrees of freedom
    and those about them with n - p, so that ratio² = ((n - p) + p F)/n.
    """
    truth, residual = answers.truth, answers.residual
    equal = np.ones(answers.n_sets)
    fits = [fit_line(truth[:, i], residual[:, i], equal) for i in (0, 1)]
    n, dof = residual.size, sum(fit.dof for fit in fits)
    squares = sum(fit.chi2 for fit in fits)
    if dof <= 0 or squares == 0.0:
        return None
    p, expected = n - dof, squares / dof
    relative = float(np.mean(residual**2)) / expected
    low, high = ((dof + p * float(special.fdtri(p, dof, q))) / n for q in (_LOW, _HIGH))
    return _floor(
        "about lines",
        expected,
        relative,
        (low, high),
        probability=float(special.fdtrc(p, dof, max(0.0, (n * relative - dof) / p))),
        dof=float(n),
        noise_dof=float(dof),
    )


def _floor(
    noise: Noise,
    expected: float,
    relative: float,
    limits: tuple[float, float],
    *,
    probability: float,
    dof: float,
    noise_dof: float,
) -> Floor:
    """Return a floor by the mean square of perfect answers, and its range relative to that."""
    low, high = limits
    return Floor(
        noise=noise,
        rms=math.sqrt(expected),
        q=quality(expected),
        q_range=(quality(high * expected), quality(low * expected)),
        ratio=math.sqrt(relative),
        ratio_range=(math.sqrt(low), math.sqrt(high)),
        probability=probability,
        dof=dof,
        noise_dof=noise_dof,
    )


def _errors_too_large(fits: tuple[LineFit, LineFit]) -> bool:
    """Return whether the sets are closer to the lines than their errors allow."""
    dof, chi2 = sum(fit.dof for fit in fits), sum(fit.chi2 for fit in fits)
    return dof > 0 and bool(special.chdtr(dof, chi2) < _RARE)  # False for NaN


def _two(values: NDArray[np.float64]) -> tuple[float, float]:
    return float(values[0]), float(values[1])
