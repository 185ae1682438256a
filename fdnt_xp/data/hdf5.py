"""Images, cubes and tables from HDF5 files; of pixels only what is asked for is read.

`file.h5::group/stamps` names a dataset, `file.h5` alone the only one that there is.
"""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from fdnt_xp.errors import CatalogError, MissingExtraError

_SUFFIXES: Final = (".h5", ".hdf5")
_MARK: Final = "::"
_CACHE: Final = 2**26
"""Bytes of unpacked chunks that are kept: a packed cube is not unpacked anew for each stamp."""


def is_hdf5(path: str | os.PathLike[str]) -> bool:
    """Return whether a name is that of an HDF5 file, or of a dataset in one.

    Examples
    --------
    >>> [is_hdf5(name) for name in ("a.h5", "a.hdf5::stamps", "a.fits", "a.h5.fits")]
    [True, True, False, False]
    """
    return split_name(path)[0].suffix.lower() in _SUFFIXES


def split_name(path: str | os.PathLike[str]) -> tuple[Path, str | None]:
    """Return the file of `file.h5::dataset` and the name of the dataset, None if there is none."""
    file, mark, name = os.fspath(path).partition(_MARK)
    return (Path(file), name.strip("/ ") or None) if mark else (Path(path), None)


class Hdf5Pixels:
    """A dataset of numbers that is read where it is indexed, as a NumPy array would be.

    Made by `open_hdf5`. It may be sent to other processes: each opens the file for itself.

    Parameters
    ----------
    file : Path
    name : str
        Of the dataset.
    shape : tuple of int
    dtype : numpy.dtype
    """

    def __init__(
        self, *, file: Path, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]
    ) -> None:
        self.file, self.name, self.shape, self.dtype = file, name, shape, dtype
        self._opened: tuple[int, Any] | None = None

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """Number of pixels."""
        return math.prod(self.shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> NDArray[Any]:
        return np.asarray(self._dataset()[key])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        del copy  # it always is one
        return np.asarray(self._dataset()[()], dtype=dtype)

    def __reduce__(self) -> tuple[Callable[..., Hdf5Pixels], tuple[Any, ...]]:
        return _closed, (self.file, self.name, self.shape, self.dtype)

    def _dataset(self) -> Any:
        """Return the open dataset: that of this process, for a handle must not be shared."""
        if self._opened is None or self._opened[0] != os.getpid():
            h5py = _h5py()
            try:
                file = h5py.File(self.file, "r", rdcc_nbytes=_CACHE)
                self._opened = os.getpid(), file[self.name]
            except (OSError, KeyError) as error:
                raise CatalogError(f"cannot read {self.file}{_MARK}{self.name}: {error}") from error
        return self._opened[1]


def _closed(file: Path, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Hdf5Pixels:
    return Hdf5Pixels(file=file, name=name, shape=shape, dtype=dtype)


def open_hdf5(path: str | os.PathLike[str], *, what: str = "image") -> Hdf5Pixels:
    """Find a dataset of numbers, and read none of them yet.

    Parameters
    ----------
    path : path
        `file.h5::dataset`, or `file.h5` if it holds a single dataset.
    what : str
        What it is to the caller, for messages.

    Raises
    ------
    CatalogError
        If there is no such file, it is not HDF5, there is no such dataset (the message lists
        those that there are), or it does not hold numbers.
    MissingExtraError
        Without h5py.
    """
    file, name = split_name(path)
    with _opened(file, what) as tree:
        names = sorted(_dataset_names(tree))
        if name is None and len(names) != 1:
            raise CatalogError(f"{file} holds {_listed(names)}; say which, as {file}{_MARK}NAME")
        name = names[0] if name is None else name
        if name not in names:
            raise CatalogError(
                f"the {what} {file} has no dataset {name!r}; it has {_listed(names)}"
            )
        dataset = tree[name]
        if dataset.dtype.kind not in "biuf" or dataset.shape is None:
            raise CatalogError(
                f"the dataset {name!r} of {file} is no {what}: it holds "
                f"{dataset.dtype}, not numbers"
            )
        return Hdf5Pixels(file=file, name=name, shape=tuple(dataset.shape), dtype=dataset.dtype)


def read_hdf5_table(path: str | os.PathLike[str], what: str) -> Table:
    """Read a table: a dataset of records, or a group of columns of one length.

    Parameters
    ----------
    path : path
        `file.h5::name` of the dataset or group; without a name the file itself is the group,
        or its only dataset the table.
    what : str
        What the table is to the caller, for messages.

    Raises
    ------
    CatalogError
        If there is no such file or name, or it is no table.
    MissingExtraError
        Without h5py.
    """
    file, name = split_name(path)
    with _opened(file, what) as tree:
        if name is not None and name not in tree:
            names = sorted(_dataset_names(tree))
            raise CatalogError(f"the {what} {file} has no {name!r}; it has {_listed(names)}")
        found = tree if name is None else tree[name]
        columns = _columns(found)
        if not columns and name is None and len(names := list(_dataset_names(tree))) == 1:
            columns = _columns(tree[names[0]])
    if len({len(column) for column in columns.values()}) != 1:
        raise CatalogError(
            f"the {what} {path} is no table: neither a dataset of records, nor a group of "
            "datasets of one length"
        )
    return Table({key: _as_text(column) for key, column in columns.items()})


def _columns(found: Any) -> dict[str, NDArray[Any]]:
    """Return the fields of records, or the columns of a group, by name."""
    if hasattr(found, "items"):
        datasets = {key: item for key, item in found.items() if not hasattr(item, "items")}
        return {key: item[()] for key, item in datasets.items() if item.shape}
    records = found[()]
    return {key: records[key] for key in found.dtype.names or ()}


def _as_text(column: NDArray[Any]) -> NDArray[Any]:
    """Return names as text; HDF5 has them as bytes."""
    if column.dtype.kind not in "SO":
        return column
    return np.array([v.decode() if isinstance(v, bytes) else str(v) for v in column.tolist()])


@contextmanager
def _opened(file: Path, what: str) -> Iterator[Any]:
    h5py = _h5py()
    if not file.is_file():
        problem = "is a folder" if file.is_dir() else "does not exist"
        raise CatalogError(f"cannot read the {what}: {file} {problem}")
    try:
        with h5py.File(file, "r") as tree:
            yield tree
    except CatalogError:
        raise
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        reason = str(error).partition("\n")[0]
        raise CatalogError(f"cannot read the {what} {file}: {reason}") from error


def _dataset_names(tree: Any, above: str = "") -> Iterator[str]:
    """Yield the full names of the datasets of a file; what a broken link hides is left out."""
    for key in tree:
        item = tree.get(key)
        if hasattr(item, "items"):
            yield from _dataset_names(item, f"{above}{key}/")
        elif item is not None:
            yield f"{above}{key}"


def _listed(names: Collection[str]) -> str:
    return ", ".join(names) or "no dataset"


def _h5py() -> Any:
    if importlib.util.find_spec("h5py") is None:
        raise MissingExtraError(
            "HDF5 needs h5py, which is not installed: pip install 'fdnt-xp[hdf5]'"
        )
    import h5py

    return h5py
