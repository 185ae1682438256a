"""Images from FITS and HDF5 files, left on disk where the file allows it."""

from __future__ import annotations

import os
import re
import warnings
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning
from numpy.typing import NDArray

from fdnt_xp.data import fits_pixels
from fdnt_xp.data.files import new_file
from fdnt_xp.data.fits_pixels import FitsSections, map_pixels
from fdnt_xp.data.hdf5 import Hdf5Pixels, is_hdf5, open_hdf5, split_name
from fdnt_xp.errors import CatalogError, FdntError

Pixels: TypeAlias = NDArray[Any] | Hdf5Pixels | FitsSections
"""Pixels as the file holds them: any number type, either byte order, perhaps on disk still."""

_SHAPES = {2: "an image (ny, nx)", 3: "a cube (n, ny, nx)"}
_UNREADABLE = (OSError, EOFError, ValueError, TypeError, KeyError, IndexError, zlib.error)
"""What astropy raises for a file that is not what it says; `VerifyError` has a class of its own."""


def read_image(
    path: str | os.PathLike[str], *, ndim: Collection[int] = (2,), what: str = "image"
) -> Pixels:
    """Open the pixels of a FITS or HDF5 file, without loading them if they can stay there.

    Parameters
    ----------
    path : path
        The file. Of FITS the first image is taken, or that of a named or numbered extension,
        `file.fits[SCI]` or `file.fits[2]`; of HDF5 (`.h5`, `.hdf5`) the only dataset, or the
        one that is named, `file.h5::dataset`.
    ndim : collection of int
        Which ranks will do: 2 for an image, 3 for a cube.
    what : str
        What the file is to the caller, for messages.

    Returns
    -------
    array, shape (ny, nx) or (n, ny, nx)
        As in the file, read where it is indexed; `native_pixels` makes numbers for computing
        of it, or of a part.

    Raises
    ------
    CatalogError
        If there is no such file, it is truncated or not what its name says, it has no such
        image, or the image has another rank.
    MissingExtraError
        For HDF5 without h5py.
    """
    if is_hdf5(path):
        return _of_rank(open_hdf5(path, what=what), ndim, f"the {what} {os.fspath(path)}")
    file, extension = _split(path)
    if not file.is_file():
        problem = "is a folder" if file.is_dir() else "does not exist"
        raise CatalogError(f"cannot read the {what}: {file} {problem}")
    with fits_errors(file, what):
        pixels = _first_image(file, extension, what)
    return _of_rank(pixels, ndim, f"the {what} {file}")


@contextmanager
def fits_errors(file: Path, what: str) -> Iterator[None]:
    """Let whatever astropy says of a broken file be one `CatalogError` that names it.

    Parameters
    ----------
    file : Path
    what : str
        What the file is to the caller, for messages.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            yield
        except FdntError:
            raise
        except (*_UNREADABLE, fits.VerifyError) as error:
            reason = _truncation(caught) or re.split(r"\n|\. ", str(error))[0]
            raise CatalogError(f"cannot read the {what} {file}: {reason}") from error
    if reason := _truncation(caught):
        raise CatalogError(f"cannot read the {what} {file}: {reason}")


def read_header(path: str | os.PathLike[str], *, what: str = "image") -> fits.Header:
    """Return the header of the image that `read_image` takes of a file, which says what it raises.

    What an image in an extension inherits from the first header is not looked at.
    """
    file, extension = _split(path)
    read_image(path, ndim=(2, 3), what=what)  # for its messages
    with file.open("rb") as stream, fits.open(stream, memmap=True) as hdus:
        chosen = [hdus[extension]] if extension is not None else hdus
        return next(hdu.header.copy() for hdu in chosen if hdu.is_image and hdu.shape)


def native_pixels(pixels: Pixels) -> NDArray[Any]:
    """Return a contiguous floating-point copy in memory, in the machine's byte order.

    float32 and float64 keep their precision, everything else becomes float64.
    """
    name = pixels.dtype.name if pixels.dtype.name in ("float32", "float64") else "float64"
    return np.array(pixels, dtype=name, order="C")


def write_image(
    pixels: Pixels, path: str | os.PathLike[str], *, overwrite: bool = False, **cards: Any
) -> None:
    """Write an image or a cube as FITS, whole or not at all.

    Parameters
    ----------
    pixels : array
        What to write.
    path : path
        Where; an existing file is refused unless `overwrite` is True.
    overwrite : bool
        Whether a file that exists may be replaced.
    **cards
        Header keywords and their values.
    """
    hdu = fits.PrimaryHDU(pixels)
    for keyword, value in cards.items():
        hdu.header[keyword.upper()] = value
    with new_file(path, overwrite=overwrite) as temporary:
        hdu.writeto(temporary)


def image_file(path: str | os.PathLike[str]) -> Path:
    """Return the file of a name that `read_image` takes."""
    return split_name(path)[0] if is_hdf5(path) else _split(path)[0]


def _of_rank(pixels: Pixels, ndim: Collection[int], name: str) -> Pixels:
    if pixels.ndim not in ndim:
        expected = " or ".join(_SHAPES.get(n, f"rank {n}") for n in sorted(ndim))
        raise CatalogError(
            f"{name} has {pixels.ndim} axes, shape {pixels.shape}; expected {expected}"
        )
    return pixels


def _split(path: str | os.PathLike[str]) -> tuple[Path, str | int | None]:
    """Take the extension off `file.fits[ext]`, unless a file has just that name."""
    match = re.fullmatch(r"(.+)\[([^\[\]]+)\]", os.fspath(path))
    if match is None or Path(path).exists():
        return Path(path), None
    name = match[2].strip()
    return Path(match[1]), int(name) if name.isdecimal() else name


def _first_image(file: Path, extension: str | int | None, what: str) -> Pixels:
    # Astropy leaves a file that is broken open, unless it is ours to close.
    with file.open("rb") as stream, fits.open(stream, memmap=True) as hdus:
        if extension is not None:
            if extension not in hdus if isinstance(extension, str) else extension >= len(hdus):
                names = ", ".join(f"{i} {hdu.name}".strip() for i, hdu in enumerate(hdus))
                raise CatalogError(
                    f"the {what} {file} has no extension {extension!r}; it has {names}"
                )
            chosen = [hdus[extension]]
        else:
            chosen = hdus
        for hdu in chosen:
            if hdu.is_image and hdu.shape and all(hdu.shape):
                break
        else:
            raise CatalogError(f"the {what} {file} holds no image")
        index = hdus.index_of(hdu)
        if not isinstance(hdu, fits.CompImageHDU):
            try:
                mapped = map_pixels(file, hdu)
                return np.asarray(hdu.data) if mapped is None else mapped
            except ValueError as error:
                if "memory-map" not in str(error):
                    raise
    # Pixels that are packed, or stored scaled (BZERO, BSCALE), have to be computed.
    with file.open("rb") as stream, fits.open(stream, memmap=False) as hdus:
        hdu = hdus[index]
        first = np.asarray(hdu.section[:1])
        if first.nbytes * hdu.shape[0] > fits_pixels.IN_MEMORY:
            return FitsSections(file=file, number=index, shape=hdu.shape, dtype=first.dtype)
        return np.asarray(hdu.data)


def _truncation(caught: list[warnings.WarningMessage]) -> str | None:
    for warning in caught:
        if issubclass(warning.category, AstropyWarning) and "truncated" in str(warning.message):
            return "it is truncated" + str(warning.message).partition("truncated")[2]
    return None
