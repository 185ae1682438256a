"""Where the cutouts of a MEDS file are: its table of objects, as a list of cutouts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.errors import CatalogError

Cutouts: TypeAlias = Literal["all", "epochs", "first"]
CUTOUTS: Final = ("all", "epochs", "first")
"""Which cutouts of an object are taken; the first is that of the coadd in most files."""

_REQUIRED: Final = (
    *("ncutout", "box_size", "start_row", "cutout_row", "cutout_col"),
    *("dudrow", "dudcol", "dvdrow", "dvdcol"),
)
_PSF_SIDES: Final = (("psf_row_size", "psf_col_size"), ("psf_box_size", "psf_box_size"))
"""Names of the columns with rows and columns of a PSF image, of which a file has one pair."""


@dataclass(frozen=True, kw_only=True)
class CutoutIndex:
    """The cutouts of a file, object by object; made by `index_cutouts`.

    Parameters
    ----------
    ids : array, shape (n_objects,)
        The column `id`; row numbers if there is none.
    numbers : array, shape (n_objects,)
        Of the objects in the segmentation map: the column `number`, or else the ids.
    object_index : array, shape (n_cutout,), int64
        Whose each cutout is, in ascending order.
    boxes : array, shape (n_cutout,), int64
        Pixels on a side.
    starts : array, shape (n_cutout,), int64
        Where it begins in the extensions.
    origin : array, shape (n_cutout, 2)
        (x, y) of the object on it.
    jacobian : array, shape (n_cutout, 2, 2)
        `d(u, v)/d(x, y)`.
    psf_starts : array, shape (n_cutout,), int64
        Where its PSF begins in `psf`; 0 where that is not asked for.
    psf_shapes : array, shape (n_cutout, 2), int64
        (rows, columns) of its PSF.
    n_lost : int
        Cutouts that the table promises but no pixels hold; they are left out.
    ra_dec : array, shape (n_objects, 2), optional
        Columns `ra` and `dec` in degrees, if there are any.
    """

    ids: NDArray[Any]
    numbers: NDArray[Any]
    object_index: NDArray[np.int64]
    boxes: NDArray[np.int64]
    starts: NDArray[np.int64]
    origin: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    psf_starts: NDArray[np.int64]
    psf_shapes: NDArray[np.int64]
    n_lost: int
    ra_dec: NDArray[np.float64] | None = None

    @property
    def n_objects(self) -> int:
        """Number of objects, those without cutouts included."""
        return len(self.ids)

    @property
    def n_cutouts(self) -> int:
        """Number of cutouts that are taken, of all objects."""
        return len(self.starts)

    @property
    def pixels_per_object(self) -> NDArray[np.float64]:
        """Pixels of all cutouts of each object, shape (n_objects,)."""
        weights = self.boxes.astype(np.float64) ** 2
        pixels = np.bincount(self.object_index, weights, minlength=self.n_objects)
        return pixels.astype(np.float64)

    @property
    def largest_box(self) -> NDArray[np.int64]:
        """Pixels on a side of the largest cutout of each object, 0 without one."""
        largest = np.zeros(self.n_objects, dtype=np.int64)
        np.maximum.at(largest, self.object_index, self.boxes)
        return largest

    def of_objects(self, rows: NDArray[np.integer[Any]]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the cutouts of some objects, in their order, and which of them each is of."""
        place = np.full(self.n_objects, -1)
        place[rows] = np.arange(len(rows))
        which = np.flatnonzero(place[self.object_index] >= 0)
        which = which[np.argsort(place[self.object_index[which]], kind="stable")]
        return which, place[self.object_index[which]].astype(np.int64)


def index_cutouts(
    data: Any, *, cutouts: Cutouts, length: int, psf_length: int | None, table: str
) -> CutoutIndex:
    """List the cutouts of a table of objects.

    Parameters
    ----------
    data : numpy.recarray
        The table.
    cutouts : {"all", "epochs", "first"}
    length : int
        Pixels in the extensions of cutouts.
    psf_length : int or None
        Pixels in that of the PSFs; None if it is not used.
    table : str
        Its name, for messages.

    Raises
    ------
    CatalogError
        If a column is lacking.
    """
    names = {name.lower(): name for name in data.names}
    needed = _REQUIRED if psf_length is None else (*_REQUIRED, "psf_start_row")
    lacking = [name for name in needed if name not in names]
    sides = next((pair for pair in _PSF_SIDES if set(pair) <= set(names)), None)
    if psf_length is not None and sides is None:
        lacking.append("psf_box_size")
    if lacking:
        raise CatalogError(f"{table} lacks {', '.join(lacking)}")

    def column(name: str) -> NDArray[Any]:
        values = np.asarray(data[names[name]])
        return values.astype(values.dtype.newbyteorder("="), copy=False)

    def of_epochs(name: str) -> NDArray[Any]:
        values = column(name)
        return values[:, None] if values.ndim == 1 else values

    epoch = np.arange(of_epochs("start_row").shape[1])
    taken = epoch < of_epochs("ncutout")
    taken &= {"all": epoch >= 0, "epochs": epoch > 0, "first": epoch == 0}[cutouts]

    def of(name: str, dtype: type = np.float64) -> NDArray[Any]:
        return np.broadcast_to(of_epochs(name), taken.shape)[taken].astype(dtype)

    slopes = [of(f"d{axis}d{step}") for axis in "uv" for step in ("col", "row")]
    flat = {
        "object_index": np.nonzero(taken)[0],
        "boxes": of("box_size", np.int64),
        "starts": of("start_row", np.int64),
        "origin": np.stack([of("cutout_col"), of("cutout_row")], axis=-1),
        "jacobian": np.stack(slopes, axis=-1).reshape(-1, 2, 2),
    }
    whole = _inside(flat["starts"], flat["boxes"], flat["boxes"], length)
    n = len(whole)
    flat["psf_starts"], flat["psf_shapes"] = np.zeros(n, np.int64), np.zeros((n, 2), np.int64)
    if psf_length is not None and sides is not None:
        rows, columns = (of(side, np.int64) for side in sides)
        flat["psf_starts"] = of("psf_start_row", np.int64)
        flat["psf_shapes"] = np.stack([rows, columns], axis=-1)
        whole &= _inside(flat["psf_starts"], rows, columns, psf_length)
    ra_dec = None
    if {"ra", "dec"} <= set(names):
        ra_dec = np.stack([column("ra"), column("dec")], axis=-1).astype(np.float64)
    ids = column("id") if "id" in names else np.arange(len(data))
    return CutoutIndex(
        ids=ids,
        numbers=column("number") if "number" in names else ids,
        **{name: values[whole] for name, values in flat.items()},
        n_lost=int(np.sum(~whole)),
        ra_dec=ra_dec,
    )


def chunk_ranges(
    pixels: NDArray[np.float64], *, most_objects: int, most_pixels: float
) -> Iterator[slice]:
    """Yield ranges of objects, none with more objects or pixels than that if it has several.

    Parameters
    ----------
    pixels : array, shape (n_objects,)
        Of each object.
    most_objects : int
    most_pixels : float
    """
    total = np.concatenate([[0.0], np.cumsum(pixels)])
    start = 0
    while start < len(pixels):
        fitting = int(np.searchsorted(total, total[start] + most_pixels, side="right")) - 1
        stop = min(max(start + 1, min(start + most_objects, fitting)), len(pixels))
        yield slice(start, stop)
        start = stop


def equal_boxes(boxes: NDArray[np.int64], rows: slice) -> list[NDArray[np.int64]]:
    """Divide objects by the size of their cutouts, so that no stamp has to be made larger.

    Parameters
    ----------
    boxes : array, shape (n_objects,)
        Pixels on a side; 0 without a cutout, which fits any size.
    rows : slice
        The objects to divide.

    Returns
    -------
    list of arrays
        Numbers of objects; at least one.
    """
    largest = boxes[rows]
    there = largest[largest > 0]
    largest = np.where(largest > 0, largest, there[0] if len(there) else 0)
    numbers = np.arange(len(boxes))[rows]
    return [numbers[largest == box] for box in np.unique(largest)] or [numbers]


def _inside(
    starts: NDArray[np.int64], rows: NDArray[np.int64], columns: NDArray[np.int64], length: int
) -> NDArray[np.bool_]:
    """Return which images are some, and lie in an extension."""
    # In floating point: the size of a box that is garbage may overflow.
    pixels = rows.astype(np.float64) * columns
    inside: NDArray[np.bool_] = (
        (rows > 0) & (columns > 0) & (starts >= 0) & (starts + pixels <= length)
    )
    return inside
