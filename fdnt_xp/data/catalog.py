"""Catalogs on disk: FITS, ECSV or Parquet by suffix, with units and descriptions in all."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from pathlib import Path
from typing import Final

from astropy.io import fits
from astropy.table import MaskedColumn, Table
from astropy.table.meta import get_header_from_yaml

from fdnt_xp.data.files import check_writable, new_file
from fdnt_xp.data.provenance import COMMENTS
from fdnt_xp.errors import CatalogError, MissingExtraError

_EXTENSION: Final = "SHAPES"


def write_catalog(table: Table, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write a table, whole or not at all, in the format of its suffix.

    Parameters
    ----------
    table : astropy.table.Table
        With units, descriptions, and `meta` of plain numbers and strings; keys of `meta`
        are FITS keywords, upper case and at most eight characters.
    path : path
        `.fits`, `.fit`, `.ecsv` or `.parquet`.
    overwrite : bool
        Whether a file that exists may be replaced.

    Raises
    ------
    CatalogError
        If the suffix is none of these, the file exists, or it cannot be written.
    MissingExtraError
        For Parquet without pyarrow.
    """
    write, _ = _format_of(path)
    with new_file(path, overwrite=overwrite) as temporary:
        write(table, temporary)


def read_catalog(path: str | os.PathLike[str]) -> Table:
    """Read a table that `write_catalog` wrote.

    The same table comes back from all formats: names, numbers, NaN, units, descriptions and
    provenance (`meta`).

    Raises
    ------
    CatalogError
        If there is no such file, or it does not hold a table in the format of its suffix.
    """
    file = Path(path)
    _, read = _format_of(file)
    if not file.is_file():
        problem = "is a folder" if file.is_dir() else "does not exist"
        raise CatalogError(f"cannot read the catalog: {file} {problem}")
    try:
        return read(file)
    except Exception as error:
        # Whatever a reader chokes on, the user's news is which file it was.
        reason = str(error).strip().partition("\n")[0] or type(error).__name__
        raise CatalogError(f"cannot read the catalog {file}: {reason}") from error


def check_catalog(path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Raise what `write_catalog` would raise, before there is anything to write."""
    _format_of(path)
    check_writable(path, overwrite=overwrite)


def _write_fits(table: Table, path: Path) -> None:
    plain = Table(table, copy=False)
    descriptions = [column.description for column in table.itercols()]
    for column in plain.itercols():
        # Else astropy would hide it in a block of YAML, which nothing else reads.
        column.description = None
    hdu = fits.table_to_hdu(plain)
    hdu.header["EXTNAME"] = _EXTENSION
    for keyword, comment in COMMENTS.items():
        if keyword in hdu.header:
            hdu.header.comments[keyword] = comment
    for number, description in enumerate(descriptions, start=1):
        if description:
            hdu.header.set(f"TCOMM{number}", description, after=f"TFORM{number}")
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path)


def _read_fits(path: Path) -> Table:
    with fits.open(path, memmap=False) as hdus:
        number = next(i for i, hdu in enumerate(hdus) if isinstance(hdu, fits.BinTableHDU))
        table = Table.read(hdus[number], mask_invalid=False, character_as_bytes=False)
    table.meta.pop("EXTNAME", None)
    for number, name in enumerate(table.colnames, start=1):
        column = table[name]
        if not column.dtype.isnative:
            table.replace_column(name, column.astype(column.dtype.newbyteorder("=")))
        table[name].description = table.meta.pop(f"TCOMM{number}", None)
    return table


def _write_ecsv(table: Table, path: Path) -> None:
    table.write(path, format="ascii.ecsv")


def _read_ecsv(path: Path) -> Table:
    table = Table.read(path, format="ascii.ecsv")
    for name in table.colnames:
        if isinstance(table[name], MaskedColumn) and table[name].dtype.kind == "U":
            table.replace_column(name, table[name].filled(""))  # empty, not missing
    return table


def _write_parquet(table: Table, path: Path) -> None:
    table.write(path, format="parquet")


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


Format = tuple[Callable[[Table, Path], None], Callable[[Path], Table]]

_FORMATS: Final[dict[str, Format]] = {
    ".fits": (_write_fits, _read_fits),
    ".fit": (_write_fits, _read_fits),
    ".ecsv": (_write_ecsv, _read_ecsv),
    ".parquet": (_write_parquet, _read_parquet),
}


def _format_of(path: str | os.PathLike[str]) -> Format:
    suffix = Path(path).suffix.lower()
    if suffix not in _FORMATS:
        raise CatalogError(
            f"the suffix of {path} is no known catalog format; known are {', '.join(_FORMATS)}"
        )
    if suffix == ".parquet" and importlib.util.find_spec("pyarrow") is None:
        raise MissingExtraError(
            "Parquet needs pyarrow, which is not installed: pip install 'fdnt-xp[parquet]'"
        )
    return _FORMATS[suffix]
