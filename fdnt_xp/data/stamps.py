"""Postage stamps, a few at a time: from a grid of cells, a cube, or positions on an image."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.data.fits_pixels import let_go
from fdnt_xp.data.images import Pixels
from fdnt_xp.errors import FdntValueError, RangeError, ShapeMismatchError
from fdnt_xp.flags import Flag

SMALLEST_STAMP = 8
"""Pixels on a side below which a stamp holds no galaxy with its surroundings."""


@dataclass(frozen=True, kw_only=True)
class StampChunk:
    """Consecutive galaxies of a source, in memory.

    Parameters
    ----------
    rows : slice
        Which galaxies of the source these are.
    stamps : array, shape (n, ny, nx), float32 or float64
        Pixels; all NaN where `flags` is not zero.
    flags : array, shape (n,), int32
        `Flag.EDGE` or `Flag.OFF_IMAGE` where there is no whole stamp.
    """

    rows: slice
    stamps: NDArray[np.floating[Any]]
    flags: NDArray[np.int32]


@dataclass(frozen=True, kw_only=True)
class StampSource:
    """Where the stamps of an image are, and the pixels to cut them from.

    Made by `grid_stamps`, `cube_stamps` or `position_stamps`. Coordinates are (x, y) in
    pixels, 0-based, integer at pixel centres; for a cube they are those of each stamp.

    Parameters
    ----------
    pixels : array, shape (ny, nx) or (n_gal, ny, nx)
        The image, or a cube whose planes are the stamps. It may be mapped from disk: only
        what a chunk needs is read.
    stamp_shape : tuple of int
        (ny, nx) of every stamp.
    ids : array, shape (n_gal,)
        Name or number of each galaxy.
    positions : array, shape (n_gal, 2), float64
        Where the galaxy was said to be.
    corners : array, shape (n_gal, 2), int64
        Image coordinates of the stamp's pixel [0, 0].
    flags : array, shape (n_gal,), int32
        `Flag.EDGE` or `Flag.OFF_IMAGE` where there is no whole stamp.
    """

    pixels: Pixels
    stamp_shape: tuple[int, int]
    ids: NDArray[Any]
    positions: NDArray[np.float64]
    corners: NDArray[np.int64]
    flags: NDArray[np.int32]

    @property
    def n_gal(self) -> int:
        """Number of galaxies, those without a whole stamp included."""
        return len(self.ids)

    def read(self, start: int, stop: int) -> StampChunk:
        """Return galaxies `start` to `stop - 1`, fewer at the end."""
        rows = slice(start, min(stop, self.n_gal))
        stamps = self.take(np.arange(rows.start, rows.stop))
        return StampChunk(rows=rows, stamps=stamps, flags=self.flags[rows])

    def take(self, rows: NDArray[np.integer[Any]]) -> NDArray[np.floating[Any]]:
        """Return the stamps with these row numbers, shape (n, ny, nx); NaN where flagged."""
        dtype = "float32" if self.pixels.dtype.name == "float32" else "float64"
        stamps = np.full((len(rows), *self.stamp_shape), np.nan, dtype=dtype)
        for place, row in enumerate(rows):
            if self.flags[row] == 0:
                stamps[place] = self._cut(int(row))
        let_go(self.pixels)
        return stamps

    def beside(self, pixels: Pixels, what: str) -> StampSource:
        """Return the source that cuts other pixels where this one cuts its own.

        Parameters
        ----------
        pixels : array, of the shape of the image or cube
        what : str
            What they are to the caller, for messages.

        Raises
        ------
        ShapeMismatchError
            If they have another shape.
        """
        if pixels.shape != self.pixels.shape:
            raise ShapeMismatchError(
                f"the {what} has the shape {pixels.shape}; it must have that of the image, "
                f"{self.pixels.shape}"
            )
        return replace(self, pixels=pixels)

    def chunks(self, size: int) -> Iterator[StampChunk]:
        """Yield all galaxies in order, `size` at a time."""
        for start in range(0, self.n_gal, size):
            yield self.read(start, start + size)

    def _cut(self, row: int) -> Pixels:
        (x, y), (ny, nx) = self.corners[row], self.stamp_shape
        plane: Pixels = self.pixels[row] if self.pixels.ndim == 3 else self.pixels
        return plane[y : y + ny, x : x + nx]


def grid_stamps(pixels: Pixels, cell: int) -> StampSource:
    """Divide an image into square cells with one galaxy in each, as GREAT08 has them.

    Galaxies are numbered along x first; the position of each is the centre of its cell.

    Parameters
    ----------
    pixels : array, shape (ny, nx)
        The image.
    cell : int
        Pixels on a side of a cell; the image must be a whole number of cells.

    Raises
    ------
    ShapeMismatchError
        If it is not.
    """
    _check_image(pixels)
    _check_size(cell, "cell")
    ny, nx = pixels.shape
    if ny % cell or nx % cell:
        raise ShapeMismatchError(
            f"an image of {nx} x {ny} pixels is not a whole number of cells of {cell} pixels; "
            f"{nx - nx % cell} x {ny - ny % cell} would be"
        )
    row, column = np.divmod(np.arange((ny // cell) * (nx // cell)), nx // cell)
    corners = cell * np.stack([column, row], axis=-1).astype(np.int64)
    return StampSource(
        pixels=pixels,
        stamp_shape=(cell, cell),
        ids=np.arange(len(corners)),
        positions=(corners + (cell - 1) / 2).astype(np.float64),
        corners=corners,
        flags=np.zeros(len(corners), dtype=np.int32),
    )


def cube_stamps(cube: Pixels) -> StampSource:
    """Take each plane of a cube as the stamp of one galaxy, said to be at its centre.

    Parameters
    ----------
    cube : array, shape (n_gal, ny, nx)
        The stamps.
    """
    if cube.ndim != 3:
        raise ShapeMismatchError(f"a cube has three axes (n, ny, nx), not the shape {cube.shape}")
    n_gal, ny, nx = cube.shape
    return StampSource(
        pixels=cube,
        stamp_shape=(ny, nx),
        ids=np.arange(n_gal),
        positions=np.tile([(nx - 1) / 2, (ny - 1) / 2], (n_gal, 1)),
        corners=np.zeros((n_gal, 2), dtype=np.int64),
        flags=np.zeros(n_gal, dtype=np.int32),
    )


def position_stamps(
    pixels: Pixels,
    positions: NDArray[np.float64],
    stamp_size: int,
    ids: NDArray[Any] | None = None,
) -> StampSource:
    """Cut a square stamp around each position, centred on it to half a pixel.

    A position off the image, or NaN, is flagged `OFF_IMAGE`; one whose stamp would reach
    over the edge is flagged `EDGE`. Neither raises.

    Parameters
    ----------
    pixels : array, shape (ny, nx)
        The image.
    positions : array, shape (n_gal, 2)
        (x, y), 0-based, integer at pixel centres.
    stamp_size : int
        Pixels on a side.
    ids : array, shape (n_gal,), optional
        Names of the galaxies; row numbers without it.
    """
    _check_image(pixels)
    _check_size(stamp_size, "stamp_size")
    positions = np.asarray(positions, dtype=np.float64)
    if positions.ndim != 2 or positions.shape[1] != 2:
        raise ShapeMismatchError(f"positions must have the shape (n, 2), not {positions.shape}")
    extent = np.array(pixels.shape[::-1])
    on_image = np.all((positions >= -0.5) & (positions < extent - 0.5), axis=-1)
    # Rounding half up, so that equal fractions are cut alike wherever they are.
    centred = np.floor(np.where(on_image[:, None], positions, 0) - (stamp_size - 1) / 2 + 0.5)
    corners = centred.astype(np.int64)
    whole = np.all((corners >= 0) & (corners + stamp_size <= extent), axis=-1)
    flags = np.where(on_image, np.where(whole, 0, int(Flag.EDGE)), int(Flag.OFF_IMAGE))
    return StampSource(
        pixels=pixels,
        stamp_shape=(stamp_size, stamp_size),
        ids=np.arange(len(positions)) if ids is None else ids,
        positions=positions,
        corners=corners,
        flags=flags.astype(np.int32),
    )


def _check_image(pixels: Pixels) -> None:
    if pixels.ndim != 2:
        raise ShapeMismatchError(f"an image has two axes (ny, nx), not the shape {pixels.shape}")


def _check_size(size: int, name: str) -> None:
    if size != int(size):
        raise FdntValueError(f"{name} must be a whole number of pixels, not {size}")
    if size < SMALLEST_STAMP:
        raise RangeError(name, size, SMALLEST_STAMP, None)
