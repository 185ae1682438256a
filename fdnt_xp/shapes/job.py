"""What every measurement of a batch begins with: checks, k grids, tables, chunks."""

from __future__ import annotations

import math
import numbers
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Final

import numpy as np

from fdnt_xp.arrays import (
    Array,
    Rows,
    array_namespace,
    as_floating,
    device_of,
    require_dtype,
    rows_of,
    to_numpy,
    works_in_blocks,
)
from fdnt_xp.errors import FdntTypeError, FdntValueError, RangeError, ShapeMismatchError
from fdnt_xp.flags import Flag
from fdnt_xp.fourier.grid import KGrid, half_plane_disc
from fdnt_xp.fourier.psf import Psf
from fdnt_xp.nulltests.weights import Weight, make_weight

FINER: Final = 2
"""How much finer the grid for elongated galaxies is, along each axis."""
_FEWEST_CELLS: Final = 3.0
"""Least radius of the disc, in cells of the k grid: quadrupoles need an annulus or two."""
_FEWEST_ON_A_PSF: Final = 32
"""Galaxies for each PSF, in the mean, from which those that share one are taken together."""
_FEWEST_TO_MEASURE: Final = 1024
"""The same where each chunk ends with a search for its slowest few: see `Job.chunks`."""
_ROUGH_FLOOR: Final = 0.03
"""Of 𝒯: where the weight of a first search ends, on a fraction of the modes."""
_BYTES_AT_ONCE: Final = 128e6
"""Memory of a chunk of galaxies."""
_FIELDS: Final = 24
"""Arrays of the size of the deconvolved stamps that an evaluation of the tests holds."""
_FIELDS_IN_BLOCKS: Final = 6
"""The same where it goes through few galaxies at a time: the transforms, and copies of them."""


@dataclass(frozen=True, kw_only=True)
class Chunk:
    """Galaxies that are in work together.

    Parameters
    ----------
    rows : slice or array of int64
        Which.
    psf_number : int, optional
        The PSF that they share, where others have others.
    """

    rows: Rows
    psf_number: int | None = None


@dataclass(frozen=True, kw_only=True)
class Job:
    """What the galaxies of a call share, and their PSFs: one, one for each, or some.

    Parameters
    ----------
    psf : Psf
    weight : Weight
        Of each PSF.
    coarse, fine : KGrid
        The grid of the stamps, and one `FINER` times finer.
    length : float
        Unit of centroids, pixels: about the size of the PSF.
    size : array, shape (1,) or (n_gal,), or None
        Fixed size of the weight, pixels.
    max_iter : int
        Steps of the root finder.
    rough : Weight, optional
        Of each PSF, ending early, for a first search on the modes within `rough_kmax`.
    """

    psf: Psf
    weight: Weight
    coarse: KGrid
    fine: KGrid
    length: float
    size: Array | None
    max_iter: int
    rough: Weight | None = None
    rough_kmax: float = math.pi

    def chunks(self, n_gal: int, n_chunk: int, *, searched: bool = False) -> list[Chunk]:
        """Return all galaxies in parts of at most `n_chunk`: by their PSF if many share one.

        An empty sample still has its one chunk, of no rows. Where a root is `searched` for each
        galaxy, the last few of a chunk take as long as hundreds do together.
        """
        index = self.psf.index
        fewest = _FEWEST_TO_MEASURE if searched else _FEWEST_ON_A_PSF
        few = n_gal == 0 or n_gal < fewest * self.psf.n_psf
        if index is None or self.weight.shared or few:
            firsts = range(0, max(n_gal, 1), n_chunk)
            return [Chunk(rows=slice(first, min(first + n_chunk, n_gal))) for first in firsts]
        xp = array_namespace(index=index)
        order = xp.argsort(index, stable=True)
        numbers = to_numpy(index)
        ends = np.cumsum(np.bincount(numbers, minlength=self.psf.n_psf))
        chunks, first = [], 0
        for number, end in enumerate(int(end) for end in ends):
            for start in range(first, end, n_chunk):
                rows = order[start : min(start + n_chunk, end)]
                chunks.append(Chunk(rows=rows, psf_number=number))
            first = end
        return chunks

    def of(self, chunk: Chunk) -> Job:
        """Return the job of a chunk: one PSF for all of it, or one for each galaxy."""
        if chunk.psf_number is None:
            return self.take(chunk.rows)
        xp = array_namespace(kmax=self.psf.kmax)
        number = xp.asarray([chunk.psf_number], dtype=xp.int64, device=device_of(self.psf.kmax))
        psf = replace(self.psf, index=None).take(number)
        size = _of_rows(self.size, chunk.rows)
        return replace(
            self,
            psf=psf,
            weight=self.weight.only(number),
            size=size,
            rough=None if self.rough is None else self.rough.only(number),
        )

    def some(self, rows: Rows) -> Job:
        """Return the job of the given galaxies; PSFs that galaxies share stay shared."""
        if self.psf.index is None:
            return self.take(rows)
        psf = replace(self.psf, index=rows_of(self.psf.index, rows))
        return replace(self, psf=psf, size=_of_rows(self.size, rows))

    def take(self, rows: Rows) -> Job:
        """Return the job of the given galaxies, with a PSF for each where there are several."""
        size = _of_rows(self.size, rows)
        if self.weight.shared:
            return replace(self, size=size)
        if isinstance(rows, slice):
            xp = array_namespace(kmax=self.psf.kmax)
            device = device_of(self.psf.kmax)
            rows = xp.arange(rows.start, rows.stop, dtype=xp.int64, device=device)
        numbers = self.psf.numbers_of(rows)
        return replace(
            self,
            psf=self.psf.take(rows),
            weight=self.weight.take(numbers),
            size=size,
            rough=None if self.rough is None else self.rough.take(numbers),
        )


def _of_rows(size: Array | None, rows: Rows) -> Array | None:
    """Return the sizes of the given galaxies; one for all stays."""
    return size if size is None or int(size.shape[0]) == 1 else rows_of(size, rows)


def in_order(chunks: list[Chunk]) -> Array | None:
    """Return where each galaxy is in what chunk after chunk gave; None if in its place."""
    if isinstance(chunks[0].rows, slice):
        return None
    xp = array_namespace(rows=chunks[0].rows)
    return xp.argsort(xp.concat([chunk.rows for chunk in chunks]))


def check_stamps(stamps: Array, psf: Psf) -> tuple[ModuleType, Array]:
    """Refuse what cannot be measured; return the namespace and the stamps as floats."""
    if not isinstance(psf, Psf):
        raise FdntTypeError(
            f"psf must be a Psf, not {type(psf).__name__}; make one with Psf.from_image"
        )
    xp = array_namespace(stamps=stamps, psf=psf.image)
    stamps = as_floating(xp, stamps, "stamps")
    require_dtype(stamps.dtype, psf=psf.image)
    if stamps.ndim != 3 or 0 in stamps.shape[1:]:
        raise ShapeMismatchError(
            f"stamps must have the shape (n_gal, ny, nx), not {tuple(stamps.shape)}"
        )
    n_gal = int(stamps.shape[0])
    if psf.n_gal not in (None, n_gal):
        raise ShapeMismatchError(
            f"psf is for {psf.n_gal} galaxies, but there are {n_gal} stamps; it must hold one "
            "PSF, one for each stamp, or have a psf_index for each"
        )
    return xp, stamps


def check_options(*, size: float | None, padding: int, chunk_size: int | None) -> None:
    """Refuse numbers that mean nothing."""
    if size is not None and not isinstance(size, numbers.Real):
        raise FdntTypeError(f"size must be a number, not {size!r}")
    if size is not None and not (math.isfinite(size) and size > 0):
        raise RangeError("size", float(size), 0.0, None)
    check_count("padding", padding, 1)
    if chunk_size is not None:
        check_count("chunk_size", chunk_size, 1)


def check_count(name: str, value: int, least: int) -> None:
    """Refuse what is not an integer from `least` up."""
    if not isinstance(value, numbers.Real) or (isinstance(value, float) and value % 1 == 0):
        raise FdntTypeError(f"{name} must be an integer, not {value!r}")
    if not isinstance(value, numbers.Integral) or value < least:
        raise RangeError(name, value, least, None)


def prepare(
    xp: ModuleType,
    stamps: Array,
    psf: Psf,
    *,
    padding: int,
    size: Array | None = None,
    matched: bool = True,
    max_iter: int = 0,
    rough: bool = False,
) -> Job:
    """Make the k grids and the tables of the weight.

    Parameters
    ----------
    matched : bool
        Whether the size of the weight may be the galaxy's.
    rough : bool
        Whether there is to be a first search under a weight that ends early.
    """
    ny, nx = (int(n) for n in stamps.shape[1:])
    shape = (padding * ny, padding * nx)
    cell = 2.0 * math.pi / min(ny, nx)
    if psf.largest_kmax < _FEWEST_CELLS * cell:
        raise FdntValueError(
            f"psf is too wide for stamps of {ny} x {nx} pixels: its transfer function ends at "
            f"{psf.largest_kmax:.3g} rad/pixel, and {_FEWEST_CELLS * cell:.3g} is the least that "
            "such stamps resolve"
        )
    like = {"dtype": stamps.dtype, "device": device_of(stamps)}
    early = psf.ending_at(_ROUGH_FLOOR) if rough else None
    return Job(
        psf=psf.restricted(_FEWEST_CELLS * cell),
        # A weight of this size is one cell of the k grid wide.
        weight=make_weight(psf, largest_size=1.0 / cell if matched else None),
        coarse=half_plane_disc(xp, shape, psf.largest_kmax, **like),
        fine=half_plane_disc(xp, (FINER * shape[0], FINER * shape[1]), psf.largest_kmax, **like),
        length=3.0 / psf.largest_kmax,
        size=size,
        max_iter=max_iter,
        rough=None if early is None else make_weight(early, 1.0 / cell, every=4),
        rough_kmax=math.pi if early is None else early.largest_kmax,
    )


def screen(stamps: Array, psf: Psf, present: Array | None = None) -> tuple[Array, Array]:
    """Return stamps that do no harm, zero where not finite, and why some cannot be measured.

    Parameters
    ----------
    stamps : array, shape (n_gal, ny, nx)
    psf : Psf
    present : array, shape (n_gal, ny, nx), bool, optional
        False where a pixel is missing: it is not looked at, and 0 in what is returned.

    Returns
    -------
    stamps : array, shape (n_gal, ny, nx)
    flags : array, shape (n_gal,), int32
        Zero, or a reason of `fdnt_xp.flags.Flag`.
    """
    xp = array_namespace(stamps=stamps)
    # Extremes along one long axis take a tenth of the time of those along two short ones.
    n_gal, ny, nx = (int(n) for n in stamps.shape)
    pixels = xp.reshape(stamps, (n_gal, ny * nx))
    if present is not None:
        present = xp.reshape(present, (n_gal, ny * nx))
        pixels = xp.where(present, pixels, xp.zeros_like(pixels))
    finite = xp.all(xp.isfinite(pixels), axis=-1)
    # A host read: a copy of all stamps costs more, and hardly ever is one needed.
    if not bool(xp.all(finite)):
        pixels = xp.where(finite[:, None], pixels, xp.zeros_like(pixels))
    seen_above, seen_below = pixels, pixels
    if present is not None:
        infinite = xp.full_like(pixels, float("inf"))
        seen_above = xp.where(present, pixels, -infinite)
        seen_below = xp.where(present, pixels, infinite)
    brightest, faintest = xp.max(seen_above, axis=-1), xp.min(seen_below, axis=-1)
    flags = xp.zeros_like(brightest, dtype=xp.int32)
    for reason, holds in (
        (Flag.NON_FINITE_PIXEL, ~finite),
        (Flag.NO_SIGNAL, finite & (brightest <= faintest)),
        (Flag.BAD_PSF, xp.broadcast_to(~psf.usable, finite.shape)),
    ):
        flags = flags + xp.astype(holds, xp.int32) * int(reason)
    return xp.reshape(pixels, stamps.shape), flags


def galaxies_at_once(grid: KGrid, stamps: Array, more: int = 0, *, only_tests: bool = False) -> int:
    """Return how many galaxies fit the memory of a chunk, with `more` numbers for each.

    With `only_tests` nothing but the tests is evaluated, which a CPU does block by block.
    """
    ny, nx = (int(length) for length in stamps.shape[1:])
    if only_tests and works_in_blocks(stamps):
        numbers = _FIELDS_IN_BLOCKS * grid.n_k + ny * nx + more
    else:
        numbers = _FIELDS * grid.n_k + 3 * ny * nx + more
    return max(16, int(_BYTES_AT_ONCE / (numbers * 8)))
