"""Pixels of FITS files that stay on disk: mapped, or read in sections where they are packed."""

from __future__ import annotations

import math
import mmap
from pathlib import Path
from typing import Any, Final

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

IN_MEMORY: Final = 2**28
"""Bytes up to which pixels that cannot be mapped are read at once."""
_READ_AHEAD: Final = 2**20
"""Bytes that a section has at least, so that stamps one after the other are one section."""


def map_pixels(file: Path, hdu: Any) -> NDArray[Any] | None:
    """Map the pixels of an image that is stored as numbers; None if astropy has to unpack it.

    Parameters
    ----------
    file : Path
        Of the image; not compressed.
    hdu : astropy image HDU
        Of that file, opened with `memmap=True`.
    """
    pixels = np.asarray(hdu.data)
    if _map_beneath(pixels) is None:
        return None
    # Astropy's map could be written to, and so could not be let go of unseen.
    start = hdu.fileinfo()["datLoc"]
    return np.memmap(file, dtype=pixels.dtype, mode="r", offset=start, shape=pixels.shape)


def let_go(pixels: Any) -> None:
    """Take pages that were read out of memory, where pixels are mapped and can be read anew.

    Else a process that goes once through a large file seems to need memory for all of it.
    """
    if not (isinstance(pixels, np.memmap) and pixels.mode == "r"):
        return  # what was written to it would be lost
    mapped = _map_beneath(pixels)
    if mapped is not None and hasattr(mmap, "MADV_DONTNEED"):
        mapped.madvise(mmap.MADV_DONTNEED)


def _map_beneath(pixels: NDArray[Any]) -> mmap.mmap | None:
    """Return what an array is a view of, if that is a mapped file."""
    base: Any = pixels
    while isinstance(base, np.ndarray):
        base = base.base
    return base if isinstance(base, mmap.mmap) else None


class FitsSections:
    """Packed or scaled pixels that are read where they are indexed, as a NumPy array would be.

    Nothing stays open.

    Parameters
    ----------
    file : Path
    number : int
        Of the HDU.
    shape : tuple of int
    dtype : numpy.dtype
        Of the pixels as they are read.
    """

    def __init__(
        self, *, file: Path, number: int, shape: tuple[int, ...], dtype: np.dtype[Any]
    ) -> None:
        self.file, self.number, self.shape, self.dtype = file, number, shape, dtype
        self._start, self._band = 0, np.empty((0, *shape[1:]), dtype=dtype)

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
        first, *others = key if isinstance(key, tuple) else (key,)
        if isinstance(first, slice):
            start, stop, step = first.indices(len(self))
            rows: Any = slice(None, None, step)
        else:
            start, rows = range(len(self))[first], 0
            stop = start + 1
        return np.asarray(self._rows(start, stop)[(rows, *others)])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        del copy  # it always is one
        return np.asarray(self[:], dtype=dtype)

    def _rows(self, start: int, stop: int) -> NDArray[Any]:
        """Return planes or lines of the first axis; those that were read last are still there."""
        end = self._start + len(self._band)
        if not self._start <= start <= stop <= end:
            line = self.dtype.itemsize * math.prod(self.shape[1:])
            ahead = min(max(stop, start + _READ_AHEAD // line), len(self))
            self._start, self._band = start, self._read(start, ahead)
        return self._band[start - self._start : stop - self._start]

    def _read(self, start: int, stop: int) -> NDArray[Any]:
        with fits.open(self.file, memmap=False) as hdus:
            return np.asarray(hdus[self.number].section[start:stop])
