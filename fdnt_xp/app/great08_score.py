"""What `fdnt-xp great08 score` does, between its options and its last line."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from fdnt_xp.app.numbers import check_json, write_json
from fdnt_xp.app.plots import (
    BLUE,
    INK,
    ORANGE,
    PALE,
    check_figure,
    new_figure,
    page_style,
    save_figure,
)
from fdnt_xp.app.summary import format_measured
from fdnt_xp.errors import CatalogError, FdntValueError
from fdnt_xp.great08.answers import Answers, Errors, estimators_of, match_answers, pooled
from fdnt_xp.great08.great3 import DAMPING, Great3Score, great3_score
from fdnt_xp.great08.lines import LineFit
from fdnt_xp.great08.score import Floor, Grouping, Noise, Score, score_answers
from fdnt_xp.great08.submission import read_submission
from fdnt_xp.great08.truth import TRUTH, read_truth

if TYPE_CHECKING:
    from astropy.table import Table
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SUBMISSION: Final = "submission.ecsv"


@dataclass(frozen=True, kw_only=True)
class ScoreOptions:
    """A scoring by the options of the command line; see `fdnt_xp.great08.score`."""

    outputs: tuple[str, ...]
    truths: tuple[str, ...]
    estimators: tuple[str, ...] = ()
    group_by: Grouping = "shear"
    columns: tuple[str, ...] = ()
    psf_angle: float | None = None
    great3: str = "ground"
    allow_missing: bool = False
    errors: Errors = "noise"


@dataclass(frozen=True, kw_only=True)
class Scored:
    """The answers of one estimator, and what they are worth."""

    answers: Answers
    score: Score
    great3: Great3Score | None


def run_score(
    options: ScoreOptions, output: str | None, plot: str | None, *, overwrite: bool
) -> Iterator[str]:
    """Score, write what is asked for, and yield the lines of the report."""
    if output is not None:
        check_json(output, overwrite=overwrite)
    if plot is not None:
        check_figure(plot, overwrite=overwrite)
    results = score_files(options)
    for result in results:
        yield from report(result)
    if output is not None:
        named = {"submissions": options.outputs, "truths": options.truths}
        scores = [_facts(result) for result in results]
        write_json(_plain({**named, "scores": scores}), output, overwrite=overwrite)
        yield f"written    {output}"
    if plot is not None:
        save_figure(plot_scores(results), plot, overwrite=overwrite)
        yield f"written    {plot}"


def score_files(options: ScoreOptions) -> list[Scored]:
    """Read submissions and truths, and score each estimator that is asked for, or all."""
    if len(options.truths) not in (1, len(options.outputs)):
        raise FdntValueError(
            f"{len(options.outputs)} submissions need one --truth each or one for all, "
            f"not {len(options.truths)}"
        )
    columns = parse_columns(options.columns)
    submissions = [read_submission(_file(path, SUBMISSION)) for path in options.outputs]
    truths = [read_truth(_file(path, TRUTH), columns=columns) for path in options.truths]
    runs = list(zip(submissions, truths * (len(submissions) // len(truths)), strict=True))
    names = options.estimators or _common_estimators(submissions)
    return [_score_one(name, runs, options) for name in dict.fromkeys(names)]


def parse_columns(given: Sequence[str]) -> dict[str, str] | None:
    """Return which column of the truth is meant by `set`, `shear`, `g1`, `g2`."""
    columns = {}
    for text in (part for one in given for part in one.split(",")):
        name, sign, column = text.partition("=")
        if not (name.strip() and sign and column.strip()):
            raise FdntValueError(f"--columns wants NAME=COLUMN, such as g1=gamma1, not {text!r}")
        columns[name.strip()] = column.strip()
    return columns or None


def report(result: Scored) -> Iterator[str]:
    """Yield the lines that say what the answers of an estimator are worth."""
    score = result.score
    yield f"estimator  {score.estimator}"
    runs = f" of {score.n_runs} runs" if score.n_runs > 1 else ""
    sizes = sorted({group.n_sets for group in score.groups})
    each = f"{sizes[0]}" if len(sizes) == 1 else f"{sizes[0]} to {sizes[-1]}"
    plural = "set" if sizes == [1] else "sets"
    yield (
        f"sets       {score.n_sets}{runs} in {score.n_groups} groups by {score.group_by}, "
        f"{each} {plural} each"
    )
    for title, names in (("no answer", score.failed), ("left out", score.unmatched)):
        if names:
            yield f"{title:<10} {len(names)}: {', '.join(names)}"
    yield f"Q          {score.q:.4g}, RMS residual {score.rms:.3g}"
    for floor in (score.floor, score.scatter_floor):
        if floor is not None:
            yield from _floor_lines(floor)
    if score.errors_too_large:
        yield "           The errors are larger than the scatter: the floor by them is too easy."
    if score.floor is None:
        yield "           There are no errors of the answers to make a floor of."
    yield _HEADING
    for i, fit in enumerate(score.fits):
        yield from _fit_lines(f"g{i + 1}", fit)
    if result.great3 is not None:
        great3 = result.great3
        yield f"GREAT3     Q_c {great3.q_c:.4g} with sigma2_min {great3.damping:g}, no weights"
        for name, fit in (("g+", great3.plus), ("gx", great3.cross)):
            yield from _fit_lines(name, fit)


_HEADING: Final = (
    f"{'component':<11}{'m':>10}{'+-':>9}{'scatter':>9}{'c':>11}{'+-':>9}{'scatter':>9}"
    f"{'chi2/dof':>12}"
)


_NOISE: Final[dict[Noise, str]] = {
    "errors": "the errors",
    "within groups": "the scatter within groups",
    "about lines": "the scatter about the lines",
}


def _floor_lines(floor: Floor) -> Iterator[str]:
    low, high = floor.q_range
    yield (
        f"floor      Q {floor.q:.4g} by {_NOISE[floor.noise]}; perfect answers get "
        f"{low:.4g} to {high:.4g} (16-84 %)"
    )
    low, high = floor.ratio_range
    yield (
        f"           RMS over floor {floor.ratio:.3f}; perfect answers get "
        f"{low:.3f} to {high:.3f}, this or more in {floor.probability:.2%}"
    )


def _fit_lines(name: str, fit: LineFit) -> Iterator[str]:
    if math.isnan(fit.m):
        mean = format_measured(fit.mean, fit.mean_err)
        yield f"{name:<11}all sets have one true shear, so m cannot be fitted; mean residual {mean}"
        return
    chi2 = "" if math.isnan(fit.chi2) else f"{fit.chi2:.1f}/{fit.dof}"
    cells = [
        f"{fit.m:>+10.2e}",
        *(_cell(value) for value in (fit.m_err, fit.m_scatter)),
        f"{fit.c:>+11.2e}",
        *(_cell(value) for value in (fit.c_err, fit.c_scatter)),
        f"{chi2:>12}",
    ]
    yield f"{name:<11}{''.join(cells)}".rstrip()


def _cell(value: float) -> str:
    return f"{'':>9}" if math.isnan(value) else f"{value:>9.1e}"


def plot_scores(results: Sequence[Scored]) -> Figure:
    """Draw residuals against the truth, a row for each estimator, a column a component."""
    with page_style():
        figure = new_figure(11.0, 0.6 + 3.6 * len(results))
        panels = figure.subplots(len(results), 2, sharex="col", sharey="row", squeeze=False)
        for row, result in zip(panels, results, strict=True):
            for i, axes in enumerate(row):
                _draw_residuals(axes, result, i)
            low, high = row[0].get_ylim()
            row[0].set_ylim(low, high + 0.4 * (high - low))  # the top is for the legends
            row[0].set_ylabel("measured - true [$10^{-3}$]")
        for i, axes in enumerate(panels[-1]):
            axes.set_xlabel(f"true $g_{i + 1}$")
    return figure


def _draw_residuals(axes: Axes, result: Scored, i: int) -> None:
    answers, fit, score = result.answers, result.score.fits[i], result.score
    colour = (BLUE, ORANGE)[i]
    truth, residual = answers.truth[:, i], 1e3 * answers.residual[:, i]
    err = None if answers.g_err is None else 1e3 * answers.g_err[:, i]
    axes.axhline(0.0, color=PALE, lw=1.2, zorder=0)
    axes.errorbar(
        truth, residual, err, fmt="o", ms=3.5, lw=0.9, color=colour, alpha=0.55, label="sets"
    )
    means = np.array([(g.truth[i], 1e3 * g.residual[i]) for g in score.groups])
    if score.n_groups < score.n_sets:
        label = f"means by {score.group_by}"
        axes.plot(*means.T, "D", ms=6, mfc="white", mec=INK, mew=1.4, label=label, zorder=3)
    said = "one true shear: no line"
    if not math.isnan(fit.m):
        ends = np.array([truth.min(), truth.max()])
        said = f"m = {_measured(fit.m, fit.m_err, fit.m_scatter)}\n"
        said += f"c = {_measured(fit.c, fit.c_err, fit.c_scatter)}"
        axes.plot(ends, 1e3 * (fit.m * ends + fit.c), color=INK, lw=1.6, label=said)
    else:
        axes.plot([], [], " ", label=said)
    axes.legend(loc="upper left", fontsize=8.5, ncols=2)
    title = f"{score.estimator}, Q = {score.q:.4g}"
    if score.best_floor is not None:
        title += f" (floor {score.best_floor.q:.4g})"
    axes.set_title(title if i == 0 else "")


def _measured(value: float, err: float, scatter: float) -> str:
    return format_measured(value, scatter if math.isnan(err) else err)


def _score_one(name: str, runs: Sequence[tuple[Table, Table]], options: ScoreOptions) -> Scored:
    answers = pooled(
        [
            match_answers(
                submission,
                truth,
                name,
                allow_missing=options.allow_missing,
                errors=options.errors,
            )
            for submission, truth in runs
        ]
    )
    great3 = None
    if options.psf_angle is not None or _has_angles(answers):
        angle = None if options.psf_angle is None else math.radians(options.psf_angle)
        great3 = great3_score(answers, angle, damping=DAMPING[options.great3])
    return Scored(answers=answers, score=score_answers(answers, options.group_by), great3=great3)


def _has_angles(answers: Answers) -> bool:
    """Return whether the truth tells the direction of every PSF."""
    return answers.psf_e is not None and bool(np.all(np.hypot(*answers.psf_e.T) > 0))


def _common_estimators(submissions: Sequence[Table]) -> list[str]:
    """Return the estimators of all submissions; an error if they differ."""
    lists = [estimators_of(submission) for submission in submissions]
    names = [name for name in lists[0] if all(name in others for others in lists)]
    if any(set(others) != set(names) for others in lists):
        several = "; ".join(", ".join(others) for others in lists)
        raise FdntValueError(f"the submissions have different estimators ({several}); choose one")
    return names


def _file(path: str, name: str) -> Path:
    """Return the file of a folder, or the file itself."""
    folder = Path(path)
    if folder.is_dir():
        if not (folder / name).is_file():
            raise CatalogError(f"the folder {path} has no {name}")
        return folder / name
    return folder


def _facts(result: Scored) -> dict[str, Any]:
    great3 = None if result.great3 is None else result.great3.to_dict()
    return {**result.score.to_dict(), "great3": great3}


def _plain(value: Any) -> Any:
    """Return it with None for what JSON has no number for."""
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
