"""What the commands share: how their errors are shown, and options that several take."""

from __future__ import annotations

import signal
import warnings
from collections.abc import Callable
from types import FrameType
from typing import Any, TextIO, TypeVar

import click

from fdnt_xp.app.backends import BACKENDS, DTYPES
from fdnt_xp.errors import FdntError, FdntWarning

_F = TypeVar("_F", bound=Callable[..., Any])
_INTERRUPTED = 130
"""Exit code of a command that Ctrl-C ended, as shells have it."""


class Command(click.Command):
    """A command whose foreseen errors, warnings and interrupts are one plain line each."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command."""
        previous = signal.signal(signal.SIGTERM, _terminate)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("always", FdntWarning)
                warnings.showwarning = _show_warning
                return super().invoke(ctx)
        except FdntError as error:
            raise click.ClickException(" ".join(str(error).split())) from error
        except MemoryError as error:
            reason = " ".join(str(error).split()) or "no more memory"
            raise click.ClickException(f"out of memory: {reason}") from error
        except KeyboardInterrupt as interrupt:
            kept = str(interrupt) or "nothing unfinished was left behind"
            click.echo(f"Interrupted: {kept}.", err=True)
            ctx.exit(_INTERRUPTED)
        finally:
            signal.signal(signal.SIGTERM, previous)


def _terminate(_number: int, _frame: FrameType | None) -> None:
    """Let a polite kill end like Ctrl-C, so that temporary files are removed."""
    raise KeyboardInterrupt


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,  # noqa: ARG001  the signature is Python's
    lineno: int,  # noqa: ARG001
    file: TextIO | None = None,  # noqa: ARG001
    line: str | None = None,  # noqa: ARG001
) -> None:
    # Warnings of other libraries are about their code, not about the user's galaxies.
    if issubclass(category, FdntWarning):
        click.echo(f"Warning: {message}", err=True)


def options(*decorators: Callable[[_F], _F]) -> Callable[[_F], _F]:
    """Return the decorators as one; the first is listed first by `--help`."""

    def decorate(function: _F) -> _F:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return decorate


WHERE = options(
    click.option(
        "--backend",
        type=click.Choice(list(BACKENDS)),
        default="numpy",
        show_default=True,
        help="Array library to compute with.",
    ),
    click.option("--device", metavar="NAME", help="cpu, cuda, cuda:1, ... [default: its own]"),
    click.option(
        "--dtype",
        type=click.Choice(DTYPES),
        default="float64",
        show_default=True,
        help="Precision.",
    ),
)
HOW = options(
    WHERE,
    click.option(
        "--oversampling",
        type=click.IntRange(min=1),
        default=1,
        show_default=True,
        help="PSF pixels per image pixel, along one axis.",
    ),
    click.option(
        "--noise-variance",
        type=float,
        metavar="V",
        help="Of one pixel. [default: measured on the borders of the stamps]",
    ),
    click.option(
        "--size",
        type=float,
        metavar="PIXELS",
        help="Size (sigma) of the weight. [default: solved for each galaxy]",
    ),
    click.option(
        "--chunk",
        type=click.IntRange(min=1),
        metavar="N",
        help="Galaxies at a time; bounds the memory. [default: 1024, on a GPU 8192]",
    ),
    click.option("-q", "--quiet", is_flag=True, help="No progress bar and no summary."),
)
JOBS = options(
    click.option(
        "--jobs",
        type=click.IntRange(min=1),
        default=1,
        show_default=True,
        metavar="N",
        help="Processes, each with one thread.",
    ),
    click.option(
        "--scheduler",
        metavar="ADDRESS",
        help="Let the workers of a Dask cluster do it: tcp://host:8786.",
    ),
)
OVERWRITE = click.option("--overwrite", is_flag=True, help="Replace files that exist.")
