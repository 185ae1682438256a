"""The command `fdnt-xp`: measure an image, and what becomes of its catalog.

The other commands are defined elsewhere, and gathered at the end.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

import fdnt_xp
from fdnt_xp.app.command import HOW, JOBS, OVERWRITE, Command
from fdnt_xp.app.demo import Field, run_demo
from fdnt_xp.app.exposures_command import measure_exposures_command
from fdnt_xp.app.figure_commands import figures
from fdnt_xp.app.great08_commands import great08
from fdnt_xp.app.measure import Inputs, Settings
from fdnt_xp.app.measure_run import measure_files
from fdnt_xp.app.plots import check_figure, plot_catalog, save_figure
from fdnt_xp.app.shear import catalog_shear, report_lines
from fdnt_xp.app.summary import summary_lines
from fdnt_xp.app.trial_commands import bench, check, ring
from fdnt_xp.app.workers import warn_of_too_many
from fdnt_xp.data.catalog import read_catalog
from fdnt_xp.data.model_stars import MODELS


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(fdnt_xp.__version__, prog_name="fdnt-xp")
def main() -> None:
    """Shapes of galaxies for weak lensing, by Fourier-domain null tests."""


@main.command(cls=Command)
@click.argument("image")
@click.option("--psf", required=True, metavar="FILE", help="Image of a star, or a cube of them.")
@click.option(
    "--psf-model",
    type=click.Choice(MODELS),
    default="image",
    show_default=True,
    help="What --psf is; a model is drawn at each galaxy.",
)
@click.option("--cell", type=int, metavar="N", help="The image is a grid of N x N pixel cells.")
@click.option("--positions", metavar="TABLE", help="Positions of the galaxies on the image.")
@click.option("--stamp-size", type=int, metavar="N", help="Pixels on a side, with --positions.")
@click.option("--x-column", default="x", show_default=True, help="Column of --positions.")
@click.option("--y-column", default="y", show_default=True, help="Column of --positions.")
@click.option(
    "--origin",
    type=click.Choice(["0", "1"]),
    default="0",
    show_default=True,
    help="Coordinate of the first pixel's centre in --positions; 1 for SExtractor.",
)
@click.option(
    "-o",
    "--output",
    required=True,
    metavar="CATALOG",
    help="Catalog to write: .fits, .ecsv, .parquet or .hdf5.",
)
@click.option(
    "--method",
    default="fdnt-ft",
    show_default=True,
    help="Shape method: fdnt-ft, fdnt-gl, nb07, gauss-1, exponential, ...",
)
@click.option(
    "--responses",
    is_flag=True,
    help="Measure responses to shear, for the command shear, not shapes.",
)
@click.option(
    "--seed",
    type=int,
    default=0,
    show_default=True,
    help="Of the noise that --responses adds to make all noise round.",
)
@click.option(
    "--noise-image",
    metavar="FILE",
    help="Blank sky to measure the noise on: an image, or a cube of stamps.",
)
@click.option(
    "--mask", metavar="FILE", help="Of the shape of IMAGE: not 0 where a pixel is missing."
)
@click.option(
    "--weight",
    metavar="FILE",
    help="Of the shape of IMAGE: the inverse variance of each pixel, 0 where it is missing.",
)
@JOBS
@click.option(
    "--jacobian",
    metavar="DUDX,DUDY,DVDX,DVDY",
    help="Of the pixels: shapes are those on the sky (u, v), lengths in its unit.",
)
@click.option(
    "--wcs", is_flag=True, help="The Jacobian by the header of IMAGE: u west, v north, arcsec."
)
@HOW
@OVERWRITE
def measure(
    image: str,
    psf: str,
    psf_model: str,
    cell: int | None,
    positions: str | None,
    stamp_size: int | None,
    x_column: str,
    y_column: str,
    origin: str,
    output: str,
    noise_image: str | None,
    mask: str | None,
    weight: str | None,
    jobs: int,
    scheduler: str | None,
    jacobian: str | None,
    wcs: bool,
    overwrite: bool,
    **how: Any,
) -> None:
    """Measure the galaxies of IMAGE and write a catalog.

    IMAGE is an image that is a grid of cells (--cell), an image with a table of positions
    (--positions, --stamp-size), or a cube of stamps: FITS or HDF5. FILE.fits[EXT] names an
    extension, FILE.h5::DATASET a dataset.

    A command that was interrupted, or killed, goes on where it ended if it is given again:
    what is finished is in the folder CATALOG.parts, which is removed at the end.
    """
    inputs = Inputs(
        image=image,
        psf=psf,
        psf_model=psf_model,
        cell=cell,
        positions=positions,
        stamp_size=stamp_size,
        x_column=x_column,
        y_column=y_column,
        origin=int(origin),
        noise_image=noise_image,
        mask=mask,
        weight=weight,
        jacobian=jacobian,
        wcs=wcs,
    )
    settings = Settings(**how)
    warn_of_too_many(jobs)
    report = measure_files(
        inputs, settings, output, overwrite=overwrite, jobs=jobs, scheduler=scheduler
    )
    if not settings.quiet:
        for line in summary_lines(report.kept, report.seconds, report.n_before):
            click.echo(line)
        click.echo(f"written    {output}")


@main.command(cls=Command)
@click.argument("catalog")
@click.option(
    "-o", "--output", metavar="FIGURE", help=".png, .pdf or .svg. [default: CATALOG with .png]"
)
@OVERWRITE
def plot(catalog: str, output: str | None, overwrite: bool) -> None:
    """Draw a page about CATALOG: map of the image, histograms, S/N, flags."""
    target = Path(output) if output else Path(catalog).with_suffix(".png")
    check_figure(target, overwrite=overwrite)
    figure = plot_catalog(read_catalog(catalog), Path(catalog).name)
    save_figure(figure, target, overwrite=overwrite)
    click.echo(f"written    {target}")


@main.command(name="shear", cls=Command)
@click.argument("catalog")
@click.option(
    "--cut",
    "cuts",
    multiple=True,
    metavar="CUT",
    help='"snr>15", "size<3", "flux>100"; may be repeated, and all must be passed.',
)
@click.option("--json", "as_json", is_flag=True, help="Print numbers in full, as JSON.")
def mean_shear(catalog: str, cuts: tuple[str, ...], as_json: bool) -> None:
    """Print the shear of the galaxies of CATALOG, from measure --responses.

    What a cut itself does to the shear is taken into account.
    """
    table = read_catalog(catalog)
    estimate = catalog_shear(table, cuts).to_numpy()
    if as_json:
        facts = {"catalog": catalog, "n_gal": len(table), "cuts": cuts}
        click.echo(json.dumps(facts | estimate.to_dict(), indent=2))
        return
    for line in report_lines(estimate, len(table)):
        click.echo(line)


@main.command(cls=Command)
@click.option(
    "-o",
    "--output",
    default="demo",
    show_default=True,
    metavar="FOLDER",
    help="Where everything is written.",
)
@click.option("--image", metavar="FITS", help="Measure this instead of drawing one.")
@click.option("--psf", metavar="FITS", help="Its PSF.")
@click.option("--cell", type=int, default=64, show_default=True, help="Pixels a side of a cell.")
@click.option("--n-side", type=int, default=40, show_default=True, help="Cells along x and y.")
@click.option("--snr", type=float, default=200.0, show_default=True, help="Signal to noise.")
@click.option("--noise-free", is_flag=True, help="Draw no noise.")
@click.option(
    "--shear",
    type=(float, float),
    default=(0.02, -0.01),
    show_default=True,
    metavar="G1 G2",
    help="Shear to apply.",
)
@click.option("--random-shear", is_flag=True, help="Let the seed choose the shear.")
@click.option("--seed", type=int, default=1, show_default=True, help="Of everything random.")
@HOW
@OVERWRITE
def demo(
    output: str,
    image: str | None,
    psf: str | None,
    cell: int,
    n_side: int,
    snr: float,
    noise_free: bool,
    shear: tuple[float, float],
    random_shear: bool,
    seed: int,
    overwrite: bool,
    **how: Any,
) -> None:
    """Draw galaxies with a known shear, measure them, and compare.

    The galaxies are those of the GREAT08 challenge, drawn by GalSim: exponential and de
    Vaucouleurs profiles in pairs at 90 degrees, a truncated Moffat PSF, one shear for all.
    """
    if (image is None) != (psf is None):
        raise click.UsageError("--image and --psf go together")
    inputs = Inputs(image=image, psf=psf, cell=cell) if image and psf else None
    field = Field(
        side=n_side,
        cell=cell,
        snr=None if noise_free else snr,
        shear=None if random_shear else shear,
        seed=seed,
    )
    settings = Settings(**how)

    def say(line: str) -> None:
        if not settings.quiet:
            click.echo(line)

    run_demo(Path(output), field, inputs, settings, overwrite=overwrite, say=say)


for command in (measure_exposures_command, ring, check, bench, great08, figures):
    main.add_command(command)
