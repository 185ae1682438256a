"""All sets of a GREAT08 challenge, into one folder: what `fdnt-xp great08 measure` does.

The folder, `OUT` in the documentation, says at any time how far a run has come:

- `run.json`: the options, and the versions that began it;
- `catalogs/set0001.fits`: the galaxies of a set;
- `sets/set0001.json`: its shears, written last: a set that has it is finished;
- `submission.ecsv` and `NAME.txt`: the shears of all sets, rewritten at the end.
"""

from __future__ import annotations

import os
import sys
import time
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

from tqdm import tqdm

from fdnt_xp.app.backends import load_backend
from fdnt_xp.app.great08_measure import MeasureOptions, SetResult, measure_set
from fdnt_xp.app.numbers import write_json
from fdnt_xp.app.resume import begin_run, read_json, tidy
from fdnt_xp.app.workers import Failure, open_workers
from fdnt_xp.data.catalog import write_catalog
from fdnt_xp.data.files import make_folder
from fdnt_xp.errors import CatalogError, FdntError, FdntWarning
from fdnt_xp.great08.challenge import Challenge, ChallengeSet, read_challenge, set_name
from fdnt_xp.great08.submission import submission_table, write_submission, write_text_submission

SUBMISSION: Final = "submission.ecsv"
_UNFINISHED: Final = (
    ".submission-*.ecsv",
    "catalogs/.set*-*.fits",
    "sets/.set*-*.json",
)
"""Names that `new_file` gives to what is being written: what a kill leaves behind."""


@dataclass(frozen=True, kw_only=True)
class MeasureReport:
    """How a run ended.

    Parameters
    ----------
    challenge : Challenge
        What was measured.
    folder : Path
        Where the results are.
    results : tuple of SetResult
        Of all sets that are finished, by number.
    n_before : int
        How many of them were finished before this run.
    failures : dict of str
        Why the others are not, by the name of the set.
    seconds : float
        That this run took.
    """

    challenge: Challenge
    folder: Path
    results: tuple[SetResult, ...]
    n_before: int
    failures: dict[str, str]
    seconds: float


def measure_challenge(
    directory: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    options: MeasureOptions,
    *,
    cell: int | None = None,
    jobs: int = 1,
    scheduler: str | None = None,
    quiet: bool = True,
) -> MeasureReport:
    """Measure the sets of a challenge that are not finished yet, and write the submission.

    A set that cannot be measured keeps no other from it, and is tried again by the next run
    into the same folder.

    Parameters
    ----------
    directory : path
        Of the challenge.
    folder : path
        For the results: a new or empty one, or that of a run with the same options.
    options : MeasureOptions
        How to measure.
    cell : int, optional
        Pixels on a side of a cell, if the directory does not say.
    jobs, scheduler
        Who measures: see `fdnt_xp.app.workers.open_workers`. Workers of a cluster must see
        directory and folder under the same names.
    quiet : bool
        No progress bar; there is none either where stderr is not a terminal.

    Raises
    ------
    CatalogError
        If the directory holds no challenge; if the folder holds something else, or a run
        with other options; if the submission cannot be written.
    FdntValueError, MissingExtraError
        If the workers or the backend are not to be had.
    """
    start = time.perf_counter()
    challenge = read_challenge(Path(directory).absolute(), cell=cell)
    folder = Path(folder).absolute()
    with open_workers(jobs, scheduler) as workers:
        if scheduler is None:  # else it is not this machine that needs them
            load_backend(options.backend, options.device, options.dtype)
        _begin(folder, _facts(challenge, options, cell))
        results = {one.name: _read_result(folder, one) for one in challenge.sets}
        finished = {name: result for name, result in results.items() if result is not None}
        n_before = len(finished)
        failures = _unreadable(challenge)
        waiting = [one for one in challenge.sets if one.name not in finished]
        job = partial(finish_set, options=options, folder=folder)
        bar = tqdm(
            total=len(challenge.sets),
            initial=n_before,
            unit=" sets",
            leave=False,
            disable=quiet or not sys.stderr.isatty(),
        )
        try:
            with bar:
                for one, result in workers.each(job, waiting):
                    if isinstance(result, Failure):
                        failures[one.name] = result.reason
                    else:
                        finished[one.name] = result
                        _pass_on(result)
                    bar.update()
        finally:
            tidy(folder, _UNFINISHED)
    ordered = sorted(finished.values(), key=lambda result: result.number)
    _write_submissions(ordered, options, folder)
    return MeasureReport(
        challenge=challenge,
        folder=folder,
        results=tuple(ordered),
        n_before=n_before,
        failures=failures,
        seconds=time.perf_counter() - start,
    )


def finish_set(one: ChallengeSet, options: MeasureOptions, folder: Path) -> SetResult | Failure:
    """Measure a set and write its catalog, then its result, each whole or not at all."""
    try:
        table, result = measure_set(one, options)
        write_catalog(table, folder / "catalogs" / f"{one.name}.fits", overwrite=True)
        write_json(result.to_dict(), str(_result_path(folder, one)), overwrite=True)
    except Exception as error:
        # Whatever is wrong with a set, a device or a disc: the other sets are measured.
        return Failure(_reason(error))
    return result


def _reason(error: Exception) -> str:
    """Return an error as one line; with its kind and place if it was not foreseen."""
    text = " ".join(str(error).split())
    if isinstance(error, FdntError):
        return text
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {text} ({Path(place.filename).name}, line {place.lineno})"


def report_lines(report: MeasureReport) -> Iterator[str]:
    """Yield the shears, how many sets were measured, and what to do next."""
    yield f"{'set':<9}{'estimator':<13}{'g1':>10}{'+-':>9}{'g2':>10}{'+-':>9}{'used':>8}"
    for result in report.results:
        for shear in result.shears:
            yield (
                f"{result.name:<9}{shear.estimator:<13}{shear.g1:>+10.5f}{shear.g1_err:>9.5f}"
                f"{shear.g2:>+10.5f}{shear.g2_err:>9.5f}{shear.n_used:>8d}"
            )
    n_new = len(report.results) - report.n_before
    before = f", {report.n_before} before" if report.n_before else ""
    yield f"sets       {n_new} measured{before}, {len(report.failures)} failed"
    yield f"time       {report.seconds:.1f} s"
    for result in report.results:
        for shear in result.shears:
            if shear.failure is not None:
                yield f"no shear   {result.name} {shear.estimator}: {shear.failure}"
    yield f"written    {report.folder / SUBMISSION}"
    truth = report.challenge.directory / "truth.ecsv"
    named = truth if truth.is_file() else "TRUTH"
    if report.results:
        yield f"next       fdnt-xp great08 score {report.folder} --truth {named}"


def failure_lines(report: MeasureReport) -> Iterator[str]:
    """Yield a line for each set that was not measured."""
    for name, reason in sorted(report.failures.items()):
        yield f"failed     {name}: {reason}"


def _facts(challenge: Challenge, options: MeasureOptions, cell: int | None) -> dict[str, Any]:
    """Return what must be the same when a run is resumed, as it comes back from JSON."""
    facts = {"directory": str(challenge.directory), "cell": cell, **asdict(options)}
    facts["estimator"] = ",".join(facts.pop("estimators"))
    return facts


def _begin(folder: Path, facts: dict[str, Any]) -> None:
    """Make the folder of a run, or see that it is one that can be resumed."""
    begin_run(
        folder,
        facts,
        command="great08 measure",
        remedy="choose another folder",
        shown={"directory": "DIR"},
        unfinished=_UNFINISHED,
    )
    for name in ("catalogs", "sets"):
        make_folder(folder / name)


def _read_result(folder: Path, one: ChallengeSet) -> SetResult | None:
    """Return the result of a set that is finished."""
    path = _result_path(folder, one)
    if not path.exists():
        return None
    try:
        return SetResult.from_dict(read_json(path))
    except (KeyError, TypeError) as error:
        raise CatalogError(f"{path} is not what was written: remove it") from error


def _result_path(folder: Path, one: ChallengeSet) -> Path:
    return folder / "sets" / f"{one.name}.json"


def _unreadable(challenge: Challenge) -> dict[str, str]:
    """Return the sets without an image, and images without a PSF, with what is wrong."""
    missing = {set_name(number): "the image is missing" for number in challenge.missing}
    return missing | dict.fromkeys(challenge.unmapped, "the PSF map names no PSF for it")


def _pass_on(result: SetResult) -> None:
    """Say here what was warned of where the set was measured."""
    for text in result.warnings:
        warnings.warn(f"{result.name}: {text}", FdntWarning, stacklevel=3)


def _write_submissions(results: list[SetResult], options: MeasureOptions, folder: Path) -> None:
    table = submission_table(row for result in results for row in result.rows())
    write_submission(table, folder / SUBMISSION, overwrite=True)
    if results:
        for name in options.estimators:
            write_text_submission(table, name, folder / f"{name}.txt", overwrite=True)
