"""Multi-epoch data structures (MEDS): all exposures of each object of a tile, in one FITS file.

The format is that of github.com/esheldon/meds/wiki/MEDS-Format: a table `object_data` with a
row for each object, and extensions of one axis in which the cutouts lie one after the other,
`image_cutouts` and, if there are any, `weight_cutouts`, `bmask_cutouts`, `seg_cutouts` and
`psf`. Rows are y and columns x; positions are 0-based there as here.

A pixel is missing where its weight is 0, where the bit mask has a bad bit, and where the
segmentation map has the number of another object.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from fdnt_xp.data.exposures import ExposureBatch, distinct_stars
from fdnt_xp.data.images import fits_errors
from fdnt_xp.data.meds_index import CUTOUTS, CutoutIndex, Cutouts, index_cutouts
from fdnt_xp.errors import CatalogError, FdntValueError, FdntWarning, RangeError

Segments: TypeAlias = Literal["mask", "ignore"]
SEGMENTS: Final = ("mask", "ignore")
"""What becomes of pixels that the segmentation map gives to another object."""

_WHAT: Final = "MEDS file"
_SPREAD: Final = 4
"""Cutouts are read as one piece of the file unless it is so many times as long as they are."""
_LOOKED_AT: Final = 64
"""Cutouts on which the segmentation map is looked at when a file is opened."""


@dataclass(frozen=True, kw_only=True)
class MedsOptions:
    """What is taken of a MEDS file.

    Parameters
    ----------
    cutouts : {"all", "epochs", "first"}
        All cutouts of an object, all but the first, or the first alone. By the convention of
        most surveys the first is cut from the coadd of the others, but not in all files.
    bad_bits : int, optional
        Bits of `bmask_cutouts` that make a pixel missing; every bit without it, 0 for none.
    segments : {"mask", "ignore"}
        Whether pixels of other objects in `seg_cutouts` are missing. The number of an object
        there is that of the column `number`, or else `id`.
    noise_variance : float, optional
        Of every pixel, for a file without `weight_cutouts`.
    star : array, shape (py, px), optional
        The PSF of all cutouts, in place of those of the file.

    Raises
    ------
    FdntValueError, RangeError
        If one of them is none of these.
    """

    cutouts: Cutouts = "all"
    bad_bits: int | None = None
    segments: Segments = "mask"
    noise_variance: float | None = None
    star: NDArray[Any] | None = None

    def __post_init__(self) -> None:
        for name, known in (("cutouts", CUTOUTS), ("segments", SEGMENTS)):
            if getattr(self, name) not in known:
                raise FdntValueError(f"no {name} {getattr(self, name)!r}; known are {known}")
        if self.noise_variance is not None and not 0 < self.noise_variance < np.inf:
            raise RangeError("noise_variance", self.noise_variance, 0.0, None)
        if self.bad_bits is not None and self.bad_bits < 0:
            raise RangeError("bad_bits", self.bad_bits, 0, None)


@dataclass(frozen=True, kw_only=True)
class MedsFile:
    """An open MEDS file; made by `open_meds`.

    Parameters
    ----------
    path : Path
    options : MedsOptions
    index : CutoutIndex
        Where its cutouts are.
    pixels : dict
        The extensions that are used, by their names without `_cutouts`.
    """

    path: Path
    options: MedsOptions
    index: CutoutIndex
    pixels: dict[str, Any]

    def read(self, rows: NDArray[np.integer[Any]]) -> ExposureBatch:
        """Return the stamps of some objects, in the order of `rows`.

        Raises
        ------
        CatalogError
            If the file cannot be read.
        FdntValueError
            If their cutouts are of several sizes, and nothing is known of the noise.
        """
        index = self.index
        which, object_index = index.of_objects(rows)
        with fits_errors(self.path, _WHAT):
            stamps = self._stamps("image", which)
            missing = self._missing(which)
            ivar = self._ivar(which, stamps, missing)
            stars, psf_index = self._stars(which, stamps.dtype)
        variance = self.options.noise_variance
        if ivar is None and variance is not None:
            noise = np.full(len(which), variance, dtype=stamps.dtype)
        else:
            noise = None
        return ExposureBatch(
            ids=index.ids[rows],
            object_index=object_index,
            stamps=stamps,
            stars=stars,
            psf_index=psf_index,
            origin=index.origin[which],
            jacobian=index.jacobian[which],
            ivar=ivar,
            noise_variance=noise,
        )

    def _stamps(self, name: str, which: NDArray[np.int64]) -> NDArray[Any]:
        """Return cutouts of an extension; where one is smaller than another, with zeros."""
        boxes = self.index.boxes[which]
        side = int(np.max(boxes, initial=0)) or 1
        dtype = _native(self.pixels[name])
        stamps = np.zeros((len(which), side, side), dtype=dtype)
        for box in np.unique(boxes):
            of_box = boxes == box
            cut = _take(self.pixels[name], self.index.starts[which[of_box]], int(box) ** 2)
            stamps[of_box, :box, :box] = cut.reshape(-1, box, box)
        return stamps if name in ("seg", "bmask") else stamps.astype(_floating(dtype), copy=False)

    def _missing(self, which: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which pixels are bad, of another object, or not on the cutout at all."""
        boxes = self.index.boxes[which]
        side = np.arange(int(np.max(boxes, initial=0)) or 1)
        beyond = side >= boxes[:, None]
        missing: NDArray[np.bool_] = beyond[:, :, None] | beyond[:, None, :]
        if "bmask" in self.pixels:
            bits = self._stamps("bmask", which)
            if self.options.bad_bits is not None:
                bits = bits.astype(np.int64) & self.options.bad_bits
            missing |= bits != 0
        if "seg" in self.pixels:
            segments = self._stamps("seg", which)
            own = self.index.numbers[self.index.object_index[which]]
            missing |= (segments != 0) & (segments != own[:, None, None])
        return missing

    def _ivar(
        self, which: NDArray[np.int64], stamps: NDArray[Any], missing: NDArray[np.bool_]
    ) -> NDArray[Any] | None:
        variance = self.options.noise_variance
        if "weight" in self.pixels:
            ivar = self._stamps("weight", which).astype(stamps.dtype)
        elif not np.any(missing):
            return None
        elif variance is not None:
            ivar = np.full(stamps.shape, 1.0 / variance, dtype=stamps.dtype)
        else:
            raise FdntValueError(
                f"{self.path} has no weights, without which stamps of several sizes cannot be "
                "made equal by missing pixels: read one size at a time, or give the noise variance"
            )
        ivar[missing] = 0.0
        return ivar

    def _stars(
        self, which: NDArray[np.int64], dtype: np.dtype[Any]
    ) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """Return the different PSFs, of one shape, and which each cutout has."""
        if self.options.star is not None or not len(which):
            star = np.ones((1, 1)) if self.options.star is None else self.options.star
            return star[None].astype(dtype), np.zeros(len(which), dtype=np.int64)
        keys = np.column_stack([self.index.psf_starts[which], self.index.psf_shapes[which]])
        different, index = np.unique(keys, axis=0, return_inverse=True)
        ny, nx = np.max(different[:, 1:], axis=0)
        stars = np.zeros((len(different), ny, nx), dtype=dtype)
        for rows, columns in np.unique(different[:, 1:], axis=0):
            of_shape = np.all(different[:, 1:] == (rows, columns), axis=1)
            cut = _take(self.pixels["psf"], different[of_shape, 0], int(rows * columns))
            stars[of_shape, :rows, :columns] = cut.reshape(-1, rows, columns)
        stars, number = distinct_stars(stars)
        return stars, number[index.reshape(-1)]


@contextmanager
def open_meds(
    path: str | os.PathLike[str], options: MedsOptions | None = None
) -> Iterator[MedsFile]:
    """Open a MEDS file; its pixels are read when they are asked for, packed by fpack or not.

    A cutout that the table promises, but that lies outside the extensions, is left out
    (`CutoutIndex.n_lost`, and an `FdntWarning`): no object makes a file unreadable.

    Parameters
    ----------
    path : path
    options : MedsOptions, optional

    Raises
    ------
    CatalogError
        If there is no such file, it is broken or no MEDS file (the message says what it
        lacks), there is no PSF in it and none was given, or its segmentation map knows none
        of the objects.
    FdntValueError
        If a noise variance is given for a file with weights, or none for one that has masks
        but no weights.
    """
    options = options or MedsOptions()
    file = Path(path)
    if not file.is_file():
        problem = "is a folder" if file.is_dir() else "does not exist"
        raise CatalogError(f"cannot read the {_WHAT}: {file} {problem}")
    with ExitStack() as stack:
        with fits_errors(file, _WHAT):
            # Astropy leaves a file that is broken open, unless it is ours to close. Not mapped:
            # what has been read of a map stays in memory until another wants it.
            stream = stack.enter_context(file.open("rb"))
            hdus = stack.enter_context(fits.open(stream, memmap=False))
            meds = _found(file, hdus, options)
        if meds.index.n_lost:
            warnings.warn(
                f"{meds.index.n_lost} cutouts that object_data of {file} promises lie outside its "
                "extensions and are left out",
                FdntWarning,
                stacklevel=3,
            )
        yield meds


def _found(file: Path, hdus: Any, options: MedsOptions) -> MedsFile:
    """Find the extensions, and the cutouts in them."""
    pixels = _extensions(file, hdus, options)
    index = index_cutouts(
        hdus["object_data"].data,
        cutouts=options.cutouts,
        length=pixels["image"].shape[0],
        psf_length=pixels["psf"].shape[0] if "psf" in pixels else None,
        table=f"object_data of {file}",
    )
    meds = MedsFile(path=file, options=options, index=index, pixels=pixels)
    _check_segments(meds)
    return meds


def _extensions(file: Path, hdus: Any, options: MedsOptions) -> dict[str, Any]:
    """Return the extensions of pixels that are wanted, by their names without `_cutouts`."""
    there = {hdu.name.lower(): hdu for hdu in hdus}
    if lacking := [name for name in ("object_data", "image_cutouts") if name not in there]:
        raise CatalogError(
            f"{file} is no MEDS file: it has no extension {' and no '.join(lacking)}"
        )
    if not isinstance(there["object_data"], fits.BinTableHDU):
        raise CatalogError(f"object_data of {file} is no table")
    wanted = ["image", "weight"]
    wanted += ["bmask"] if options.bad_bits != 0 else []
    wanted += ["seg"] if options.segments == "mask" else []
    found = {name: there[f"{name}_cutouts"] for name in wanted if f"{name}_cutouts" in there}
    for name, hdu in found.items():
        if hdu.shape != found["image"].shape or len(hdu.shape) != 1:
            raise CatalogError(
                f"{name}_cutouts of {file} has the shape {hdu.shape}; it must have one axis, and "
                f"the shape of image_cutouts, {found['image'].shape}"
            )
    if "weight" in found and options.noise_variance is not None:
        raise FdntValueError(
            f"the weights of {file} say what the noise of each pixel is: give no noise variance"
        )
    if "weight" not in found and options.noise_variance is None and len(found) > 1:
        raise FdntValueError(
            f"{file} has no weight_cutouts, and a mask alone does not say how noisy the other "
            "pixels are: give the noise variance"
        )
    if options.star is None:
        if "psf" not in there:
            raise CatalogError(f"{file} has no extension psf, and no PSF was given")
        found["psf"] = there["psf"]
    return found


def _check_segments(meds: MedsFile) -> None:
    """Refuse a map in which the objects do not have their own numbers: all would be masked."""
    if "seg" not in meds.pixels or not meds.index.n_cutouts:
        return
    which = np.arange(min(_LOOKED_AT, meds.index.n_cutouts))
    segments = meds._stamps("seg", which)
    own = meds.index.numbers[meds.index.object_index[which]][:, None, None]
    if np.any(segments != 0) and not np.any((segments == own) & (segments != 0)):
        raise CatalogError(
            f"seg_cutouts of {meds.path} does not have the numbers of the objects, so that none "
            "would keep its own pixels: ignore the segments"
        )


def _take(hdu: Any, starts: NDArray[np.int64], length: int) -> NDArray[Any]:
    """Return pieces of an extension, shape (n, length)."""
    first, last = int(np.min(starts)), int(np.max(starts)) + length
    if last - first <= _SPREAD * length * len(starts):
        piece = np.asarray(hdu.section[first:last])
        pieces: NDArray[Any] = piece[(starts - first)[:, None] + np.arange(length)]
        return pieces
    return np.stack([np.asarray(hdu.section[start : start + length]) for start in starts])


def _native(hdu: Any) -> np.dtype[Any]:
    """Return the dtype of the pixels of an extension, in the byte order of the machine."""
    dtype: np.dtype[Any] = np.asarray(hdu.section[0:1]).dtype
    return dtype.newbyteorder("=")


def _floating(dtype: np.dtype[Any]) -> np.dtype[Any]:
    return np.dtype("float32" if dtype.name == "float32" else "float64")
