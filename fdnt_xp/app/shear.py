"""What `fdnt-xp shear` does: the shear of a catalog of responses, or of a part of it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Final

from fdnt_xp.app.summary import format_measured, is_of_responses
from fdnt_xp.errors import CatalogError, FdntValueError
from fdnt_xp.shears.cuts import QUANTITIES, Cut
from fdnt_xp.shears.estimate import ShearEstimate
from fdnt_xp.shears.from_responses import shear_from_responses

if TYPE_CHECKING:
    from astropy.table import Table

_CUT: Final = re.compile(r"\s*(\w+)\s*([<>])\s*(\S+)\s*")


def catalog_shear(table: Table, cuts: Sequence[str] = ()) -> ShearEstimate:
    """Return the shear of the galaxies of a catalog that pass all cuts.

    Parameters
    ----------
    table : astropy.table.Table
        Of `fdnt-xp measure --responses`.
    cuts : sequence of str
        As `parse_cut` takes them.

    Raises
    ------
    CatalogError
        If it is another table.
    FdntValueError
        If a cut is not understood, or leaves fewer than two galaxies.
    """
    if not is_of_responses(table):
        raise CatalogError("this is no catalog of fdnt-xp measure --responses: it has no responses")
    return shear_from_responses(table, cut=[parse_cut(cut) for cut in cuts] or None)


def parse_cut(text: str) -> Cut:
    """Return the cut that `NAME>VALUE` or `NAME<VALUE` means.

    Examples
    --------
    >>> parse_cut("snr>15")
    Cut(quantity='snr', low=15.0, high=None, width=0.0)
    """
    match = _CUT.fullmatch(text)
    try:
        if match is None:
            raise ValueError(text)
        value = float(match[3])
    except ValueError:
        raise FdntValueError(
            f"the cut {text!r} is not NAME>VALUE or NAME<VALUE, as in snr>15; names are "
            f"{', '.join(QUANTITIES)}"
        ) from None
    if match[2] == ">":
        return Cut(quantity=match[1], low=value)
    return Cut(quantity=match[1], high=value)


def report_lines(estimate: ShearEstimate, n_gal: int) -> Iterator[str]:
    """Yield the shear, and how many of the galaxies of the catalog it is of."""
    unmeasured = n_gal - estimate.n_used - estimate.n_excluded
    yield (
        f"galaxies   {estimate.n_used} of {n_gal}: "
        f"{estimate.n_excluded} cut, {unmeasured} not measured"
    )
    for i in (0, 1):
        yield f"g{i + 1}         {format_measured(float(estimate.g[i]), float(estimate.g_err[i]))}"
