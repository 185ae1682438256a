"""The command `fdnt-xp measure-exposures`: its options, and what it says."""

from __future__ import annotations

from typing import Any

import click

from fdnt_xp.app.command import JOBS, OVERWRITE, WHERE, Command
from fdnt_xp.app.exposures import METHODS, ExposureInputs, ExposureSettings, measure_exposure_files
from fdnt_xp.app.summary import summary_lines
from fdnt_xp.app.workers import warn_of_too_many
from fdnt_xp.data.meds import SEGMENTS
from fdnt_xp.data.meds_index import CUTOUTS


@click.command(name="measure-exposures", cls=Command)
@click.argument("files", metavar="FILE...", nargs=-1, required=True)
@click.option(
    "-o",
    "--output",
    required=True,
    metavar="CATALOG",
    help="Catalog to write: .fits, .ecsv, .parquet or .hdf5.",
)
@click.option(
    "--method",
    type=click.Choice(list(METHODS)),
    default="fdnt-ft",
    show_default=True,
    help="fdnt-ft leaves out exposures with missing pixels, fdnt-hybrid fills these.",
)
@click.option(
    "--cutouts",
    type=click.Choice(CUTOUTS),
    default="all",
    show_default=True,
    help="Those of an object to use; 'epochs' leaves out the first, which most surveys cut "
    "from the coadd of the others.",
)
@click.option(
    "--bad-bits",
    type=click.IntRange(min=0),
    metavar="BITS",
    help="Sum of the bits of bmask_cutouts that make a pixel missing. [default: every bit]",
)
@click.option(
    "--segments",
    type=click.Choice(SEGMENTS),
    default="mask",
    show_default=True,
    help="Whether pixels of other objects in seg_cutouts are missing.",
)
@click.option(
    "--psf", metavar="FILE", help="Image of a star, for all exposures. [default: those in FILE]"
)
@click.option(
    "--noise-variance", type=float, metavar="V", help="Of one pixel, for files without weights."
)
@JOBS
@WHERE
@click.option(
    "--oversampling",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="PSF pixels per image pixel, along one axis.",
)
@click.option(
    "--size",
    type=float,
    metavar="LENGTH",
    help="Size (sigma) of the weight, in units of the sky. [default: solved for each object]",
)
@click.option(
    "--chunk",
    type=click.IntRange(min=1),
    metavar="N",
    help="Objects at a time, at most. [default: 1024, on a GPU 8192, and less if they are large]",
)
@click.option("-q", "--quiet", is_flag=True, help="No progress bar and no summary.")
@OVERWRITE
def measure_exposures_command(
    files: tuple[str, ...],
    output: str,
    cutouts: Any,
    bad_bits: int | None,
    segments: Any,
    psf: str | None,
    noise_variance: float | None,
    jobs: int,
    scheduler: str | None,
    overwrite: bool,
    **how: Any,
) -> None:
    """Measure the objects of MEDS files, one shape from all exposures of each.

    Each FILE is a multi-epoch data structure of one band, as FITS, packed or not; several are
    of the same objects. Shapes are those on the sky.

    A command that was interrupted, or killed, goes on where it ended if it is given again, as
    measure does.
    """
    inputs = ExposureInputs(
        files=files,
        psf=psf,
        cutouts=cutouts,
        bad_bits=bad_bits,
        segments=segments,
        noise_variance=noise_variance,
    )
    settings = ExposureSettings(**how)
    warn_of_too_many(jobs)
    report = measure_exposure_files(
        inputs, settings, output, overwrite=overwrite, jobs=jobs, scheduler=scheduler
    )
    if not settings.quiet:
        for line in summary_lines(report.kept, report.seconds, report.n_before):
            click.echo(line)
        click.echo(f"written    {output}")
