"""What a run says at its end: how many were measured, why not the others, the mean."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.errors import FdntValueError
from fdnt_xp.flags import FAILED, Flag, flag_text
from fdnt_xp.shears.from_responses import shear_from_responses
from fdnt_xp.shears.responses import COLUMNS

if TYPE_CHECKING:
    from astropy.table import Table


def measured_rows(table: Table) -> NDArray[np.bool_]:
    """Return where a catalog has a shape."""
    flags: NDArray[np.int64] = np.asarray(table["flags"], dtype=np.int64)
    good: NDArray[np.bool_] = (flags & int(FAILED)) == 0
    return good


def is_of_responses(table: Table) -> bool:
    """Return whether it is a catalog of responses to shear, and not one of shapes."""
    return set(COLUMNS) <= set(table.colnames) and "RSTEP" in table.meta


def count_flags(table: Table) -> dict[str, int]:
    """Return how many galaxies have each flag that occurs, lowest bit first."""
    flags = np.asarray(table["flags"])
    counts = {str(flag.name): int(np.sum((flags & int(flag)) != 0)) for flag in Flag}
    return {name: count for name, count in counts.items() if count}


def mean_and_error(values: NDArray[Any]) -> tuple[float, float]:
    """Return the mean and its standard error; NaN where there are too few for one."""
    mean = float(np.mean(values)) if len(values) else math.nan
    error = float(np.std(values, ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else math.nan
    return mean, error


def summary_lines(table: Table, seconds: float | None = None, n_before: int = 0) -> Iterator[str]:
    """Yield the lines of the closing summary.

    Parameters
    ----------
    table : astropy.table.Table
        The catalog.
    seconds : float, optional
        That measuring took,
    n_before : int
        of all galaxies but these, which were measured before.
    """
    good = measured_rows(table)
    n_gal, n_good = len(table), int(np.sum(good))
    share = f" ({n_good / n_gal:.2%})" if n_gal else ""
    yield f"measured   {n_good} of {n_gal} galaxies{share}"
    if n_before:
        yield f"resumed    {n_before} of them were measured before"
    if seconds is not None and n_gal > n_before:
        each = 1e3 * seconds / (n_gal - n_before)
        yield f"time       {seconds:.1f} s, {each:.3g} ms per galaxy"
    counts = count_flags(table)
    for title, failed in (("failed", True), ("noted", False)):
        for name, count in counts.items():
            if bool(Flag[name] & FAILED) is failed:
                yield f"{title:<10} {count:>6}  {name}: {flag_text(name)}"
                title = ""
    if n_good:
        yield mean_line(table)


def mean_line(table: Table) -> str:
    """Return the mean of a catalog and its error: the shape, or with responses the shear."""
    if not is_of_responses(table):
        good = table[measured_rows(table)]
        e = [mean_and_error(np.asarray(good[name])) for name in ("e1", "e2")]
        return f"mean shape {_components('e', e)}"
    try:
        shear = shear_from_responses(table)
    except FdntValueError as error:
        return f"mean shear cannot be told: {error}"
    g = [(float(shear.g[i]), float(shear.g_err[i])) for i in (0, 1)]
    return f"mean shear {_components('g', g)}"


def _components(symbol: str, measured: list[tuple[float, float]]) -> str:
    return ", ".join(f"{symbol}{i + 1} = {format_measured(*one)}" for i, one in enumerate(measured))


def format_measured(value: float, error: float) -> str:
    """Return "value ± error", the error with two figures.

    Examples
    --------
    >>> format_measured(0.0201234, 0.000312)
    '+0.02012 ± 0.00031'
    """
    if not (math.isfinite(error) and error > 0):
        return f"{value:+.5g}"
    digits = max(0, 1 - math.floor(math.log10(error)))
    return f"{value:+.{digits}f} ± {error:.{digits}f}"
