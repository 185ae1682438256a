"""Submissions: what each estimator says is the shear of each set, on disk."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from astropy.table import Table

from fdnt_xp.data.catalog import read_catalog, write_catalog
from fdnt_xp.data.files import new_file
from fdnt_xp.errors import CatalogError, FdntValueError

COLUMNS: Final[dict[str, tuple[type, str]]] = {
    "set": (int, "number of the image: 1 for set0001"),
    "estimator": (str, "which estimate of shear"),
    "g1": (float, "reduced shear, component 1; NaN where the estimator failed"),
    "g2": (float, "reduced shear, component 2"),
    "g1_err": (float, "standard error of g1"),
    "g2_err": (float, "standard error of g2"),
    "g1_err_noise": (float, "standard error of g1 by the noise of the pixels; NaN if not known"),
    "g2_err_noise": (float, "standard error of g2 by the noise of the pixels"),
    "n_gal": (int, "galaxies of the set"),
    "n_used": (int, "galaxies that enter the estimate"),
}
"""Type and meaning of the columns of a submission, which has a row for each set and estimator."""
_NEEDED: Final = ("set", "estimator", "g1", "g2")
_SUFFIX: Final = ".ecsv"


def submission_table(rows: Iterable[Mapping[str, Any]]) -> Table:
    """Return a submission of rows that have all of `COLUMNS`, with their types and meanings."""
    rows = list(rows)
    table = Table()
    for name, (kind, description) in COLUMNS.items():
        table[name] = np.array([row[name] for row in rows], dtype=kind)
        table[name].description = description
    return table


def write_submission(
    table: Table, path: str | os.PathLike[str], *, overwrite: bool = False
) -> None:
    """Write a submission, whole or not at all, as ECSV.

    Parameters
    ----------
    table : astropy.table.Table
        With the columns `set`, `estimator`, `g1`, `g2` at least.
    path : path
        `.ecsv`.
    overwrite : bool
        Whether a file that exists may be replaced.

    Raises
    ------
    CatalogError
        If it is no submission, the suffix is another, the file exists, or it cannot be
        written.
    """
    _check(table, "the table")
    _check_suffix(path)
    write_catalog(table, path, overwrite=overwrite)


def read_submission(path: str | os.PathLike[str]) -> Table:
    """Read what `write_submission` wrote.

    Raises
    ------
    CatalogError
        If there is no such file, or it holds no submission.
    """
    _check_suffix(path)
    table = read_catalog(path)
    _check(table, str(path))
    return table


def write_text_submission(
    table: Table, estimator: str, path: str | os.PathLike[str], *, overwrite: bool = False
) -> None:
    """Write the shears of one estimator as GREAT08 took them: plain lines of set, g1, g2.

    Parameters
    ----------
    table : astropy.table.Table
        A submission.
    estimator : str
        Whose rows; `nan` stands where it failed.
    path : path
        Any name; the first line, after `#`, names the columns.
    overwrite : bool
        Whether a file that exists may be replaced.

    Raises
    ------
    FdntValueError
        If the submission has no such estimator.
    CatalogError
        If it is no submission, the file exists, or it cannot be written.
    """
    _check(table, "the table")
    names = np.asarray(table["estimator"]).astype(str)
    if estimator not in names:
        known = ", ".join(dict.fromkeys(names)) or "none"
        raise FdntValueError(f"the submission has no estimator {estimator!r}; it has {known}")
    rows = table["set", "g1", "g2"][names == estimator]
    with new_file(path, overwrite=overwrite) as temporary:
        rows.write(temporary, format="ascii.commented_header", formats={"g1": "%.8f", "g2": "%.8f"})


def _check(table: Table, what: str) -> None:
    """Raise `CatalogError` unless a table is a submission."""
    if missing := [name for name in _NEEDED if name not in table.colnames]:
        raise CatalogError(
            f"{what} is no submission: it has no column {', '.join(missing)}; it has "
            f"{', '.join(table.colnames) or 'none'}"
        )
    numbers = np.asarray(table["set"]).tolist()
    pairs = list(zip(numbers, map(str, table["estimator"]), strict=True))
    if twice := [pair for pair, count in Counter(pairs).items() if count > 1]:
        number, estimator = twice[0]
        raise CatalogError(f"{what} has set {number} by {estimator!r} more than once")


def _check_suffix(path: str | os.PathLike[str]) -> None:
    if Path(path).suffix.lower() != _SUFFIX:
        raise CatalogError(f"the suffix of {path} must be {_SUFFIX}")
