"""Missing pixels of a sample: which stamps can be used, and with what in the gaps.

A hole in a stamp has a shape, and the quadrupole of the galaxy takes it over. To leave out
every stamp with a hole is unbiased, for where the holes are does not depend on the
galaxies. To fill the holes is nearly so, if they are small (docs, "Missing pixels").
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import ModuleType
from typing import Final, Literal, TypeAlias

from fdnt_xp.arrays import Array, Rows, array_namespace, device_of, rows_of
from fdnt_xp.errors import FdntTypeError, FdntValueError, ShapeMismatchError
from fdnt_xp.fourier.missing import fill_missing
from fdnt_xp.fourier.psf import Psf

Masked: TypeAlias = Literal["drop", "fill"]

_FOOTPRINT: Final = 5.0
"""Radius of the pixels that matter, in sizes of the weight on the image: it is 4e-6 there."""
_MOST_MISSING: Final = 0.1
"""Part of the weight on the image that may be on missing pixels, to be filled."""
_MOST_OF_A_LINE: Final = 0.5
"""Part of a row or column near the middle that may be missing. In a longer gap the filling
has the noise of its two neighbours, which has a direction: c = -2e-3 at S/N 20."""


@dataclass(frozen=True, kw_only=True)
class SampleMask:
    """Missing pixels, and what is done about them.

    Parameters
    ----------
    missing : array, shape (n_gal, ny, nx), bool
    fill : bool
        Whether small gaps are filled; all stamps with a gap are left out otherwise.
    size : float
        sigma of the weight as it is on the image, pixels.
    """

    missing: Array
    fill: bool
    size: float

    @classmethod
    def of(
        cls, xp: ModuleType, stamps: Array, mask: Array | None, masked: str, size: float
    ) -> SampleMask | None:
        """Return what a caller says, checked.

        Parameters
        ----------
        mask : array, shape (n_gal, ny, nx), bool, or None
            True where a pixel is missing.
        masked : {"drop", "fill"}
        size : float
            Size of the weight on the image, pixels.
        """
        if masked not in ("drop", "fill"):
            raise FdntValueError(f'masked must be "drop" or "fill", not {masked!r}')
        if mask is None:
            return None
        array_namespace(stamps=stamps, mask=mask)
        if not xp.isdtype(mask.dtype, "bool"):
            raise FdntTypeError(f"mask must be boolean, True where missing, not {mask.dtype}")
        if mask.shape != stamps.shape:
            raise ShapeMismatchError(
                f"mask must have the shape of the stamps, {tuple(stamps.shape)}, not "
                f"{tuple(mask.shape)}"
            )
        return cls(missing=mask, fill=masked == "fill", size=size)

    def take(self, rows: Rows) -> SampleMask:
        """Return the mask of the given galaxies."""
        return replace(self, missing=rows_of(self.missing, rows))

    def applied(self, stamps: Array, psf: Psf) -> tuple[Array, Array, Array]:
        """Return stamps without gaps, and which are left out and which were filled.

        Returns
        -------
        stamps : array, shape (n_gal, ny, nx)
            Gaps far from the middle are 0; what is left out is 0 there too.
        dropped, filled : array, shape (n_gal,), bool
        """
        xp = array_namespace(stamps=stamps)
        square = self._square_radius(stamps)
        near = square <= (_FOOTPRINT * self.size) ** 2
        holes = self.missing & near
        any_hole = xp.any(xp.any(self.missing, axis=-1), axis=-1)
        if self.fill:
            filled = any_hole & self._small(holes, near, square)
        else:
            filled = xp.zeros_like(any_hole)
        stamps = xp.where(self.missing, xp.zeros_like(stamps), stamps)
        if self.fill:
            stamps = fill_missing(stamps, holes & filled[:, None, None], psf)
        return stamps, any_hole & ~filled, filled

    def _small(self, holes: Array, near: Array, square: Array) -> Array:
        """Return whose holes, among the pixels near the middle, are small; (n_gal,)."""
        xp = array_namespace(square=square)
        weight = xp.exp(-0.5 * square / self.size**2)
        share = xp.sum(xp.sum(xp.where(holes, weight, xp.zeros_like(weight)), axis=-1), axis=-1)
        small = share <= _MOST_MISSING * xp.sum(weight)
        for axis in (-2, -1):
            missing = xp.astype(xp.count_nonzero(holes, axis=axis), square.dtype)
            there = xp.astype(xp.count_nonzero(near, axis=axis), square.dtype)
            # Lines that only touch the circle are short, and far out.
            long = (there > _FOOTPRINT * self.size) & (missing > _MOST_OF_A_LINE * there)
            small = small & ~xp.any(long, axis=-1)
        return small

    def _square_radius(self, stamps: Array) -> Array:
        """Return the square distance of pixels from the middle, shape (1, ny, nx)."""
        xp = array_namespace(stamps=stamps)
        ny, nx = (int(n) for n in stamps.shape[1:])
        like = {"dtype": stamps.dtype, "device": device_of(stamps)}
        x = xp.arange(nx, **like) - 0.5 * (nx - 1)
        y = xp.arange(ny, **like) - 0.5 * (ny - 1)
        return x[None, None, :] ** 2 + y[None, :, None] ** 2
