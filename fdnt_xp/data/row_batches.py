"""Catalogs written a batch of rows at a time: memory is that of a batch, however many there are.

FITS, ECSV, Parquet and HDF5 by suffix. What a file holds does not depend on how its rows came
in batches, and it appears whole or not at all.
"""

from __future__ import annotations

import importlib.util
import io
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from astropy.io import fits
from astropy.table import Table
from astropy.table.meta import get_yaml_from_table
from numpy.typing import NDArray

from fdnt_xp.data.files import new_file
from fdnt_xp.data.provenance import COMMENTS, Value
from fdnt_xp.errors import CatalogError, FdntValueError, MissingExtraError

EXTENSION: Final = "SHAPES"
"""Name of the FITS extension, and of the dataset in HDF5."""
_BLOCK: Final = 2880
"""Bytes of which all parts of a FITS file are multiples."""


@contextmanager
def new_catalog(
    path: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    meta: Mapping[str, Value] | None = None,
) -> Iterator[CatalogWriter]:
    """Give a writer that takes tables; the catalog of all their rows is there at the end.

    Parameters
    ----------
    path : path
        `.fits`, `.fit`, `.ecsv`, `.parquet`, `.hdf5` or `.h5`. If the block raises, nothing
        is written, and what was there before is untouched.
    overwrite : bool
        Whether a file that exists may be replaced.
    meta : mapping, optional
        Header of the catalog, see `fdnt_xp.data.catalog.write_catalog`; without it that of
        the first table.

    Raises
    ------
    CatalogError
        If the suffix is none of these, the file exists, or it cannot be written.
    FdntValueError
        If no table was appended.
    MissingExtraError
        For Parquet without pyarrow, for HDF5 without h5py.

    Examples
    --------
    >>> import tempfile
    >>> from fdnt_xp.data.catalog import read_catalog
    >>> path = Path(tempfile.mkdtemp()) / "catalog.fits"
    >>> with new_catalog(path, meta={"METHOD": "fdnt-ft"}) as catalog:
    ...     for start in (0, 3):
    ...         catalog.append(Table({"id": np.arange(start, start + 3)}))
    >>> len(read_catalog(path))
    6
    """
    kind = _kind_of(path)
    with (
        new_file(path, overwrite=overwrite) as temporary,
        closing(kind(temporary)) as file,
    ):
        writer = CatalogWriter(file, Path(path), meta)
        yield writer
        if writer.columns is None:
            raise FdntValueError(f"no table was appended to {path}, not even one without rows")


def check_suffix(path: str | os.PathLike[str]) -> None:
    """Raise if no catalog can have this name, or not without a package that is missing."""
    _kind_of(path)


def check_text(path: str | os.PathLike[str], values: NDArray[Any], name: str) -> None:
    """Raise `CatalogError` if a column of text cannot go batch by batch into a file of this name.

    FITS holds ASCII alone, and HDF5 text of as many bytes as that of the first rows.
    """
    if values.dtype.kind != "U" or Path(path).suffix.lower() in (".ecsv", ".parquet"):
        return
    foreign = next((text for text in values.tolist() if not text.isascii()), None)
    if foreign is not None:
        raise CatalogError(
            f"the {name} {foreign!r} is not ASCII, which {path} cannot hold; "
            "choose .ecsv or .parquet"
        )


class RowFile(Protocol):
    """A file of one of the formats, open for rows."""

    def append(self, table: Table) -> None:
        """Write the rows of a table; the first says columns, units and header for all."""

    def close(self) -> None:
        """Finish the file."""


class CatalogWriter:
    """Takes the rows of a catalog, a table at a time; made by `new_catalog`.

    Parameters
    ----------
    file : RowFile
        Where they go.
    path : Path
        What the user calls it.
    meta : mapping or None
        The header.
    """

    def __init__(self, file: RowFile, path: Path, meta: Mapping[str, Value] | None) -> None:
        self._file, self._path, self._meta = file, path, meta
        self.columns: Table | None = None
        """No rows, but names, types, units and descriptions; None before the first table."""
        self.n_rows = 0
        """Rows so far."""

    def append(self, table: Table) -> None:
        """Append the rows of a table; there may be none.

        Parameters
        ----------
        table : astropy.table.Table
            All have the columns of the first, whose units, descriptions and types count: a
            later one may be of narrower types.

        Raises
        ------
        CatalogError
            If the columns are others, or the format cannot hold what is in them.
        """
        if self.columns is None:
            self.columns = table[:0]
            self.columns.meta = dict(table.meta if self._meta is None else self._meta)
        if table.colnames != self.columns.colnames:
            raise CatalogError(
                f"cannot write {self._path}: these rows have the columns "
                f"{', '.join(table.colnames)}, the first ones {', '.join(self.columns.colnames)}"
            )
        try:
            self._file.append(self._like_the_first(table, self.columns))
        except (TypeError, ValueError, NotImplementedError) as error:
            # Objects, text that is not ASCII in FITS: what the format cannot hold.
            reason = str(error).strip().partition("\n")[0]
            raise CatalogError(f"cannot write {self._path}: {reason}") from error
        self.n_rows += len(table)

    def _like_the_first(self, table: Table, first: Table) -> Table:
        rows = Table(table, copy=False)
        rows.meta = dict(first.meta)
        for name in rows.colnames:
            dtype = first[name].dtype.newbyteorder("=")
            if not np.can_cast(rows[name].dtype, dtype):
                raise CatalogError(
                    f"cannot write {self._path}: the column {name!r} of these rows is "
                    f"{rows[name].dtype}, too wide for the {dtype} of the first ones"
                )
            if rows[name].dtype != dtype:
                rows.replace_column(name, rows[name].astype(dtype))
            rows[name].unit, rows[name].description = first[name].unit, first[name].description
        return rows


class _FitsFile:
    """Header and rows as astropy writes them, the number of rows filled in at the end."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._header: bytes | None = None
        self._n_rows = self._n_bytes = 0

    def append(self, table: Table) -> None:
        hdu = _fits_table(table)
        content = io.BytesIO()
        hdu.writeto(content)
        n_bytes = hdu.header["NAXIS1"] * len(table)
        data = len(content.getbuffer()) - n_bytes - -n_bytes % _BLOCK
        if self._header is None:
            self._header = content.getvalue()[:data]
            self._file.write(self._header)
        self._file.write(content.getbuffer()[data : data + n_bytes])
        self._n_rows += len(table)
        self._n_bytes += n_bytes

    def close(self) -> None:
        with self._file as file:
            if self._header is not None:
                file.write(b"\0" * (-self._n_bytes % _BLOCK))
                place = self._header.index(b"NAXIS2  =")
                comment = fits.Card.fromstring(self._header[place : place + 80]).comment
                file.seek(place)
                file.write(str(fits.Card("NAXIS2", self._n_rows, comment)).encode())


def _fits_table(table: Table) -> fits.BinTableHDU:
    """Return an extension with descriptions and comments where any reader finds them."""
    plain = Table(table, copy=False)
    descriptions = [column.description for column in table.itercols()]
    for column in plain.itercols():
        # Else astropy would hide it in a block of YAML, which nothing else reads.
        column.description = None
    hdu = fits.table_to_hdu(plain)
    hdu.header["EXTNAME"] = EXTENSION
    for keyword, comment in COMMENTS.items():
        if keyword in hdu.header:
            hdu.header.comments[keyword] = comment
    for number, description in enumerate(descriptions, start=1):
        if description:
            hdu.header.set(f"TCOMM{number}", description, after=f"TFORM{number}")
    return hdu


class _EcsvFile:
    """Text: the header of the first table, and the lines of all."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8", newline="")  # astropy ends its lines
        self._header: str | None = None

    def append(self, table: Table) -> None:
        if self._header is None:
            self._header = self._text(table[:0])
            self._file.write(self._header)
        self._file.write(self._text(table)[len(self._header) :])

    def close(self) -> None:
        self._file.close()

    def _text(self, table: Table) -> str:
        text = io.StringIO()
        table.write(text, format="ascii.ecsv")
        return text.getvalue()


class _ParquetFile:
    """A row group for each table; the header where astropy looks for it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._writer: Any = None

    def append(self, table: Table) -> None:
        import pyarrow
        from pyarrow import parquet

        if self._writer is None:
            schema = self._schema(table)
            self._writer = parquet.ParquetWriter(self._path, schema)
        fields = self._writer.schema
        arrays = [
            pyarrow.array(np.ascontiguousarray(table[field.name]), type=field.type)
            for field in fields
        ]
        self._writer.write_table(pyarrow.Table.from_arrays(arrays, schema=fields))

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()

    def _schema(self, table: Table) -> Any:
        import pyarrow

        metadata = {"table_meta_yaml": "\n".join(get_yaml_from_table(table))}
        for column in table.itercols():
            if column.dtype.kind == "U":
                metadata[f"table::len::{column.name}"] = str(column.dtype.itemsize // 4)
        types = [(c.name, pyarrow.from_numpy_dtype(c.dtype.type)) for c in table.itercols()]
        return pyarrow.schema(types, metadata=metadata)


class _Hdf5File:
    """The dataset that astropy makes of the first table, grown by the others."""

    def __init__(self, path: Path) -> None:
        import h5py

        self._file = h5py.File(path, "w")

    def append(self, table: Table) -> None:
        if EXTENSION not in self._file:
            table.write(
                self._file,
                format="hdf5",
                path=EXTENSION,
                serialize_meta=True,
                maxshape=(None,),
                chunks=True,
            )
            return
        rows = Table(table, copy=False)
        rows.convert_unicode_to_bytestring()
        dataset = self._file[EXTENSION]
        if not np.can_cast(rows.as_array().dtype, dataset.dtype):
            raise ValueError("text needs more bytes than that of the first rows")
        n_before = len(dataset)
        dataset.resize(n_before + len(rows), axis=0)
        dataset[n_before:] = rows.as_array()

    def close(self) -> None:
        self._file.close()


_KINDS: Final[dict[str, Callable[[Path], RowFile]]] = {
    ".fits": _FitsFile,
    ".fit": _FitsFile,
    ".ecsv": _EcsvFile,
    ".parquet": _ParquetFile,
    ".hdf5": _Hdf5File,
    ".h5": _Hdf5File,
}
_NEEDED: Final = {
    ".parquet": ("Parquet", "pyarrow", "parquet"),
    ".hdf5": ("HDF5", "h5py", "hdf5"),
    ".h5": ("HDF5", "h5py", "hdf5"),
}
"""Format, package and extra."""


def _kind_of(path: str | os.PathLike[str]) -> Callable[[Path], RowFile]:
    suffix = Path(path).suffix.lower()
    if suffix not in _KINDS:
        raise CatalogError(
            f"the suffix of {path} is no known catalog format; known are {', '.join(_KINDS)}"
        )
    if suffix in _NEEDED:
        name, package, extra = _NEEDED[suffix]
        if importlib.util.find_spec(package) is None:
            raise MissingExtraError(
                f"{name} needs {package}, which is not installed: pip install 'fdnt-xp[{extra}]'"
            )
    return _KINDS[suffix]
