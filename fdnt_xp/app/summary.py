"""What a run says at its end: how many were measured, why not the others, the mean shape."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.flags import FAILED, Flag, flag_text

if TYPE_CHECKING:
    from astropy.table import Table


def measured_rows(table: Table) -> NDArray[np.bool_]:
    """Return where a catalog has a shape."""
    flags: NDArray[np.int64] = np.asarray(table["flags"], dtype=np.int64)
    good: NDArray[np.bool_] = (flags & int(FAILED)) == 0
    return good


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


def summary_lines(table: Table, seconds: float | None = None) -> Iterator[str]:
    """Yield the lines of the closing summary."""
    good = measured_rows(table)
    n_gal, n_good = len(table), int(np.sum(good))
    share = f" ({n_good / n_gal:.2%})" if n_gal else ""
    yield f"measured   {n_good} of {n_gal} galaxies{share}"
    if seconds is not None and n_gal:
        yield f"time       {seconds:.1f} s, {1e3 * seconds / n_gal:.3g} ms per galaxy"
    counts = count_flags(table)
    for title, failed in (("failed", True), ("noted", False)):
        for name, count in counts.items():
            if bool(Flag[name] & FAILED) is failed:
                yield f"{title:<10} {count:>6}  {name}: {flag_text(name)}"
                title = ""
    if n_good:
        parts = []
        for component in ("e1", "e2"):
            mean, error = mean_and_error(np.asarray(table[component])[good])
            parts.append(f"{component} = {format_measured(mean, error)}")
        yield f"mean shape {', '.join(parts)}"


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
