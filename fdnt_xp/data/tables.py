"""Tables that others made, in any format that astropy reads: positions of galaxies."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from astropy.utils.exceptions import AstropyWarning
from numpy.typing import NDArray

from fdnt_xp.data.catalog import read_catalog
from fdnt_xp.data.hdf5 import is_hdf5, read_hdf5_table
from fdnt_xp.errors import CatalogError, FdntValueError


@dataclass(frozen=True, kw_only=True)
class Positions:
    """Where galaxies are said to be.

    Parameters
    ----------
    xy : array, shape (n, 2), float64
        (x, y) in pixels, 0-based; NaN where the table has no value.
    ids : array, shape (n,)
        The column `id` of the table; row numbers if it has none.
    """

    xy: NDArray[np.float64]
    ids: NDArray[Any]


def read_positions(
    path: str | os.PathLike[str], *, x_column: str = "x", y_column: str = "y", origin: int = 0
) -> Positions:
    """Read positions from a table: FITS, ECSV, CSV, Parquet, HDF5, VOTable, SExtractor, text.

    Parameters
    ----------
    path : path
        The table.
    x_column, y_column : str
        Names of the columns, in pixels; upper and lower case are the same unless both exist.
    origin : int
        Coordinate of the centre of the first pixel: 0, or 1 as FITS and SExtractor count.

    Raises
    ------
    CatalogError
        If the file cannot be read, or lacks one of the columns, or it holds no numbers.
    """
    if origin not in (0, 1):
        raise FdntValueError(f"origin must be 0 or 1, not {origin}")
    table = read_any(path, "positions")
    xy = [_numbers(table, name, path) for name in (x_column, y_column)]
    name = _find(table, "id")
    ids = np.arange(len(table)) if name is None else np.asarray(table[name])
    return Positions(xy=np.stack(xy, axis=-1) - origin, ids=ids)


def read_any(path: str | os.PathLike[str], what: str) -> Table:
    """Read a table in the format that its name or content shows, else as plain text.

    Parameters
    ----------
    path : path
        The file; of HDF5 also a dataset or group of it, `file.h5::name`.
    what : str
        What the table is to the caller, for messages.

    Raises
    ------
    CatalogError
        If there is no such file, or it cannot be read.
    """
    if is_hdf5(path):
        return read_hdf5_table(path, what)
    path = Path(path)
    if not path.is_file():
        problem = "is a folder" if path.is_dir() else "does not exist"
        raise CatalogError(f"cannot read the {what}: {path} {problem}")
    if path.suffix.lower() == ".parquet":
        return read_catalog(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyWarning)  # odd units and second tables
        try:
            with path.open("rb") as file:
                text = b"\0" not in file.read(4096)
            known = path.suffix.lower() in (".csv", ".ecsv", ".xml", ".vot", ".fits")
            return Table.read(path, **({"format": "ascii"} if text and not known else {}))
        except Exception as error:
            # Whatever a reader chokes on, the user's news is which file it was.
            reason = str(error).strip().partition("\n")[0] or type(error).__name__
            raise CatalogError(f"cannot read the {what} {path}: {reason}") from error


def _find(table: Table, name: str) -> str | None:
    if name in table.colnames:
        return name
    same = [column for column in table.colnames if column.lower() == name.lower()]
    return same[0] if len(same) == 1 else None


def _numbers(table: Table, name: str, path: str | os.PathLike[str]) -> NDArray[np.float64]:
    column = _find(table, name)
    if column is None:
        raise CatalogError(f"{path} has no column {name!r}; it has {', '.join(table.colnames)}")
    try:
        values = np.ma.filled(np.ma.asarray(table[column]).astype(np.float64), np.nan)
    except (TypeError, ValueError) as error:
        raise CatalogError(f"the column {column!r} of {path} does not hold numbers") from error
    if values.ndim != 1:
        raise CatalogError(f"the column {column!r} of {path} holds more than a number in each row")
    return np.asarray(values, dtype=np.float64)
