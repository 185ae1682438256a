"""The commands `fdnt-xp great08 ...`."""

from __future__ import annotations

from typing import Any

import click

from fdnt_xp.app.command import OVERWRITE, WHERE, Command
from fdnt_xp.app.great08_measure import ESTIMATORS, MeasureOptions
from fdnt_xp.app.great08_run import failure_lines, measure_challenge, report_lines
from fdnt_xp.app.great08_score import ScoreOptions, run_score
from fdnt_xp.app.great08_simulate import run_simulate
from fdnt_xp.great08.answers import ERRORS
from fdnt_xp.great08.great3 import DAMPING
from fdnt_xp.great08.populations import BRANCHES, Branch
from fdnt_xp.great08.score import GROUPINGS
from fdnt_xp.great08.sets import MAX_SHEAR, PSF_KINDS, make_simulation

_SCHEDULER = click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Let the workers of a Dask cluster do it: tcp://host:8786.",
)


@click.group()
def great08() -> None:
    """Simulate, measure and score directories of the GREAT08 challenge."""


@great08.command(cls=Command)
@click.argument("directory", metavar="DIR")
@click.option("-o", "--output", required=True, metavar="OUT", help="Folder for the results.")
@click.option(
    "--estimator",
    "estimators",
    multiple=True,
    type=click.Choice([*ESTIMATORS, "all"]),
    default=["null"],
    show_default=True,
    help="Of the shear; may be repeated.",
)
@click.option(
    "--method",
    default="fdnt-ft",
    show_default=True,
    help="Shape method of the catalogs; other ones go with --estimator responsivity alone.",
)
@click.option(
    "--cell", type=click.IntRange(min=1), metavar="N", help="Pixels a side. [default: as DIR says]"
)
@click.option(
    "--noise-variance",
    type=float,
    metavar="V",
    help="Of one pixel. [default: measured on the borders of the stamps, set by set]",
)
@click.option(
    "--seed", type=int, default=0, show_default=True, help="Of the noise that the nulls add."
)
@click.option(
    "--chunk",
    type=click.IntRange(min=1),
    metavar="N",
    help="Galaxies at a time. [default: what suits each step]",
)
@click.option(
    "--jobs",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    metavar="N",
    help="Sets at a time, each in a process of its own with one thread.",
)
@_SCHEDULER
@click.option("-q", "--quiet", is_flag=True, help="No progress bar and no summary.")
@WHERE
def measure(
    directory: str,
    output: str,
    estimators: tuple[str, ...],
    cell: int | None,
    jobs: int,
    scheduler: str | None,
    quiet: bool,
    **options: Any,
) -> None:
    """Measure the sets of DIR: a catalog and the shear of each, and one submission.

    A run that was interrupted, or killed, is resumed by the same command: what is finished
    is not done again. Sets that cannot be read or measured are named at the end, the others
    are done all the same, and the exit code is 1.
    """
    names = tuple(ESTIMATORS) if estimators == ("all",) else estimators
    report = measure_challenge(
        directory,
        output,
        MeasureOptions(estimators=names, **options),
        cell=cell,
        jobs=jobs,
        scheduler=scheduler,
        quiet=quiet,
    )
    if not quiet:
        for line in report_lines(report):
            click.echo(line)
    for line in failure_lines(report):
        click.echo(line, err=True)
    if report.failures:
        click.get_current_context().exit(1)


@great08.command(cls=Command)
@click.option(
    "--branch",
    type=click.Choice(BRANCHES),
    default="low-noise",
    show_default=True,
    help="Part of the challenge.",
)
@click.option(
    "--sets", "n_sets", type=int, metavar="N", help="Images. [default: 15; real-noise 27]"
)
@click.option("--grid", type=int, default=100, show_default=True, help="Cells on a side; even.")
@click.option("--cell", type=int, default=64, show_default=True, help="Pixels a side of a cell.")
@click.option(
    "--snr",
    type=float,
    metavar="S/N",
    help="sqrt(sum I^2)/sigma. [default: 200; real-noise 20, and half and twice that]",
)
@click.option("--seed", type=int, default=1, show_default=True, help="Of everything random.")
@click.option(
    "--shears",
    "n_shears",
    type=int,
    metavar="N",
    help="Different root shears. [default: one for each set; real-noise for each nine]",
)
@click.option(
    "--max-shear",
    type=float,
    default=MAX_SHEAR,
    show_default=True,
    help="Root shears are uniform in the disc |g| up to this.",
)
@click.option(
    "--psf-kind",
    type=click.Choice(PSF_KINDS),
    default="star",
    show_default=True,
    help="PSF as the image of a star, or by its formula.",
)
@click.option(
    "--oversampling",
    type=int,
    default=1,
    show_default=True,
    help="Pixels of the star per pixel of the galaxies, along one axis.",
)
@click.option("--jobs", type=int, default=1, show_default=True, help="Processes.")
@_SCHEDULER
@click.option("-o", "--output", required=True, metavar="DIR", help="Folder to make or to go on in.")
@click.option("-q", "--quiet", is_flag=True, help="No progress bar and no report.")
def simulate(
    branch: Branch,
    output: str,
    jobs: int,
    scheduler: str | None,
    quiet: bool,
    **options: Any,
) -> None:
    """Draw a directory like those of the challenge, with the truth.

    An interrupted command goes on where it ended if it is given again; what comes out depends
    neither on that nor on --jobs.
    """
    simulation = make_simulation(branch, **options)
    for line in run_simulate(output, simulation, jobs=jobs, scheduler=scheduler, quiet=quiet):
        if not quiet:
            click.echo(line)


@great08.command(cls=Command)
@click.argument("outputs", metavar="OUT...", nargs=-1, required=True)
@click.option(
    "--truth",
    "truths",
    required=True,
    multiple=True,
    metavar="TABLE",
    help="True shears; once for all of OUT, or once for each.",
)
@click.option(
    "--estimator",
    "estimators",
    multiple=True,
    metavar="NAME",
    help="Whose answers; may be repeated. [default: all]",
)
@click.option(
    "--group-by",
    type=click.Choice(GROUPINGS),
    default="shear",
    show_default=True,
    help="What sets share whose residuals are averaged before they are squared.",
)
@click.option(
    "--columns",
    multiple=True,
    metavar="NAME=COLUMN,...",
    help="Which columns of TABLE are set, shear, g1, g2.",
)
@click.option(
    "--psf-angle",
    type=float,
    metavar="DEGREES",
    help="Of the major axis of all PSFs, from +x. [default: from psf_e1, psf_e2 of TABLE]",
)
@click.option(
    "--great3",
    type=click.Choice(list(DAMPING)),
    default="ground",
    show_default=True,
    help="Kind of branch for the Q_c of GREAT3.",
)
@click.option("--allow-missing", is_flag=True, help="Leave out sets that lack answer or truth.")
@click.option(
    "--errors",
    type=click.Choice(ERRORS),
    default="noise",
    show_default=True,
    help="Which errors of the answers count: by the noise of the pixels, all, or none.",
)
@click.option("--json", "output", metavar="JSON", help="Numbers to write: .json.")
@click.option("--plot", "figure", metavar="FIGURE", help="Plot to write: .png, .pdf or .svg.")
@OVERWRITE
def score(output: str | None, figure: str | None, overwrite: bool, **options: Any) -> None:
    """Compare the shears of a submission with the truth.

    OUT is a folder that measure wrote, or the file submission.ecsv of one; several are
    independent runs that are pooled. Prints for each estimator the quality Q, what perfect
    answers would get, and the biases m and c of both components with errors.
    """
    for line in run_score(ScoreOptions(**options), output, figure, overwrite=overwrite):
        click.echo(line)
