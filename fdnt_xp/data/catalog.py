"""Catalogs on disk: FITS, ECSV, Parquet or HDF5 by suffix, with units and descriptions in all."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Final

from astropy.io import fits
from astropy.table import MaskedColumn, Table
from astropy.table.meta import get_header_from_yaml

import fdnt_xp
from fdnt_xp.data.files import check_writable
from fdnt_xp.data.provenance import SCHEMA
from fdnt_xp.data.row_batches import EXTENSION, check_suffix, new_catalog
from fdnt_xp.errors import CatalogError, FdntWarning


def write_catalog(table: Table, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write a table, whole or not at all, in the format of its suffix.

    `fdnt_xp.data.row_batches.new_catalog` writes one that memory cannot hold.

    Parameters
    ----------
    table : astropy.table.Table
        With units, descriptions, and `meta` of plain numbers and strings; keys of `meta`
        are FITS keywords, upper case and at most eight characters.
    path : path
        `.fits`, `.fit`, `.ecsv`, `.parquet`, `.hdf5` or `.h5`.
    overwrite : bool
        Whether a file that exists may be replaced.

    Raises
    ------
    CatalogError
        If the suffix is none of these, the file exists, or it cannot be written.
    MissingExtraError
        For Parquet without pyarrow, for HDF5 without h5py.
    """
    with new_catalog(path, overwrite=overwrite) as catalog:
        catalog.append(table)


def read_catalog(path: str | os.PathLike[str]) -> Table:
    """Read a table that `write_catalog` wrote.

    The same table comes back from all formats: names, numbers, NaN, units, descriptions and
    provenance (`meta`). Warns (`FdntWarning`) of a catalog of a later version of the package
    whose columns mean something else (`SCHEMA`).

    Raises
    ------
    CatalogError
        If there is no such file, or it does not hold a table in the format of its suffix.
    """
    file = Path(path)
    check_suffix(file)
    if not file.is_file():
        problem = "is a folder" if file.is_dir() else "does not exist"
        raise CatalogError(f"cannot read the catalog: {file} {problem}")
    try:
        table = _READERS[file.suffix.lower()](file)
    except Exception as error:
        # Whatever a reader chokes on, the user's news is which file it was.
        reason = str(error).strip().partition("\n")[0] or type(error).__name__
        raise CatalogError(f"cannot read the catalog {file}: {reason}") from error
    schema = table.meta.get("SCHEMA")
    if isinstance(schema, int) and schema > SCHEMA:
        warnings.warn(
            f"{file} has columns of version {schema}, and fdnt_xp {fdnt_xp.__version__} knows "
            f"those up to {SCHEMA}: some may mean something else",
            FdntWarning,
            stacklevel=2,
        )
    return table


def check_catalog(path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Raise what `write_catalog` would raise, before there is anything to write."""
    check_suffix(path)
    check_writable(path, overwrite=overwrite)


def _read_fits(path: Path) -> Table:
    # Astropy leaves a file that is broken open, unless it is ours to close.
    with path.open("rb") as file, fits.open(file, memmap=False) as hdus:
        number = next(i for i, hdu in enumerate(hdus) if isinstance(hdu, fits.BinTableHDU))
        table = Table.read(hdus[number], mask_invalid=False, character_as_bytes=False)
    table.meta.pop("EXTNAME", None)
    for number, name in enumerate(table.colnames, start=1):
        column = table[name]
        if not column.dtype.isnative:
            table.replace_column(name, column.astype(column.dtype.newbyteorder("=")))
        table[name].description = table.meta.pop(f"TCOMM{number}", None)
    return table


def _read_ecsv(path: Path) -> Table:
    table = Table.read(path, format="ascii.ecsv")
    for name in table.colnames:
        if isinstance(table[name], MaskedColumn) and table[name].dtype.kind == "U":
            table.replace_column(name, table[name].filled(""))  # empty, not missing
    return table


def _read_parquet(path: Path) -> Table:
    # By pyarrow alone: astropy's reader wants pandas as well.
    from pyarrow import parquet

    stored = parquet.read_table(path)
    table = Table()
    for name in stored.column_names:
        values = stored[name].to_numpy()
        table[name] = values.astype(str) if values.dtype == object else values
    if text := (stored.schema.metadata or {}).get(b"table_meta_yaml"):
        header = get_header_from_yaml(text.decode().split("\n"))
        table.meta.update(header.get("meta", {}))
        for column in header["datatype"]:
            table[column["name"]].unit = column.get("unit")
            table[column["name"]].description = column.get("description")
    return table


def _read_hdf5(path: Path) -> Table:
    return Table.read(path, format="hdf5", path=EXTENSION, character_as_bytes=False)


_READERS: Final[dict[str, Callable[[Path], Table]]] = {
    ".fits": _read_fits,
    ".fit": _read_fits,
    ".ecsv": _read_ecsv,
    ".parquet": _read_parquet,
    ".hdf5": _read_hdf5,
    ".h5": _read_hdf5,
}
