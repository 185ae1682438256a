"""Star images from the models that people hold: GalSim objects, Piff, PSFEx.

What the library measures with is the image of a star, pixel response included. These models
draw one at any position of an exposure; `draw_stars` has each different one drawn once, and
says which of them each galaxy has::

    stars = draw_stars(read_piff("exposure.piff"), positions)
    psf = fx.Psf.from_image(stars.images, psf_index=stars.psf_index)

Nothing here needs the packages of the models but the two readers.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike, NDArray

from fdnt_xp.data.profiles import load_galsim
from fdnt_xp.errors import (
    CatalogError,
    FdntTypeError,
    FdntValueError,
    MissingExtraError,
    RangeError,
    ShapeMismatchError,
)
from fdnt_xp.fourier.jacobian import is_regular

_SMALLEST: Final = 8
"""Pixels on a side below which there is no star."""


@dataclass(frozen=True, kw_only=True)
class StarImages:
    """The stars of some galaxies, ready for `Psf.from_image`.

    Parameters
    ----------
    images : array, shape (n_psf, size, size), float64
        Pixel response included; NaN for galaxies whose position or Jacobian is no such thing,
        which are then flagged `BAD_PSF`.
    psf_index : array, shape (n_gal,), int64
        Which star each galaxy has.
    oversampling : float
        Pixels of `images` per pixel of the galaxies, along one axis.
    """

    images: NDArray[np.float64]
    psf_index: NDArray[np.int64]
    oversampling: float


def draw_stars(
    model: Any,
    positions: ArrayLike,
    *,
    size: int = 48,
    jacobian: ArrayLike | None = None,
    oversampling: float = 1.0,
    cell: float | None = None,
    properties: dict[str, Any] | None = None,
) -> StarImages:
    """Draw the star that a model of the PSF has at each position.

    Parameters
    ----------
    model : galsim.GSObject, piff.PSF or galsim.des.DES_PSFEx
        A GalSim object is the PSF without the pixel, everywhere the same, in units of the
        sky. The others know their pixels. They are told apart by their methods:
        `get_profile` and `draw`, `getPSF` and `getLocalWCS`, `drawImage`.
    positions : array, shape (n_gal, 2)
        (x, y) of the galaxies on the exposure, 0-based, integer at pixel centres. Piff and
        PSFEx count from 1, and are asked so.
    size : int
        Side of the images, in their pixels.
    jacobian : array, shape (2, 2) or (n_gal, 2, 2), optional
        `d(u, v)/d(x, y)` of the pixels, for a GalSim object; by default they are squares of
        side 1. The image is that on the pixels in any case.
    oversampling : float
        Pixels of the images per pixel of the galaxies; the response is that of the latter.
        Piff draws none but its own.
    cell : float, optional
        Side, in pixels, of square cells of the exposure whose galaxies share the star of the
        middle. By default each position has its own.
    properties : dict, optional
        What a Piff model asks for besides: `chipnum`, colours; each one value or one for
        each galaxy.

    Raises
    ------
    FdntTypeError
        If `model` is no such model.
    ShapeMismatchError
        If an array has another shape.
    RangeError, FdntValueError
        If a number is out of range, or an option is not for this kind of model.
    MissingExtraError
        If GalSim is needed and not installed.
    """
    kind = _kind(model)
    if size != int(size) or size < _SMALLEST:
        raise RangeError("size", size, _SMALLEST, None)
    if not (np.isfinite(oversampling) and oversampling > 0.0):
        raise RangeError("oversampling", oversampling, 0.0, None)
    if cell is not None and not (np.isfinite(cell) and cell > 0.0):
        raise RangeError("cell", cell, 0.0, None)
    if kind != "galsim" and jacobian is not None:
        raise FdntValueError("jacobian is for GalSim objects; Piff and PSFEx know their pixels")
    if kind != "piff" and properties:
        raise FdntValueError("properties are for Piff models; this one has none")
    if kind == "piff" and oversampling != 1.0:
        raise FdntValueError("oversampling must be 1 for Piff, which draws on its own pixels")
    xy = np.asarray(positions, dtype=np.float64)
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise ShapeMismatchError(f"positions must have the shape (n_gal, 2), not {xy.shape}")
    if cell is not None:
        xy = (np.floor((xy + 0.5) / cell) + 0.5) * cell - 0.5
    galaxies: Iterator[tuple[bool, Hashable]]
    drawer: Callable[[Any], NDArray[np.float64]]
    if kind == "galsim":
        drawer = _SameEverywhere(model, int(size), float(oversampling))
        galaxies = _pixels(xy, jacobian)
    elif kind == "piff":
        drawer = _OfPiff(model, int(size))
        galaxies = _places(xy, properties or {})
    else:
        drawer = _OfPsfex(model, int(size), float(oversampling))
        galaxies = _places(xy, {})
    return _drawn_once(drawer, galaxies, int(size), float(oversampling))


def read_piff(path: str | Path) -> Any:
    """Read a Piff model.

    Raises
    ------
    MissingExtraError
        If Piff is not installed.
    CatalogError
        If the file is not there, or holds no such model.
    """
    try:
        import piff
    except ImportError as error:
        raise MissingExtraError(
            "Piff models are read by Piff, which is not installed: pip install piff"
        ) from error
    _check_there(path)
    try:
        return piff.read(str(path))
    except Exception as error:  # it raises whatever its readers do
        reason = str(error) or type(error).__name__
        raise CatalogError(f"{path} is no Piff model: {reason}") from error


def read_psfex(path: str | Path, image: str | Path | None = None) -> Any:
    """Read a PSFEx model.

    Parameters
    ----------
    path : path
        The `.psf` file.
    image : path, optional
        The exposure, for its WCS. Not needed for the images of stars.

    Raises
    ------
    MissingExtraError
        If GalSim is not installed.
    CatalogError
        If a file is not there, or holds no such model.
    """
    load_galsim()
    import galsim.des

    _check_there(path)
    if image is not None:
        _check_there(image)
    try:
        # Opened here: GalSim leaves a file open that is none of PSFEx.
        with fits.open(path) as hdus:
            return galsim.des.DES_PSFEx(hdus[1], None if image is None else str(image))
    except Exception as error:  # of astropy, of GalSim, or a KeyError
        raise CatalogError(f"{path} is no PSFEx model: {error}") from error


class _SameEverywhere:
    """A GalSim object, drawn through the Jacobian of the pixels."""

    def __init__(self, model: Any, size: int, oversampling: float) -> None:
        self._galsim = load_galsim()
        self._model, self._size, self._oversampling = model, size, oversampling

    def __call__(self, what: Any) -> NDArray[np.float64]:
        galsim = self._galsim
        pixel = galsim.JacobianWCS(*what).toWorld(galsim.Pixel(1.0))
        wcs = galsim.JacobianWCS(*(value / self._oversampling for value in what))
        star = galsim.Convolve([self._model, pixel])
        drawn = star.drawImage(
            nx=self._size, ny=self._size, wcs=wcs, method="no_pixel", dtype=float
        )
        return np.array(drawn.array)


class _OfPiff:
    """A Piff model, drawn on the pixels of its exposure."""

    def __init__(self, model: Any, size: int) -> None:
        self._model, self._size = model, size

    def __call__(self, what: Any) -> NDArray[np.float64]:
        x, y, properties = what
        try:
            drawn = self._model.draw(
                x=x + 1.0, y=y + 1.0, stamp_size=self._size, center=True, **dict(properties)
            )
        except (KeyError, TypeError, ValueError) as error:
            raise FdntValueError(
                f"the Piff model does not draw with the properties {dict(properties)}: {error}"
            ) from error
        return np.array(drawn.array, dtype=np.float64)


class _OfPsfex:
    """A PSFEx model, which has the pixel in it."""

    def __init__(self, model: Any, size: int, oversampling: float) -> None:
        self._galsim = load_galsim()
        self._model, self._size, self._oversampling = model, size, oversampling

    def __call__(self, what: Any) -> NDArray[np.float64]:
        galsim = self._galsim
        position = galsim.PositionD(what[0] + 1.0, what[1] + 1.0)
        local = self._model.getLocalWCS(position) or galsim.PixelScale(1.0)
        matrix = local.jacobian().getMatrix() / self._oversampling
        drawn = self._model.getPSF(position).drawImage(
            nx=self._size,
            ny=self._size,
            wcs=galsim.JacobianWCS(*matrix.ravel()),
            method="no_pixel",
            dtype=float,
        )
        return np.array(drawn.array)


def _kind(model: Any) -> str:
    """Return what a model is, by its methods."""
    for kind, methods in (
        ("piff", ("get_profile", "draw")),
        ("psfex", ("getPSF", "getLocalWCS")),
        ("galsim", ("drawImage",)),
    ):
        if all(callable(getattr(model, method, None)) for method in methods):
            return kind
    raise FdntTypeError(
        f"model must be a GalSim object, or a Piff or PSFEx model, not {type(model).__name__}"
    )


def _pixels(xy: NDArray[np.float64], jacobian: ArrayLike | None) -> Iterator[tuple[bool, Hashable]]:
    """Yield for each galaxy whether it can be drawn, and the four numbers of its Jacobian."""
    matrices = np.eye(2) if jacobian is None else np.asarray(jacobian, dtype=np.float64)
    if matrices.shape not in ((2, 2), (len(xy), 2, 2)):
        raise ShapeMismatchError(
            f"jacobian must have the shape (2, 2) or ({len(xy)}, 2, 2), not {matrices.shape}"
        )
    if matrices.ndim == 2 and not is_regular(matrices[None])[0]:
        raise FdntValueError(
            "jacobian must be finite and not singular: d(u, v)/d(x, y) of the pixels"
        )
    matrices = np.broadcast_to(matrices, (len(xy), 2, 2))
    regular = is_regular(matrices)
    for good, matrix in zip(regular, matrices.reshape(-1, 4), strict=True):
        yield bool(good), tuple(float(value) for value in matrix)


def _places(xy: NDArray[np.float64], properties: dict[str, Any]) -> Iterator[tuple[bool, Hashable]]:
    """Yield for each galaxy whether it can be drawn, and its place and properties."""
    columns = {}
    for name, value in properties.items():
        column = np.asarray(value)
        if column.shape not in ((), (len(xy),)):
            raise ShapeMismatchError(
                f"the property {name!r} must be one value, or {len(xy)}, not of the shape "
                f"{column.shape}"
            )
        columns[name] = np.broadcast_to(column, (len(xy),)).tolist()
    for i, (x, y) in enumerate(xy.tolist()):
        own = tuple((name, column[i]) for name, column in columns.items())
        yield bool(np.isfinite(x) and np.isfinite(y)), (x, y, own)


def _drawn_once(
    drawer: Callable[[Any], NDArray[np.float64]],
    galaxies: Iterator[tuple[bool, Hashable]],
    size: int,
    oversampling: float,
) -> StarImages:
    """Draw what is different, and keep one of those that come out the same."""
    asked: dict[Hashable, int] = {}
    kept: dict[bytes, int] = {}
    images: list[NDArray[np.float64]] = []
    index = []
    for good, what in galaxies:
        key = what if good else None
        if key not in asked:
            image = drawer(what) if good else np.full((size, size), np.nan)
            number = kept.setdefault(image.tobytes(), len(images))
            if number == len(images):
                images.append(image)
            asked[key] = number
        index.append(asked[key])
    stack = np.stack(images) if images else np.empty((0, size, size))
    return StarImages(
        images=stack, psf_index=np.array(index, dtype=np.int64), oversampling=oversampling
    )


def _check_there(path: str | Path) -> None:
    if not Path(path).is_file():
        raise CatalogError(f"there is no file {path}")
