"""The answers of one estimator beside the truth, set by set, ready to be scored."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.errors import CatalogError, FdntValueError
from fdnt_xp.great08.challenge import set_name

if TYPE_CHECKING:
    from astropy.table import Table

Errors: TypeAlias = Literal["noise", "all", "none"]
ERRORS: Final[tuple[str, ...]] = get_args(Errors)
_COLUMNS_OF: Final = {"noise": ("_err_noise", "_err"), "all": ("_err",), "none": ()}
_MOST_NAMES: Final = 8
"""So many sets are named in a message; of the others it gives the number."""


@dataclass(frozen=True, kw_only=True)
class Answers:
    """What an estimator said of each set, and what is true.

    Parameters
    ----------
    estimator : str
        Whose answers these are.
    run : array, shape (n,), int
        Which run of several a set belongs to, from 0; see `pooled`.
    number : array, shape (n,), int
        Number of the set in its run: 1 for `set0001`.
    shear : array, shape (n,), int
        Number of the root shear: sets of one number have one true shear.
    g, truth : array, shape (n, 2)
        Reduced shear (g1, g2), measured and true; finite.
    g_err : array, shape (n, 2), or None
        Standard errors of `g`, positive; None if there are none.
    psf : tuple of str, or None
        Name of the PSF of each set, if the truth has a column `psf`.
    psf_e : array, shape (n, 2), or None
        Shape of the PSF of each set, if the truth has columns `psf_e1`, `psf_e2`.
    failed : tuple of str
        Sets without an answer, NaN in the submission. They are not in the arrays.
    unmatched : tuple of str
        Sets that only the truth or only the submission has. Nor are they.
    """

    estimator: str
    run: NDArray[np.int64]
    number: NDArray[np.int64]
    shear: NDArray[np.int64]
    g: NDArray[np.float64]
    truth: NDArray[np.float64]
    g_err: NDArray[np.float64] | None
    psf: tuple[str, ...] | None = None
    psf_e: NDArray[np.float64] | None = None
    failed: tuple[str, ...] = ()
    unmatched: tuple[str, ...] = ()

    @property
    def n_sets(self) -> int:
        """How many sets have an answer."""
        return len(self.number)

    @property
    def n_runs(self) -> int:
        """How many runs were pooled."""
        return len(np.unique(self.run))

    @property
    def residual(self) -> NDArray[np.float64]:
        """Measured minus true shear, (n, 2)."""
        return self.g - self.truth


def match_answers(
    submission: Table,
    truth: Table,
    estimator: str | None = None,
    *,
    allow_missing: bool = False,
    errors: Errors = "noise",
) -> Answers:
    """Return the answers of one estimator beside the truth.

    Parameters
    ----------
    submission : astropy.table.Table
        Columns `set`, `estimator`, `g1`, `g2` and, as far as they are asked for, the errors:
        see `read_submission`.
    truth : astropy.table.Table
        Columns `set`, `shear`, `g1`, `g2` and, where there are such, `psf`, `psf_e1`,
        `psf_e2`: see `read_truth`.
    estimator : str, optional
        Whose answers; not needed if the submission has those of one only.
    allow_missing : bool
        Whether sets that only one of the tables has are left out; they are an error if not.
    errors : {"noise", "all", "none"}
        Which errors count: those by the noise of the pixels, `g1_err_noise`, which are right
        where pairs at 90 degrees take the shape noise away; all of it, `g1_err`, which also
        serve where "noise" is asked for and not known; or none. What is NaN in every set is
        not known.

    Raises
    ------
    CatalogError
        If a table lacks a column; if sets do not match, or occur twice; if a true shear is
        not finite; if no set has an answer; if some errors are not positive.
    FdntValueError
        If the estimator is unknown.
    """
    estimator = _which(submission, estimator)
    rows = _rows_of(submission, estimator)
    number, true_number = (_integers(t, "set") for t in (rows, truth))
    _refuse_twice("the submission", number)
    _refuse_twice("the truth", true_number)
    common, here, there = np.intersect1d(number, true_number, return_indices=True)
    unmatched = _unmatched(number, true_number, allow_missing=allow_missing)
    g, true_g = _pair(rows, ("g1", "g2"))[here], _pair(truth, ("g1", "g2"))[there]
    if not np.all(np.isfinite(true_g)):
        bad = common[~np.isfinite(true_g).all(axis=1)]
        raise CatalogError(f"the true shear is not finite in {set_names(bad)}")
    answered = np.isfinite(g).all(axis=1)
    if not np.any(answered):
        raise CatalogError(f"no set has an answer of the estimator {estimator!r}")
    numbers, places = common[answered], there[answered]
    g_err = None
    for suffix in _COLUMNS_OF[errors]:
        if g_err is None:
            g_err = _errors(rows, suffix, here[answered], numbers)
    return Answers(
        estimator=estimator,
        run=np.zeros(len(numbers), dtype=np.int64),
        number=numbers,
        shear=_integers(truth, "shear")[places],
        g=g[answered],
        truth=true_g[answered],
        g_err=g_err,
        psf=tuple(map(str, truth["psf"][places])) if "psf" in truth.colnames else None,
        psf_e=_psf_shapes(truth, places),
        failed=tuple(set_name(n) for n in common[~answered]),
        unmatched=tuple(set_name(n) for n in unmatched),
    )


def pooled(runs: Sequence[Answers]) -> Answers:
    """Return several independent runs as one, for one score of all of them.

    Sets keep their run: shears of the same number in two runs are two groups, because what
    is averaged before it is squared is the images of one run.

    Parameters
    ----------
    runs : sequence of Answers
        Of one estimator, each from its own galaxies and noise. If they are not independent
        the errors of the score are too small.

    Raises
    ------
    FdntValueError
        If there are none, or they are of several estimators, or some have errors and some
        have none.
    """
    if not runs:
        raise FdntValueError("there is no run to pool")
    if len(names := sorted({run.estimator for run in runs})) > 1:
        raise FdntValueError(f"runs of several estimators cannot be pooled: {', '.join(names)}")
    if len({run.g_err is None for run in runs}) > 1:
        raise FdntValueError("some runs have errors and some have none: pool them without errors")
    if len(runs) == 1:
        return runs[0]
    offsets = np.cumsum([0, *(int(run.run.max()) + 1 for run in runs)])
    return Answers(
        estimator=runs[0].estimator,
        run=np.concatenate([run.run + k for run, k in zip(runs, offsets[:-1], strict=True)]),
        number=np.concatenate([run.number for run in runs]),
        shear=np.concatenate([run.shear for run in runs]),
        g=np.concatenate([run.g for run in runs]),
        truth=np.concatenate([run.truth for run in runs]),
        g_err=_joined([run.g_err for run in runs]),
        psf=None
        if any(run.psf is None for run in runs)
        else tuple(name for run in runs for name in run.psf or ()),
        psf_e=_joined([run.psf_e for run in runs]),
        failed=_of_runs([run.failed for run in runs]),
        unmatched=_of_runs([run.unmatched for run in runs]),
    )


def estimators_of(submission: Table) -> list[str]:
    """Return the estimators of a submission, in the order in which they occur."""
    _require(submission, ("estimator",), "the submission")
    return list(dict.fromkeys(map(str, submission["estimator"])))


def set_names(numbers: Iterable[int]) -> str:
    """Return `set0001, set0002, ...`, with no more than eight of them named."""
    names = [set_name(n) for n in numbers]
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return ", ".join(names[:_MOST_NAMES]) + more


def _which(submission: Table, estimator: str | None) -> str:
    known = estimators_of(submission)
    if not known:
        raise CatalogError("the submission has no rows")
    if estimator is None and len(known) == 1:
        return known[0]
    if estimator not in known:
        given = "several estimators, and none was named" if estimator is None else repr(estimator)
        raise FdntValueError(f"the submission has {', '.join(known)}; asked for: {given}")
    return estimator


def _rows_of(submission: Table, estimator: str) -> Table:
    _require(submission, ("set", "g1", "g2"), "the submission")
    rows = submission[np.asarray(submission["estimator"]).astype(str) == estimator]
    return rows


def _require(table: Table, names: Sequence[str], what: str) -> None:
    if missing := [name for name in names if name not in table.colnames]:
        found = ", ".join(table.colnames)
        raise CatalogError(f"{what} has no column {', '.join(missing)}; it has {found}")


def _integers(table: Table, name: str) -> NDArray[np.int64]:
    _require(table, (name,), "the truth")
    return np.asarray(table[name], dtype=np.int64)


def _pair(table: Table, names: tuple[str, str]) -> NDArray[np.float64]:
    """Return two columns as (n, 2); NaN where a table has no value."""
    _require(table, names, "the table")
    columns = [np.ma.filled(np.ma.asarray(table[name]).astype(float), np.nan) for name in names]
    return np.stack(columns, axis=-1)


def _refuse_twice(what: str, numbers: NDArray[np.int64]) -> None:
    found, counts = np.unique(numbers, return_counts=True)
    if np.any(counts > 1):
        raise CatalogError(f"{what} has more than one row for {set_names(found[counts > 1])}")


def _unmatched(
    number: NDArray[np.int64], true_number: NDArray[np.int64], *, allow_missing: bool
) -> NDArray[np.int64]:
    """Return the sets of one table only; an error if there may be none."""
    unanswered = np.setdiff1d(true_number, number)
    untold = np.setdiff1d(number, true_number)
    problems = []
    if len(unanswered):
        problems.append(f"the submission lacks {set_names(unanswered)} of the truth")
    if len(untold):
        problems.append(f"the truth lacks {set_names(untold)} of the submission")
    if problems and not allow_missing:
        raise CatalogError(f"{'; '.join(problems)}; --allow-missing scores the others")
    if len(untold) == len(number):
        raise CatalogError("the submission and the truth have no set in common")
    return np.union1d(unanswered, untold)


def _errors(
    rows: Table, suffix: str, places: NDArray[np.int64], numbers: NDArray[np.int64]
) -> NDArray[np.float64] | None:
    names = (f"g1{suffix}", f"g2{suffix}")
    if not set(names) <= set(rows.colnames):
        return None
    errors = _pair(rows, names)[places]
    if np.all(np.isnan(errors)):
        return None
    good = np.all(np.isfinite(errors) & (errors > 0), axis=1)
    if not np.all(good):
        raise CatalogError(
            f"the errors must be positive and finite, and are not in {set_names(numbers[~good])}; "
            "--errors none scores without them"
        )
    return errors


def _psf_shapes(truth: Table, places: NDArray[np.int64]) -> NDArray[np.float64] | None:
    names = ("psf_e1", "psf_e2")
    return _pair(truth, names)[places] if set(names) <= set(truth.colnames) else None


def _joined(parts: Sequence[NDArray[Any] | None]) -> NDArray[Any] | None:
    present = [part for part in parts if part is not None]
    return np.concatenate(present) if len(present) == len(parts) else None


def _of_runs(names: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    return tuple(f"{name} of run {k}" for k, run in enumerate(names, 1) for name in run)
