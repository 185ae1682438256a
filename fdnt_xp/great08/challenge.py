"""A directory of the GREAT08 challenge: images of sets, a map from sets to PSFs, PSFs.

::

    set0001.fit, set0002.fit, ...   a grid of square cells with one galaxy in each
    psf_map.txt                     a header line, then on each line a set and its PSF
    psf_fiducial.fit                a star, the pixel response included; or
    psf_fiducial.moffat             an analytic PSF (`fdnt_xp.great08.moffat`)
    truth.ecsv                      the true shears, where they are known
                                    (`fdnt_xp.great08.truth`)

PSFs may lie in a folder `psf`. Reading a directory looks at names and at the map alone; an
image that is truncated or a star that is none is found when its set is read.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from fdnt_xp.data.images import native_pixels, read_image
from fdnt_xp.data.stamps import SMALLEST_STAMP, StampSource, grid_stamps
from fdnt_xp.errors import CatalogError, RangeError, ShapeMismatchError
from fdnt_xp.great08.moffat import MOFFAT_OVERSAMPLING, MOFFAT_SUFFIX, read_moffat

CELL: Final = 40
"""Pixels on a side of a cell of the challenge itself, where nothing says otherwise."""
PSF_MAP: Final = "psf_map.txt"
PARAMETERS: Final = "great08.json"
"""What a simulated directory was made with."""
_IMAGE_SUFFIXES: Final = (".fit", ".fits")
_SET: Final = re.compile(r"(?:set)?0*(\d+)(?:\.fits?)?", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True)
class ChallengeSet:
    """One image, whose galaxies have one shear and one PSF.

    Parameters
    ----------
    number : int
        1 for `set0001`.
    name : str
        `set0001`.
    image : Path
        Its image.
    psf : Path
        Star image, or Moffat file.
    cell : int
        Pixels on a side of a cell.
    """

    number: int
    name: str
    image: Path
    psf: Path
    cell: int

    def open_stamps(self) -> StampSource:
        """Return the galaxies without reading their pixels, along x first.

        Raises
        ------
        CatalogError
            If the image cannot be read, or says that its cells are of another size.
        ShapeMismatchError
            If it is not a whole number of cells.
        """
        pixels = read_image(self.image, what="image of a set")
        said = _card(self.image, "CELL")
        if said is not None and said != self.cell:
            raise CatalogError(
                f"{self.image} says that its cells have {said} pixels, but {self.cell} were given"
            )
        try:
            return grid_stamps(pixels, self.cell)
        except ShapeMismatchError as error:
            raise ShapeMismatchError(f"{self.image}: {error}") from error

    def read_stamps(self) -> NDArray[np.floating[Any]]:
        """Return the stamps, shape (n_gal, cell, cell), float32 or float64 as in the file."""
        source = self.open_stamps()
        return source.take(np.arange(source.n_gal))

    def read_psf(self) -> tuple[NDArray[np.floating[Any]], float]:
        """Return the image of a star, pixel response included, and its oversampling.

        An analytic PSF is drawn, `MOFFAT_OVERSAMPLING` times finer than the galaxies.

        Returns
        -------
        array, shape (ny, nx)
        float
            Pixels of it per pixel of the galaxies, along one axis.

        Raises
        ------
        CatalogError
            If the file cannot be read, or its card OVERSAMP is no positive number.
        MissingExtraError
            If it is analytic and GalSim is not installed.
        """
        if self.psf.suffix.lower() == MOFFAT_SUFFIX:
            moffat = read_moffat(self.psf)
            return moffat.draw(self.cell, MOFFAT_OVERSAMPLING), float(MOFFAT_OVERSAMPLING)
        pixels = native_pixels(read_image(self.psf, what="PSF"))
        said = _card(self.psf, "OVERSAMP")
        oversampling = 1.0 if said is None else said
        if isinstance(oversampling, bool) or not isinstance(oversampling, int | float):
            raise CatalogError(f"the card OVERSAMP of {self.psf} is {said!r}, not a number")
        if not (np.isfinite(oversampling) and oversampling > 0):
            raise CatalogError(f"the card OVERSAMP of {self.psf} must be positive, not {said}")
        return pixels, float(oversampling)


@dataclass(frozen=True, kw_only=True)
class Challenge:
    """What a directory holds.

    Parameters
    ----------
    directory : Path
        Where it is.
    sets : tuple of ChallengeSet
        Those with an image and a PSF, by number.
    missing : tuple of int
        Sets of the PSF map that have no image.
    unmapped : tuple of str
        Names of sets that have an image, but no PSF in the map.
    """

    directory: Path
    sets: tuple[ChallengeSet, ...]
    missing: tuple[int, ...]
    unmapped: tuple[str, ...]


def read_challenge(
    directory: str | os.PathLike[str],
    *,
    cell: int | None = None,
    psf_map: str | os.PathLike[str] = PSF_MAP,
) -> Challenge:
    """Look through a directory of the challenge.

    Parameters
    ----------
    directory : path
        The directory.
    cell : int, optional
        Pixels on a side of a cell. If not given it is what `great08.json` says, and 40, as in
        the challenge itself, where there is no such file.
    psf_map : path
        The map, in the directory unless it is absolute. Sets are numbers or names, with or
        without `.fit`; PSFs are names of files, with or without their suffix, in the
        directory or in `psf/`. Lines that are empty or begin with `#` mean nothing.

    Raises
    ------
    CatalogError
        If there is no such directory, no image in it, or no map; if a line of the map is not
        understood or a set occurs twice; if a PSF may be one of several files.
    RangeError
        If `cell` is too small.
    """
    folder = Path(directory)
    if not folder.is_dir():
        problem = "is not a folder" if folder.exists() else "does not exist"
        raise CatalogError(f"cannot read the challenge: {folder} {problem}")
    images = _images(folder)
    if not images:
        raise CatalogError(f"{folder} holds no image of a set, such as set0001.fit")
    psfs = _read_map(folder / psf_map)
    size = _cell(folder) if cell is None else cell
    if size < SMALLEST_STAMP:
        raise RangeError("cell", size, SMALLEST_STAMP, None)
    sets = [
        ChallengeSet(
            number=number,
            name=set_name(number),
            image=image,
            psf=_psf_file(folder, psfs[number]),
            cell=size,
        )
        for number, image in images.items()
        if number in psfs
    ]
    return Challenge(
        directory=folder,
        sets=tuple(sets),
        missing=tuple(sorted(psfs.keys() - images.keys())),
        unmapped=tuple(set_name(number) for number in sorted(images.keys() - psfs.keys())),
    )


def set_name(number: int) -> str:
    """Return `set0001` for 1."""
    return f"set{number:04d}"


def set_number(text: str) -> int | None:
    """Return 1 for `1`, `0001`, `set0001` or `set0001.fit`; None for what is no set."""
    match = _SET.fullmatch(text.strip())
    return None if match is None else int(match[1])


def _images(folder: Path) -> dict[int, Path]:
    """Return the images by number, in order."""
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        number = set_number(path.stem) if path.stem.lower().startswith("set") else None
        if number is None or path.suffix.lower() not in _IMAGE_SUFFIXES:
            continue
        if number in found:
            raise CatalogError(f"{found[number]} and {path.name} are both set {number}")
        found[number] = path
    return dict(sorted(found.items()))


def _read_map(path: Path) -> dict[int, str]:
    """Return the PSF of each set."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text"
        raise CatalogError(f"cannot read the PSF map {path}: {reason}") from error
    psfs: dict[int, str] = {}
    for number, psf in _rows(lines, path):
        if number in psfs:
            raise CatalogError(f"the PSF map {path} has set {number} more than once")
        psfs[number] = psf
    if not psfs:
        raise CatalogError(f"the PSF map {path} names no set")
    return psfs


def _rows(lines: list[str], path: Path) -> Iterator[tuple[int, str]]:
    first = True
    for place, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        number = set_number(words[0])
        if number is None and first:  # the header line
            first = False
            continue
        first = False
        if number is None or len(words) != 2:
            raise CatalogError(
                f"line {place} of the PSF map {path} must be a set and a PSF, not {line.strip()!r}"
            )
        yield number, words[1]


def _psf_file(folder: Path, name: str) -> Path:
    """Return the file that a name in the map means; it need not exist if none does."""
    places = [folder / name, folder / "psf" / name]
    suffixes = (*_IMAGE_SUFFIXES, MOFFAT_SUFFIX)
    if not name.lower().endswith(suffixes):
        places = [place.with_name(place.name + suffix) for place in places for suffix in suffixes]
    found = [place for place in places if place.is_file()]
    if len(found) > 1:
        named = ", ".join(str(place.relative_to(folder)) for place in found)
        raise CatalogError(
            f"the PSF {name!r} in {folder} may be {named}: keep one, or name it with its suffix"
        )
    return found[0] if found else places[0]


def _cell(folder: Path) -> int:
    """Return what a simulated directory says, else GREAT08's own."""
    path = folder / PARAMETERS
    if not path.is_file():
        return CELL
    try:
        cell = json.loads(path.read_text(encoding="utf-8"))["parameters"]["cell"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CatalogError(f"cannot read the cell size from {path}; give it (cell)") from error
    if isinstance(cell, bool) or not isinstance(cell, int):
        raise CatalogError(f"the cell size in {path} is {cell!r}, not a number of pixels")
    return cell


def _card(path: Path, keyword: str) -> Any:
    """Return a card of the first header, None where there is none."""
    try:
        return fits.getheader(path).get(keyword)
    except Exception as error:
        # The pixels could be read: whatever astropy chokes on is in this header.
        raise CatalogError(f"cannot read the header of {path}: {error}") from error
