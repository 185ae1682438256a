"""What `fdnt-xp measure` is given: files, and how to measure what is in them."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fdnt_xp.data.images import Pixels, image_file, read_header, read_image
from fdnt_xp.data.model_stars import ModelStars
from fdnt_xp.data.psf_models import read_piff, read_psfex
from fdnt_xp.data.stamps import StampSource, cube_stamps, grid_stamps, position_stamps
from fdnt_xp.data.tables import read_positions
from fdnt_xp.data.wcs import wcs_jacobians
from fdnt_xp.errors import CatalogError, FdntValueError
from fdnt_xp.shapes.methods import NULL_TEST_METHODS


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """What to measure, by the options of the command line.

    Parameters
    ----------
    image, psf : str
        FITS or HDF5 files.
    psf_model : str
        What `psf` is: "image", or a model of "psfex" or "piff".
    cell : int or None
        Side of the cells, if the image is a grid of them.
    positions : str or None
        Table of positions, if galaxies are anywhere on the image.
    stamp_size : int or None
        Side of the stamp around each position.
    x_column, y_column : str
        Columns of that table.
    origin : int
        Its first pixel's coordinate.
    noise_image : str or None
        FITS file, blank sky: an image, or a cube of stamps.
    mask, weight : str or None
        FITS files of the shape of the image: not 0 where a pixel is missing, and the inverse
        variance of each pixel.
    jacobian : str or None
        `dudx,dudy,dvdx,dvdy` of all pixels.
    wcs : bool
        Whether to take it from the header of the image, at each position.
    """

    image: str
    psf: str
    cell: int | None = None
    positions: str | None = None
    stamp_size: int | None = None
    x_column: str = "x"
    y_column: str = "y"
    origin: int = 0
    noise_image: str | None = None
    mask: str | None = None
    weight: str | None = None
    jacobian: str | None = None
    wcs: bool = False
    psf_model: str = "image"

    @property
    def layout(self) -> str:
        """How the stamps are found: "grid", "positions" or "cube"."""
        if self.cell is not None:
            return "grid"
        return "positions" if self.positions is not None else "cube"

    def refuse_as_output(self, output: str) -> None:
        """Raise `CatalogError` if the output would replace one of the inputs."""
        if Path(output).resolve() in (path.resolve() for path in self.files()):
            raise CatalogError(f"{output} is an input; choose another name for the output")

    def files(self) -> tuple[Path, ...]:
        """Return the files that are read, without the names of extensions and datasets."""
        return tuple(image_file(getattr(self, name)) for name in self._given())

    def absolute(self) -> Inputs:
        """Return the same with full names, for processes that are elsewhere."""
        named = {name: os.path.abspath(getattr(self, name)) for name in self._given()}  # noqa: PTH100  not every name is a file's
        return replace(self, **named)

    def _given(self) -> list[str]:
        names = ("image", "psf", "positions", "noise_image", "mask", "weight")
        return [name for name in names if getattr(self, name) is not None]


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How to measure it.

    Parameters
    ----------
    backend, device, dtype : str
        See `fdnt_xp.app.backends.load_backend`.
    oversampling : int
        PSF pixels per image pixel.
    noise_variance : float or None
        Per pixel; measured on the noise image or the borders of the stamps if None.
    size : float or None
        Weight size, if fixed.
    chunk : int or None
        Galaxies at a time.
    quiet : bool
        No progress bar.
    responses : bool
        Whether to measure responses to shear, not shapes.
    method : str
        Of the shapes, by its name in `fdnt_xp.shapes.methods`.
    seed : int
        Of their synthetic noise.
    """

    backend: str = "numpy"
    device: str | None = None
    dtype: str = "float64"
    oversampling: int = 1
    noise_variance: float | None = None
    size: float | None = None
    chunk: int | None = None
    quiet: bool = False
    responses: bool = False
    method: str = "fdnt-ft"
    seed: int = 0


def open_source(inputs: Inputs) -> StampSource:
    """Open the image, and find the stamps in it.

    Raises
    ------
    FdntValueError
        If the options do not say how an image is divided.
    """
    if inputs.cell is not None and inputs.positions is not None:
        raise FdntValueError("give --cell or --positions, not both")
    if (inputs.positions is None) != (inputs.stamp_size is None):
        raise FdntValueError("--positions and --stamp-size go together")
    divided = inputs.layout != "cube"
    pixels = read_image(inputs.image, ndim=(2,) if divided else (2, 3))
    if inputs.cell is not None:
        return grid_stamps(pixels, inputs.cell)
    if inputs.positions is not None and inputs.stamp_size is not None:
        table = read_positions(
            inputs.positions,
            x_column=inputs.x_column,
            y_column=inputs.y_column,
            origin=inputs.origin,
        )
        return position_stamps(pixels, table.xy, inputs.stamp_size, table.ids)
    if pixels.ndim == 2:
        raise FdntValueError(
            f"{inputs.image} is one image of {pixels.shape[1]} x {pixels.shape[0]} pixels: say "
            "where its galaxies are, by --cell or by --positions and --stamp-size"
        )
    return cube_stamps(pixels)


def open_psf(inputs: Inputs, source: StampSource, oversampling: int) -> Pixels | ModelStars:
    """Open the PSF: an image, a cube with one for each galaxy, or a model to be drawn there."""
    if inputs.psf_model == "image":
        return read_image(inputs.psf, ndim=(2, 3), what="PSF image")
    if inputs.layout == "cube":
        raise FdntValueError(
            f"--psf-model {inputs.psf_model} wants an image with --cell or --positions: it is "
            "not known where the stamps of a cube were"
        )
    read = read_psfex if inputs.psf_model == "psfex" else read_piff
    side = min(source.stamp_shape) * oversampling
    return ModelStars(read(inputs.psf), source.positions, size=side, oversampling=oversampling)


def find_jacobians(inputs: Inputs, method: str, source: StampSource) -> NDArray[np.float64] | None:
    """Return the Jacobian of all pixels, (2, 2), or at each galaxy, (n_gal, 2, 2), if wanted."""
    if (inputs.wcs or inputs.jacobian is not None) and method not in NULL_TEST_METHODS:
        raise FdntValueError(
            f"--jacobian and --wcs are for --method {', '.join(NULL_TEST_METHODS)} and --responses"
        )
    if inputs.wcs:
        if inputs.jacobian is not None or inputs.layout == "cube":
            raise FdntValueError("--wcs wants positions on an image, and no --jacobian")
        return wcs_jacobians(read_header(inputs.image), source.positions)
    if inputs.jacobian is None:
        return None
    try:
        numbers = [float(part) for part in inputs.jacobian.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 4:
        raise FdntValueError(
            f"--jacobian must be four numbers, dudx,dudy,dvdx,dvdy, not {inputs.jacobian!r}"
        )
    return np.reshape(numbers, (2, 2))


def open_beside(source: StampSource, path: str | None, what: str) -> StampSource | None:
    """Open a map of the shape of the image."""
    if path is None:
        return None
    return source.beside(read_image(path, ndim=(2, 3), what=what), what)
