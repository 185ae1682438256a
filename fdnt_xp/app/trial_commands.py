"""Commands that try the methods on drawn galaxies: biases with and without noise, and speed."""

from __future__ import annotations

from typing import Any

import click

from fdnt_xp.app.bench import BenchOptions, run_bench
from fdnt_xp.app.check import CheckOptions, run_check
from fdnt_xp.app.command import OVERWRITE, WHERE, Command
from fdnt_xp.app.psf_check import OWN, OwnOptions, refuse_without_psf, run_psf_check
from fdnt_xp.app.ring import RingOptions, run_ring
from fdnt_xp.data.noise_estimators import ESTIMATORS
from fdnt_xp.data.versions import KINDS


@click.command(cls=Command)
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


@click.command(cls=Command)
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


@click.command(cls=Command)
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
