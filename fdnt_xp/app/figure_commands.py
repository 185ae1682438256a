"""The commands `fdnt-xp figure ...`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

from fdnt_xp.app.command import OVERWRITE, WHERE, Command, options
from fdnt_xp.app.gradient_figure import GradientFigure, draw_gradient_figure
from fdnt_xp.app.underfitting_figure import UnderfittingFigure, draw_underfitting_figure

_F = TypeVar("_F", bound=Callable[..., Any])


def _files(figure: str) -> Callable[[_F], _F]:
    """Return the options of what is written: the figure, and its numbers."""
    return options(
        click.option(
            "-o",
            "--output",
            default=figure,
            show_default=True,
            metavar="FIGURE",
            help=".png, .pdf or .svg.",
        ),
        click.option(
            "--table", metavar="TABLE", help="Numbers to write: .json, .ecsv, .fits, .parquet."
        ),
    )


@click.group(name="figure")
def figures() -> None:
    """Draw the figures of the documentation, from nothing."""


@figures.command(name="ellipticity-gradient", cls=Command)
@_files("ellipticity-gradient.png")
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
@_files("underfitting.png")
@click.option("--stamp", type=int, default=128, show_default=True, help="Pixels on a side.")
@click.option("--padding", type=int, default=1, show_default=True, help="Makes the k grid finer.")
@WHERE
@OVERWRITE
def underfitting(output: str, table: str | None, overwrite: bool, **options: Any) -> None:
    """Bias and noise of NB07, FDNT-GL and FDNT-FT on Sersic galaxies, as in Bernstein 2010."""
    figure = UnderfittingFigure(**options)
    draw_underfitting_figure(figure, output, table, overwrite=overwrite, say=click.echo)
