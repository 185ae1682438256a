"""The true shears of the sets of a challenge, from a table in any of several formats.

The columns are `set` (number or name of the set), `g1`, `g2` (reduced shear) and `shear`
(number of the root shear, which several sets may share). Any others are kept; those that
`fdnt-xp great08 score` knows are `psf`, `psf_e1`, `psf_e2`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from fdnt_xp.data.tables import read_any
from fdnt_xp.errors import CatalogError
from fdnt_xp.great08.challenge import set_number

TRUTH: Final = "truth.ecsv"
COLUMNS: Final[dict[str, str]] = {
    "set": "number of the image: 1 for set0001",
    "shear": "number of the root shear, shared by sets that were given the same",
    "g1": "reduced shear, component 1",
    "g2": "reduced shear, component 2",
}
_NEEDED: Final = ("set", "g1", "g2")


def read_truth(path: str | os.PathLike[str], *, columns: Mapping[str, str] | None = None) -> Table:
    """Read the true shears.

    Parameters
    ----------
    path : path
        ECSV, FITS, CSV, or plain text with a line of names.
    columns : mapping of str, optional
        Which column of the file is meant, by our name for it: `{"g1": "gamma1"}`. Columns
        that are not mentioned have our names.

    Returns
    -------
    astropy.table.Table
        One row for each set, by number: `set` (int), `shear` (int), `g1`, `g2` (float), then
        what else the file has. Without a column `shear`, sets of equal (g1, g2) share one.

    Raises
    ------
    CatalogError
        If the file cannot be read or lacks a column; if a set or a shear is not a finite
        number, a set occurs twice, or sets of one root shear have different shears.
    """
    found = _renamed(read_any(path, "truth"), columns or {}, path)
    numbers = _set_numbers(found, path)
    g = np.stack([_floats(found, name, path) for name in ("g1", "g2")], axis=-1)
    values, counts = np.unique(numbers, return_counts=True)
    if np.any(counts > 1):
        raise CatalogError(f"{path} has set {values[counts > 1][0]} more than once")
    if not np.all(np.isfinite(g)):
        bad = numbers[~np.isfinite(g).all(axis=1)][0]
        raise CatalogError(f"the shear of set {bad} in {path} is not finite")
    shear = _shear_numbers(found, g, path)
    table = Table()
    for name, column in zip(COLUMNS, (numbers, shear, *g.T), strict=True):
        table[name] = column
        table[name].description = COLUMNS[name]
    for name in found.colnames:
        if name not in COLUMNS:
            table[name] = found[name]
    table.meta.update(found.meta)
    return table[np.argsort(numbers)]


def _renamed(found: Table, columns: Mapping[str, str], path: str | os.PathLike[str]) -> Table:
    """Return the table with our names; a mentioned column wins over one of the same name."""
    missing = [name for name in _NEEDED if columns.get(name, name) not in found.colnames]
    missing += [
        name for name in columns if name not in _NEEDED and columns[name] not in found.colnames
    ]
    if missing:
        wanted = ", ".join(repr(columns.get(name, name)) for name in missing)
        raise CatalogError(
            f"{path} has no column {wanted}; it has {', '.join(found.colnames)}. Say which is "
            f"meant by {', '.join(missing)} (columns)"
        )
    taken = {columns[name]: name for name in columns}
    table = Table()
    for column in found.colnames:
        name = taken.get(column, column)
        if column in taken or name not in columns:
            table[name] = found[column]
    table.meta.update(found.meta)
    return table


def _set_numbers(table: Table, path: str | os.PathLike[str]) -> NDArray[np.int64]:
    numbers = [_whole(value) for value in table["set"].tolist()]
    if None in numbers:
        bad = table["set"][numbers.index(None)]
        raise CatalogError(f"{path} has a set {bad!s}, which is neither a number nor a name")
    return np.array(numbers, dtype=np.int64)


def _whole(value: Any) -> int | None:
    """Return the number of a set that is given by number or by name."""
    if isinstance(value, bytes):
        value = value.decode("ascii", "replace")
    if isinstance(value, str):
        return set_number(value)
    return int(value) if value is not None and value == value // 1 else None


def _floats(table: Table, name: str, path: str | os.PathLike[str]) -> NDArray[np.float64]:
    try:
        values = np.ma.filled(np.ma.asarray(table[name]).astype(np.float64), np.nan)
    except (TypeError, ValueError) as error:
        raise CatalogError(f"the column {name!r} of {path} does not hold numbers") from error
    return np.asarray(values, dtype=np.float64)


def _shear_numbers(
    table: Table, g: NDArray[np.float64], path: str | os.PathLike[str]
) -> NDArray[np.int64]:
    """Return which root shear each set has, from 0 in the order of the file if not said."""
    if "shear" not in table.colnames:
        _, first, number = np.unique(g, axis=0, return_index=True, return_inverse=True)
        order = np.argsort(np.argsort(first))
        return np.asarray(order[number.reshape(-1)], dtype=np.int64)
    given = _floats(table, "shear", path)
    if not np.all(given == np.floor(given)):
        raise CatalogError(f"the column 'shear' of {path} must hold numbers of root shears")
    shear = given.astype(np.int64)
    for number in np.unique(shear):
        if len(np.unique(g[shear == number], axis=0)) > 1:
            raise CatalogError(f"{path} has sets of root shear {number} with different shears")
    return shear
