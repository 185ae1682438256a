"""The command `fdnt-xp`: measure an image, plot a catalog, see a demonstration."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

import fdnt_xp
from fdnt_xp.app.bench import BenchOptions, run_bench
from fdnt_xp.app.check import CheckOptions, run_check
from fdnt_xp.app.command import HOW, JOBS, OVERWRITE, WHERE, Command
from fdnt_xp.app.demo import Field, run_demo
from fdnt_xp.app.exposures_command import measure_exposures_command
from fdnt_xp.app.gradient_figure import GradientFigure, draw_gradient_figure
from fdnt_xp.app.great08_commands import great08
from fdnt_xp.app.measure import Inputs, Settings
from fdnt_xp.app.measure_run import measure_files
from fdnt_xp.app.plots import check_figure, plot_catalog, save_figure
from fdnt_xp.app.psf_check import OWN, OwnOptions, refuse_without_psf, run_psf_check
from fdnt_xp.app.ring import RingOptions, run_ring
from fdnt_xp.app.shear import catalog_shear, report_lines
from fdnt_xp.app.summary import summary_lines
from fdnt_xp.app.underfitting_figure import UnderfittingFigure, draw_underfitting_figure
from fdnt_xp.app.workers import warn_of_too_many
from fdnt_xp.data.catalog import read_catalog
from fdnt_xp.data.noise_estimators import ESTIMATORS
from fdnt_xp.data.versions import KINDS


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(fdnt_xp.__version__, prog_name="fdnt-xp")
def main() -> None:
    """Shapes of galaxies for weak lensing, by Fourier-domain null tests."""


@main.command(cls=Command)
@click.argument("image")
@click.option("--psf", required=True, metavar="FILE", help="Image of a star, or a cube of them.")
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


@main.command(cls=Command)
@click.option(
    "--galaxy",
    default="vb-spiral",
    show_default=True,
    metavar="GALAXY",
    help="vb-spiral, orthogonal, torture, or sersic:N,HLR,E.",
)
@click.option(
    "--psf",
    default="gaussian:2,0.1,0.05",
    show_default=True,
    metavar="PSF",
    help="gaussian:HLR,E1,E2 or moffat:BETA,FWHM,E1,E2.",
)
@click.option("--delta-eta", type=float, default=0.02, show_default=True, help="Applied, along x.")
@click.option("--angles", type=int, default=16, show_default=True, help="Angles over half a turn.")
@click.option("--stamp", type=int, default=128, show_default=True, help="Pixels on a side.")
@click.option("--padding", type=int, default=1, show_default=True, help="Makes the k grid finer.")
@click.option("--pixel", is_flag=True, help="Draw the pixel in addition to the PSF.")
@click.option("--method", default="fdnt-ft", show_default=True, help="Shape method.")
@click.option("-o", "--output", metavar="JSON", help="Result to write: .json.")
@click.option("--plot", "figure", metavar="FIGURE", help="Plot to write: .png, .pdf or .svg.")
@WHERE
@OVERWRITE
def ring(output: str | None, figure: str | None, overwrite: bool, **options: Any) -> None:
    """Turn a galaxy through all angles, shear it, and see what shear comes back.

    Prints the multiplicative and additive bias of each estimator of shear. Lengths are in
    pixels, shapes are distortions (a^2-b^2)/(a^2+b^2), the shear is conformal (eta).
    """
    for line in run_ring(RingOptions(**options), output, figure, overwrite=overwrite):
        click.echo(line)


@main.command(cls=Command)
@click.option(
    "--snr",
    default="10,15,20,50",
    show_default=True,
    metavar="S/N,...",
    help="sqrt(<sum I^2>)/sigma.",
)
@click.option(
    "--kind", type=click.Choice(KINDS), help="Galaxies to draw. [default: exp; with --psf exp, dev]"
)
@click.option(
    "--radius",
    metavar="PIXELS",
    help="Half-light radius, or LOW,HIGH. [default: 2.3; for mixed 1.3,2.3]",
)
@click.option("--psf", metavar="FITS", help="Your PSF, in place of a Moffat.")
@click.option("--oversampling", type=float, default=1.0, show_default=True, help="Of --psf.")
@click.option("--pixel", is_flag=True, help="--psf lacks the response of the pixels.")
@click.option("--noise-variance", type=float, help="With --psf: says the flux of each S/N.")
@click.option("--noise-image", metavar="FITS", help="With --psf: blank sky, for its spectrum.")
@click.option(
    "--psf-e", type=float, default=0.1, show_default=True, help="e1 of the Moffat; e2 is half."
)
@click.option("--shear", type=float, default=0.02, show_default=True, help="Applied g, along x.")
@click.option(
    "--estimator",
    "estimators",
    multiple=True,
    default=["null"],
    show_default=True,
    metavar="NAME,...",
    help=f"One or more of {', '.join(ESTIMATORS)}.",
)
@click.option("--galaxies", type=int, default=1024, show_default=True, help="Different ones.")
@click.option(
    "--stamps",
    type=int,
    default=100_000,
    show_default=True,
    help="Noisy stamps to measure for each S/N with each estimator.",
)
@click.option(
    "--batch",
    type=int,
    default=1024,
    show_default=True,
    help="Galaxies, each 8 stamps, that make one m; the scatter of m makes the error.",
)
@click.option("--padding", type=int, default=1, show_default=True, help="Makes the k grid finer.")
@click.option("--seed", type=int, default=0, show_default=True, help="Of everything random.")
@click.option("-o", "--output", metavar="JSON", help="Results to write: .json.")
@click.option("--plot", "figure", metavar="FIGURE", help="Plot to write: .png, .pdf or .svg.")
@WHERE
@OVERWRITE
def check(output: str | None, figure: str | None, overwrite: bool, **options: Any) -> None:
    """Put noise on galaxies of known shear, and see what bias it makes.

    Prints the multiplicative and additive bias of each estimator of shear at each S/N, with
    errors, and the error of the shear from one galaxy. Fractions of a per cent want 100 000
    stamps and more at low S/N. With --psf it says whether the population null, and the errors
    of shears and shapes, are to be trusted with your PSF and noise.
    """
    own = {name: options.pop(name) for name in OWN}
    kind = options.pop("kind")
    if own["psf"] is None:
        refuse_without_psf(own)
        lines = run_check(
            CheckOptions(kind=kind or "exp", **options), output, figure, overwrite=overwrite
        )
    else:
        kinds = ("exp", "dev") if kind is None else (kind,)
        lines = run_psf_check(
            OwnOptions(kinds=kinds, **own),
            CheckOptions(**options),
            output,
            figure,
            overwrite=overwrite,
        )
    for line in lines:
        click.echo(line)


@main.command(cls=Command)
@WHERE
@click.option(
    "--threads", type=int, default=1, show_default=True, help="At most the cores there are."
)
@click.option("--n", type=int, metavar="N", help="Galaxies. [default: 1024, on a GPU 65536]")
@click.option("--stamp-size", type=int, default=48, show_default=True, help="Pixels on a side.")
@click.option("--snr", type=float, default=200.0, show_default=True, help="Signal to noise.")
@click.option(
    "--seconds",
    type=float,
    default=40.0,
    show_default=True,
    help="When to begin no further round; one there is.",
)
@click.option("--markdown", is_flag=True, help="Print the table as Markdown.")
@click.option("-o", "--output", metavar="JSON", help="Numbers to write: .json.")
@OVERWRITE
def bench(output: str | None, markdown: bool, overwrite: bool, **options: Any) -> None:
    """Time the measurements on this machine, in a minute.

    Each is compared with one batched FFT of the same stamps, timed beside it in every round:
    such a ratio does not depend on how busy the machine is.
    """
    lines = run_bench(BenchOptions(**options), output, markdown=markdown, overwrite=overwrite)
    for line in lines:
        click.echo(line)


main.add_command(great08)
main.add_command(measure_exposures_command)


@main.group(name="figure")
def figures() -> None:
    """Draw the figures of the documentation, from nothing."""


@figures.command(name="ellipticity-gradient", cls=Command)
@click.option(
    "-o",
    "--output",
    default="ellipticity-gradient.png",
    show_default=True,
    metavar="FIGURE",
    help=".png, .pdf or .svg.",
)
@click.option("--table", metavar="TABLE", help="Numbers to write: .json, .ecsv, .fits, .parquet.")
@click.option("--delta-eta", type=float, default=0.02, show_default=True, help="Applied, along x.")
@click.option("--points", type=click.IntRange(min=2), default=9, show_default=True, help="PSFs.")
@click.option("--angles", type=int, default=16, show_default=True, help="Angles over half a turn.")
@click.option("--stamp", type=int, default=192, show_default=True, help="Pixels on a side.")
@click.option("--padding", type=int, default=2, show_default=True, help="Makes the k grid finer.")
@WHERE
@OVERWRITE
def ellipticity_gradient(output: str, table: str | None, overwrite: bool, **options: Any) -> None:
    """Ring tests of the three galaxies of Bernstein 2010, against the size of the PSF."""
    figure = GradientFigure(**options)
    draw_gradient_figure(figure, output, table, overwrite=overwrite, say=click.echo)


@figures.command(name="underfitting", cls=Command)
@click.option(
    "-o",
    "--output",
    default="underfitting.png",
    show_default=True,
    metavar="FIGURE",
    help=".png, .pdf or .svg.",
)
@click.option("--table", metavar="TABLE", help="Numbers to write: .json, .ecsv, .fits, .parquet.")
@click.option("--stamp", type=int, default=128, show_default=True, help="Pixels on a side.")
@click.option("--padding", type=int, default=1, show_default=True, help="Makes the k grid finer.")
@WHERE
@OVERWRITE
def underfitting(output: str, table: str | None, overwrite: bool, **options: Any) -> None:
    """Bias and noise of NB07, FDNT-GL and FDNT-FT on Sersic galaxies, as in Bernstein 2010."""
    figure = UnderfittingFigure(**options)
    draw_underfitting_figure(figure, output, table, overwrite=overwrite, say=click.echo)
